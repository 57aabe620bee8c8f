"""OpenSplat as a competitor in `race.py`: its data, its runs, and the scores of its .ply files.

It trains on every image of a COLMAP model, so we give it a model with only the training views of a
variant. It moves and scales the world to the cameras; with `--keep-crs` it writes the .ply in the
world of the model, where our cameras are.
"""

from __future__ import annotations

import math
import re
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import IO, TYPE_CHECKING

from xrgs.evaluation.protocol import score_views
from xrgs.mixture.colmap import PinholeImage, write_model
from xrgs.photos import images

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from xrgs.config import SplatConf
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.dataset import Dataset, LoadedView

#: Settings in which its renderer differs from ours: background colour and largest alpha.
_BACKGROUND, _ALPHA_MAX = (0.6130, 0.0101, 0.3984), 0.999
_STEP = re.compile(r"Step (\d+): ")
_WROTE = re.compile(r"Wrote (.*_\d+\.ply)$")


@dataclass(frozen=True)
class Snapshot:
    """A .ply that a run wrote."""

    steps: int
    seconds: float
    """Seconds from the end of the first step to the loss of this one, without writing files."""
    file: Path


def version(binary: str) -> str:
    """Return the name and the version of the program.

    Raises:
        SystemExit: The program does not run.
    """
    command = [binary, "--version"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError) as error:
        raise SystemExit(f"--opensplat {binary}: {error}") from error
    return f"OpenSplat {done.stdout.strip()}"


def write_training_views(data: Dataset, folder: Path) -> None:
    """Write the training views of a variant as a COLMAP folder, unless it is there.

    Args:
        data: The variant.
        folder: The folder to write; its parent must exist.
    """
    if folder.exists():
        return
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    model = unfinished / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    placements = []
    for view in data.train:
        camera, name = view.camera, f"{view.name}.png"
        images.save(unfinished / "images" / name, view.image.numpy(), durable=False)
        K, viewmat = camera.K.double().numpy(), camera.viewmat.double().numpy()
        placements.append(PinholeImage(name, camera.width, camera.height, K, viewmat))
    colors = (data.colors * 255).round().byte().numpy()
    write_model(model, placements, data.points.double().numpy(), colors)
    unfinished.rename(folder)


def train(
    binary: str, options: Sequence[str], every: int, limits_s: Sequence[float], out: Path
) -> dict[float, Snapshot]:
    """Run OpenSplat until it ends, or has trained for longer than the largest limit.

    Args:
        binary: The program.
        options: The program's options, with the folder of the data.
        every: Steps between two .ply files.
        limits_s: Limits of the training time, s.
        out: An empty folder for the program's files.

    Returns:
        Limit -> the last .ply within it, if there is one. Other .ply files are removed.

    Raises:
        SystemExit: The program has failed (the message has the end of its output), or has written
            no .ply within any limit.
    """
    saving = ("--keep-crs", "--save-every", str(every), "-o", str(out / "splat.ply"))
    errors = out / "stderr.txt"
    with (
        errors.open("w") as stderr,
        subprocess.Popen(  # noqa: S603
            [binary, *options, *saving], stdout=subprocess.PIPE, stderr=stderr, text=True
        ) as process,
    ):
        assert process.stdout is not None  # noqa: S101  for mypy
        try:
            kept = snapshots(_timed(process.stdout), limits_s)
            failed = process.wait(timeout=1)
        except subprocess.TimeoutExpired:
            failed = 0  # still training, but past the limit
        finally:
            process.kill()
    if failed:
        raise SystemExit(f"{binary} {' '.join(options)}: {errors.read_text()[-2000:]}")
    if not kept:
        raise SystemExit(f"{binary} {' '.join(options)}: no .ply within {max(limits_s):g} s")
    return kept


def snapshots(
    lines: Iterable[tuple[float, str]], limits_s: Sequence[float]
) -> dict[float, Snapshot]:
    """Follow the output of a run, until it has trained for longer than the largest limit.

    OpenSplat prints a line with the loss at each step, and a line after writing a .ply. The
    optimizer's step in between counts as writing.

    Args:
        lines: The lines of the output, each with the time of its arrival, s.
        limits_s: Limits of the training time, s.

    Returns:
        As for `train`.
    """
    kept: dict[float, Snapshot] = {}
    started, steps, seconds, writing = 0.0, 0, 0.0, 0.0
    for now, line in lines:
        if step := _STEP.match(line):
            started = started if steps else now
            steps, seconds = int(step[1]), now - started - writing
            if seconds > max(limits_s):
                break
        elif wrote := _WROTE.match(line):
            writing = now - started - seconds  # of all files so far
            before = set(kept.values())
            snapshot = Snapshot(steps, seconds, Path(wrote[1]))
            kept |= dict.fromkeys((limit for limit in limits_s if seconds <= limit), snapshot)
            for old in before - set(kept.values()):
                old.file.unlink()
    return kept


def _timed(stream: IO[str]) -> Iterator[tuple[float, str]]:
    for line in stream:
        yield time.perf_counter(), line


def score(
    gaussians: Gaussians, views: Sequence[LoadedView], conf: SplatConf, renders: Path
) -> dict[str, float]:
    """Score Gaussians of OpenSplat on test views, with our metrics and its renderer's settings.

    Its renderer assumes the principal point in the middle of the image.

    Args:
        gaussians: The Gaussians of a .ply.
        views: The test views.
        conf: The settings of one of our cells.
        renders: The folder for the renders, made if it is missing.

    Returns:
        Score -> its mean over the views; NaN if it can't be computed.
    """
    raster = replace(conf.raster, background=_BACKGROUND, alpha_max=_ALPHA_MAX, antialiased=False)
    centred = [replace(view, camera=_centred(view)) for view in views]
    renders.mkdir(parents=True, exist_ok=True)
    rows = score_views(gaussians, centred, replace(conf, raster=raster), renders)
    scores = {name: [row[name] for row in rows] for name in rows[0] if name != "view"}
    return {name: math.nan if None in values else fmean(values) for name, values in scores.items()}


def _centred(view: LoadedView) -> Camera:
    camera, K = view.camera, view.camera.K.clone()
    K[0, 2], K[1, 2] = camera.width / 2, camera.height / 2
    return replace(camera, K=K)
