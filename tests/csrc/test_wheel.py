"""The kernels of a wheel that is built without a compiler are those of the installed package."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.runtime.programs import run_python

ROOT = Path(__file__).resolve().parents[2]

#: Prints the digest of an image and its gradients for each instruction set that fuses products and
#: sums, which is to be the same for every compiler.
DIGESTS = """
import hashlib, sys
import torch
from xrgs import _native
from xrgs.splat.cameras import Camera
from xrgs.splat.rendering import rasterize_parameters
from xrgs.splat.settings import RasterSettings

def digest():
    draw = torch.Generator().manual_seed(0)
    sample = lambda *shape: torch.rand(*shape, generator=draw)
    means = torch.cat([4 * sample(500, 2) - 2, 3 + 3 * sample(500, 1)], 1)
    parameters = [means, sample(500, 4) - 0.5, 0.02 + 0.3 * sample(500, 3), sample(500)]
    parameters += [sample(500, 1, 3), 0.2 * sample(500, 15, 3)]
    K = torch.tensor([[90.0, 0, 48], [0, 90, 36], [0, 0, 1]])
    leaves = [p.requires_grad_() for p in parameters]
    camera, settings = Camera(torch.eye(4), K, 96, 72), RasterSettings()
    image = rasterize_parameters(*leaves, camera, settings, sh_degree=3, backend="native").image
    image.square().sum().backward()
    arrays = [image.detach(), *(leaf.grad for leaf in leaves)]
    return hashlib.sha256(b"".join(array.numpy().tobytes() for array in arrays)).hexdigest()

try:
    _native.set_isa("avx9")
except ValueError as error:  # an exception crosses from the kernels to Python
    assert "avx9" in str(error)
for isa in _native.available_isas():
    _native.set_isa(isa)
    print(isa, digest() if isa != "portable" else len(digest()))
"""

#: Imports a folder's packages in place of installed ones, the editable ones included.
IMPORT_FROM = """
import sys
sys.path.insert(0, {!r})
sys.meta_path[:] = [f for f in sys.meta_path if not type(f).__module__.startswith("_editable")]
"""


@pytest.mark.slow
@pytest.mark.exhaustive  # compiling the kernels with ziglang takes minutes
def test_a_machine_without_a_compiler_builds_the_same_kernels(tmp_path: Path) -> None:
    """A wheel that is built with an empty PATH has kernels that give the installed ones' bits."""
    pip = [sys.executable, "-P", "-m", "pip"]
    environment = {k: v for k, v in os.environ.items() if k not in {"CC", "CXX", "PYTHONPATH"}}
    environment["PATH"] = str(tmp_path)
    get = [*pip, "install", "--dry-run", "--no-deps", "--ignore-installed", "ziglang"]
    if importlib.util.find_spec("pip") is None or subprocess.run(get, check=False).returncode:
        pytest.skip("ziglang can't be installed here")
    command = [*pip, "wheel", "--no-deps", "--wheel-dir", str(tmp_path / "dist"), str(ROOT)]
    subprocess.run(command, env=environment, check=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "built")
    assert [name for name in names if name.startswith("xrgs/_native") and name.endswith(".so")]
    assert not [name for name in names if "xrgs_build" in name]
    kernels = [digests(tmp_path / "built", tmp_path)]
    if importlib.util.find_spec("xrgs._native") is not None:
        kernels.append(digests(None, tmp_path))
    assert kernels[0] == kernels[-1]


def digests(package: Path | None, folder: Path) -> str:
    """What DIGESTS prints with the package of a folder, or with the installed one."""
    program = DIGESTS if package is None else IMPORT_FROM.format(str(package)) + DIGESTS
    done = run_python(program, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout
