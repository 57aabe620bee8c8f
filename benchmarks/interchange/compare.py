"""Checks that other programs read our files of Gaussians as xrgs does, and that xrgs reads theirs.

    python benchmarks/interchange/compare.py

prints the tables of docs/export.md. The programs are installed into a temporary folder, at the
versions below, by pip and npm (with Node.js). `--folder FOLDER` keeps them for the next run.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import xrgs
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.quaternions import rotation_matrices
from xrgs.splat.sh import C0

HERE = Path(__file__).parent
#: Program -> version, registry, formats that it reads, formats that it writes.
PROGRAMS = {
    "splat-transform": ("3.7.0", "npm", "ply spz", "ply spz glb"),
    "@adobe/spz": ("0.2.3", "npm", "spz", ""),
    "three": ("0.187.0", "npm", "ply spz glb", ""),
    "spz-js": ("1.2.5", "npm", "ply spz", "spz"),
    "gaussforge": ("0.6.0", "pypi", "ply spz", "ply spz"),
    "gsply": ("0.4.6", "pypi", "ply spz", "ply spz"),
    "aura-splat": ("1.1.0", "pypi", "ply spz", "spz"),
    "fourdgs": ("0.6.0", "pypi", "ply glb", ""),
    "plyfile": ("1.1.5", "pypi", "ply", ""),
    "trimesh": ("5.2.0", "pypi", "ply glb", ""),
    "pygltflib": ("1.16.5", "pypi", "glb", ""),
}
#: Program -> its name in npm, if another.
NPM_NAMES = {"splat-transform": "@playcanvas/splat-transform"}
#: The entries of a symmetric matrix that are compared: the upper triangle, row by row.
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
Arrays = dict[str, np.ndarray[Any, Any]]


class ProgramError(Exception):
    """A program refuses a file; the message is the program's last line with an error."""


@dataclass(frozen=True)
class Programs:
    """The programs, installed in a folder."""

    folder: Path

    def install(self) -> None:
        """Install the programs that are missing."""
        pinned: dict[str, list[str]] = {"npm": [], "pypi": []}
        for name, (version, registry, *_) in PROGRAMS.items():
            mark = "@" if registry == "npm" else "=="
            pinned[registry].append(f"{NPM_NAMES.get(name, name)}{mark}{version}")
        if not (self.folder / "node_modules").exists():
            (self.folder / "package.json").write_text("{}")
            quiet = ("--silent", "--no-audit", "--no-fund", "--ignore-scripts")
            _run(["npm", "install", *quiet, *pinned["npm"]], self.folder)
        if not (self.folder / "venv").exists():
            _run([sys.executable, "-m", "venv", "venv"], self.folder)
            _run(["venv/bin/pip", "install", "--quiet", *pinned["pypi"]], self.folder)

    def run(self, action: str, program: str, file: Path, out: Path, *more: str) -> None:
        """Let a program read or write a file, see `programs.py`."""
        script = [str(self.folder / "venv/bin/python"), str(HERE / "programs.py")]
        if PROGRAMS[program][1] == "npm":
            script = ["node", str(HERE / "programs.mjs")]
        command = [*script, action, program, str(file), str(out), *more]
        _run(command, self.folder)

    def read(self, program: str, file: Path, *more: str) -> Arrays:
        """Return the arrays that a program reads from a file, see `programs.py`."""
        if program == "splat-transform":  # it only converts: read its .ply
            converted = file.with_name(f"{file.name}.ply")
            self.run("write", program, file, converted)
            return self.read("plyfile", converted)
        out = file.with_suffix(".json")
        self.run("read", program, file, out, *more)
        return {name: np.array(values) for name, values in json.loads(out.read_text()).items()}


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        lines = [line.strip() for line in done.stderr.splitlines() if "Error" in line[:40]]
        raise ProgramError(lines[-1] if lines else done.stderr[-200:])


def scene() -> Gaussians:
    """Return 300 Gaussians in front of a camera at the origin, with quaternions of any length."""
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.rand(300, 3, generator=g) * 2 + torch.tensor([-1.0, -1, 3]),
        quats=torch.randn(300, 4, generator=g) * 3,
        scales=torch.rand(300, 3, generator=g) * 2 - 4,
        opacities=torch.randn(300, generator=g),
        sh0=torch.randn(300, 1, 3, generator=g).clamp(-1.5, 1.5),  # colours within 0..1 at band 0
        shN=(0.2 * torch.randn(300, 15, 3, generator=g)).clamp(-0.9, 0.9),
    )


