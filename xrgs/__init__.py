"""xrgs: an experiment harness for changes to 3D Gaussian Splatting, on the CPU.

It builds mixed-resolution variants of multi-view scenes, trains 3D Gaussian Splatting and the
ablations of Cross-Resolution Gaussian Splatting, and reports percentage-change tables.

From Python, `import xrgs` gives:

- `load_gaussians`, `save_gaussians`: read and write .ply, .glb and .spz files of `Gaussians`.
- `rasterize`: render `Gaussians` with a `Camera` and `RasterSettings` to a `Render`.
  `xrgs.formats.gsplat_api` has `rasterization`, with gsplat's signature and results.
- `compose`: make the config of a command line; `build_dataset` or `load_dataset`: make or load its
  training data; `train`: train it.
- `Store`: the results of sweeps as tables and objects.

Each name is imported when it is first used, so that planning a sweep does not import torch.

Importing the package sets OMP_WAIT_POLICY to `passive` unless the environment has a value. Then
torch's threads sleep between its loops, and leave the cores to the kernels. torch reads the
variable when it is imported, so import xrgs first.
"""

from __future__ import annotations

import os
import sys
import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xrgs.composing import compose
    from xrgs.errors import XrgsError
    from xrgs.formats.files import load_gaussians, save_gaussians
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.rendering import Render, rasterize
    from xrgs.splat.settings import RasterSettings
    from xrgs.store.prepare import build_dataset, load_dataset
    from xrgs.store.store import Store
    from xrgs.training.count_matching import train_cell as train

__version__ = "0.2.0"

__all__ = [
    "Camera",
    "Gaussians",
    "RasterSettings",
    "Render",
    "Store",
    "XrgsError",
    "build_dataset",
    "compose",
    "load_dataset",
    "load_gaussians",
    "rasterize",
    "save_gaussians",
    "train",
]

#: Public name -> name in its module, if they differ.
_NAMES_IN_MODULES = {"train": "train_cell"}
#: Public name -> its module. The imports above are the same, for type checkers and editors.
_MODULES = {
    "Camera": "xrgs.splat.cameras",
    "Gaussians": "xrgs.splat.gaussians",
    "RasterSettings": "xrgs.splat.settings",
    "Render": "xrgs.splat.rendering",
    "Store": "xrgs.store.store",
    "XrgsError": "xrgs.errors",
    "build_dataset": "xrgs.store.prepare",
    "compose": "xrgs.composing",
    "load_dataset": "xrgs.store.prepare",
    "load_gaussians": "xrgs.formats.files",
    "rasterize": "xrgs.splat.rendering",
    "save_gaussians": "xrgs.formats.files",
    "train": "xrgs.training.count_matching",
}
#: Name of version 0.2 that the next version removes -> its module, and its replacement.
_DEPRECATED = {
    "load_ply": ("xrgs.formats.ply", "xrgs.load_gaussians(path).gaussians"),
    "rasterization": ("xrgs.formats.gsplat_api", "xrgs.formats.gsplat_api.rasterization"),
    "save_ply": ("xrgs.formats.ply", "xrgs.save_gaussians"),
}
#: Names that render on the CPU, and are slow if torch's threads spin between its loops.
_RENDERING = ("rasterize", "train")
#: Whether torch's threads spin, since torch was imported before xrgs, without a policy in the
#: environment. The first warning sets it to False.
_SPINNING = "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def warn_of_spinning() -> None:
    """Warn once, with a remedy, if torch's threads spin between its loops."""
    if not _SPINNING:
        return
    globals()["_SPINNING"] = False
    warnings.warn(
        "torch was imported before xrgs, so its threads spin between loops and take the cores from"
        " rendering, which can be 100 times slower on a busy machine: import xrgs before torch, or"
        " set OMP_WAIT_POLICY=passive",
        RuntimeWarning,
        stacklevel=3,
    )


if not TYPE_CHECKING:  # or type checkers would accept any name

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first used (PEP 562)."""
        if name in _RENDERING:
            warn_of_spinning()
        if name in _DEPRECATED:
            module, use = _DEPRECATED[name]
            text = f"xrgs.{name} will be removed in the next version: use {use}"
            warnings.warn(text, DeprecationWarning, stacklevel=2)
            return getattr(import_module(module), name)
        if name not in _MODULES:
            raise AttributeError(f"module 'xrgs' has no attribute {name!r}")
        inner_name = _NAMES_IN_MODULES.get(name, name)
        value = globals()[name] = getattr(import_module(_MODULES[name]), inner_name)
        return value


def __dir__() -> list[str]:
    """List the public names, including those that are not imported yet."""
    return sorted({*globals(), *__all__})