def arrays(gaussians: Gaussians) -> Arrays:
    """Return the arrays that a program would read without any loss.

    `positions` [N, 3], `shapes` [N, 6] (upper triangle of the covariances), `opacities` [N] and
    `colours` [N, 3] in 0..1, `harmonics` [N, 15, 3].
    """
    axes = rotation_matrices(gaussians.quats.detach().double())
    axes = axes * gaussians.scales.detach().double().exp()[:, None]
    covariances = (axes @ axes.transpose(1, 2)).numpy()
    return {
        "positions": gaussians.means.detach().double().numpy(),
        "shapes": np.stack([covariances[:, i, k] for i, k in UPPER], axis=1),
        "opacities": gaussians.opacities.detach().double().sigmoid().numpy(),
        "colours": C0 * gaussians.sh0.detach().double()[:, 0].numpy() + 0.5,
        "harmonics": gaussians.shN.detach().double().numpy(),
    }


def comparable(read: Arrays) -> Arrays:
    """Convert the arrays of `Programs.read` to those of `arrays`."""
    named = {"positions": read["means"], "opacities": read["opacities"].reshape(-1)}
    named["colours"] = read["colors"] if "colors" in read else C0 * read["sh0"].reshape(-1, 3) + 0.5
    if "covariances" in read:
        named["shapes"] = read["covariances"]
    elif "quats" in read:
        axes = rotation_matrices(torch.from_numpy(read["quats"])).numpy() * read["scales"][:, None]
        full = axes @ axes.swapaxes(1, 2)
        named["shapes"] = np.stack([full[:, i, k] for i, k in UPPER], axis=1)
    if "shN" in read:
        named["harmonics"] = read["shN"]
    return named


def differences(theirs: Arrays, ours: Arrays) -> dict[str, str]:
    """Return name of an array -> its difference in words, for the arrays that differ."""
    words = {}
    for name, values in theirs.items():
        error = np.abs(values - ours[name])
        if name == "shapes":
            error = error / np.abs(ours[name]).max(axis=1, keepdims=True)
        if error.max() < 2e-5:
            continue
        step = {"opacities": 1 / 255, "colours": 1 / 255, "harmonics": 1 / 128}.get(name, 0)
        if error.max() <= 1.01 * step:
            words[name] = "8 bits"
        elif name == "positions" and (turn := _axes(values, ours[name])):
            words[name] = f"are {turn}"
        else:
            words[name] = f"up to {error.max():.1g} off"
    return words


def _axes(theirs: np.ndarray[Any, Any], ours: np.ndarray[Any, Any]) -> str:
    """Return which of our axes their x, y and z are, such as `x -y -z`; empty if none fits."""
    turns = product(permutations(range(3)), product((1, -1), repeat=3))
    next(turns)  # skip the identity
    for order, signs in turns:
        if np.abs(ours[:, order] * signs - theirs).max() < 1e-3:
            return " ".join(
                "xyz"[i] if s > 0 else "-" + "xyz"[i] for i, s in zip(order, signs, strict=True)
            )
    return ""


def psnr(theirs: Arrays, ours: Arrays) -> float:
    """Return the PSNR, dB, of a render of their arrays against ours; missing arrays are ours."""
    renders = [_render({**ours, **read}) for read in (theirs, ours)]
    error = (renders[0] - renders[1]).clamp(-1, 1).square().mean().item()
    return -10 * math.log10(max(error, 1e-12))


def _render(gaussians: Arrays) -> torch.Tensor:
    full = np.zeros((len(gaussians["shapes"]), 3, 3))
    for at, (i, k) in enumerate(UPPER):
        full[:, i, k] = full[:, k, i] = gaussians["shapes"][:, at]
    variances, axes = np.linalg.eigh(full)
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    quats = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    sh0 = (gaussians["colours"][:, None] - 0.5) / C0
    values = (
        gaussians["positions"],
        quats,
        np.sqrt(variances.clip(1e-12)),
        gaussians["opacities"],
        np.concatenate([sh0, gaussians["harmonics"]], axis=1),
    )
    K = torch.tensor([[[100.0, 0, 64], [0, 100, 64], [0, 0, 1]]])
    parts = (torch.from_numpy(value.copy()).float() for value in values)
    image: torch.Tensor = xrgs.rasterization(*parts, torch.eye(4)[None], K, 128, 128, sh_degree=3)[
        0
    ][0]
    return image


def as_ply(read: Arrays, suffix: str) -> Arrays:
    """Turn the arrays read from a .glb to the axes of .ply files: half a turn about z."""
    if suffix != ".glb":
        return read
    turned = dict(read)
    turned["positions"] = read["positions"] * [-1, -1, 1]
    if "shapes" in read:
        turned["shapes"] = read["shapes"] * [1, 1, -1, 1, -1, 1]
    if "harmonics" in read:  # harmonics of odd order m change sign
        odd = [abs(m) % 2 for band in (1, 2, 3) for m in range(-band, band + 1)]
        turned["harmonics"] = read["harmonics"] * (1 - 2 * np.array(odd))[:, None]
    return turned


def reading(programs: Programs, folder: Path) -> Iterator[tuple[str, ...]]:
    """Write our files, and yield a table row for each program and format that it reads."""
    gaussians = scene()
    files = {form: folder / f"own.{form}" for form in ("ply", "spz", "glb")}
    for file in files.values():
        xrgs.save_gaussians(file, gaussians)
    for version in ("2", "4"):
        programs.run("write", "@adobe/spz", files["spz"], folder / f"own.{version}.spz")
    for program, (pinned, _, formats, _) in PROGRAMS.items():
        for form in formats.split():
            yield (f"{program} {pinned}", f".{form}", *_row(programs, program, files[form]))


def _row(programs: Programs, program: str, file: Path) -> tuple[str, str, str]:
    versions = ""
    if file.suffix == ".spz":
        read = [v for v in "234" if _reads(programs, program, file, v)]
        versions = f"versions {', '.join(read)}" if read else "nothing"
    try:
        theirs = as_ply(comparable(programs.read(program, file)), file.suffix)
    except ProgramError as error:
        return versions, f"refuses version 3: {error}", "-"
    ours = arrays(xrgs.load_gaussians(file).gaussians)
    missing = [name for name in ours if name not in theirs]
    scope = "all" if not missing else f"no {', no '.join(missing)}"
    return ", ".join(filter(None, [versions, scope])), _words(theirs, ours), _decibels(theirs, ours)


def _words(theirs: Arrays, ours: Arrays) -> str:
    texts = [f"{name}: {how}" for name, how in differences(theirs, ours).items()]
    return "; ".join(texts) or "nothing"


def _decibels(theirs: Arrays, ours: Arrays) -> str:
    value = psnr(theirs, ours)
    return "over 100" if value > 100 else f"{value:.0f}"


def _reads(programs: Programs, program: str, file: Path, version: str) -> bool:
    versioned = file if version == "3" else file.with_name(f"own.{version}.spz")
    try:
        return len(programs.read(program, versioned)["means"]) > 0
    except ProgramError:
        return False


def writing(programs: Programs, folder: Path) -> Iterator[tuple[str, ...]]:
    """Let programs convert our .ply; yield a table row on how xrgs reads each of their files."""
    gaussians = scene()
    source = folder / "own.ply"
    xrgs.save_gaussians(source, gaussians)
    for program, (pinned, _, _, formats) in PROGRAMS.items():
        for form in formats.split():
            file = folder / f"{program}.{form}"
            programs.run("write", program, source, file)
            label = f"{program} {pinned}"
            try:
                read = arrays(xrgs.load_gaussians(file).gaussians)
            except XrgsError as error:
                yield label, f".{form}", str(error), "-"
                continue
            ours = arrays(gaussians)
            yield label, f".{form}", _words(read, ours), _decibels(read, ours)


def tables(folder: Path) -> str:
    """Return both tables in Markdown; missing programs are installed in `folder`."""
    programs = Programs(folder.absolute())
    programs.install()
    read = ("program", "own file", "it reads", "what differs from xrgs's reading", "PSNR, dB")
    written = ("program", "its file", "what xrgs reads otherwise than the .ply", "PSNR, dB")
    with tempfile.TemporaryDirectory() as work:
        return "\n\n".join(
            _markdown(head, [*rows(programs, Path(work))])
            for head, rows in ((read, reading), (written, writing))
        )


def _markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, help="where the programs are, or are installed")
    folder = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as temporary:
        sys.stdout.write(tables(folder or Path(temporary)) + "\n")


if __name__ == "__main__":
    main()
