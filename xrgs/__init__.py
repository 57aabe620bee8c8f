"""xrgs: an experiment harness for changes to 3D Gaussian Splatting, on the CPU.

It builds mixed-resolution variants of multi-view scenes, trains 3D Gaussian Splatting and the
ablations of Cross-Resolution Gaussian Splatting, and reports percentage-change tables.

From Python, `import xrgs` gives:

- `load_ply`, `save_ply`, `Gaussians`, `Camera`: Gaussians in and out, and views of them;
  `load_gaussians` and `save_gaussians` for .ply, .glb and .spz, and whether they are antialiased.
- `rasterize`: render Gaussians with a camera, with settings in `RasterSettings`; gives a `Render`.
- `rasterization`: the same with gsplat's signature and results.
- `compose`: the config of a command line; `build_dataset` or `load_dataset`: what it is trained on;
  `train`: train it.
- `Store`: the results of sweeps as tables and objects.

Each name is imported when it is first used, so that planning a sweep never waits for torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xrgs.capture.prepare import build_dataset, load_dataset
    from xrgs.composing import compose
    from xrgs.errors import XrgsError
    from xrgs.experiment.store import Store
    from xrgs.splat.cameras import Camera
    from xrgs.splat.files import load_gaussians, save_gaussians
    from xrgs.splat.gaussians import Gaussians
    from xrgs.splat.gsplat_api import rasterization
    from xrgs.splat.ply import load_ply, save_ply
    from xrgs.splat.rendering import Render, rasterize
    from xrgs.splat.settings import RasterSettings
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
    "load_ply",
    "rasterization",
    "rasterize",
    "save_gaussians",
    "save_ply",
    "train",
]

#: Public names that differ from those in their modules.
_NAMES_IN_MODULES = {"train": "train_cell"}
#: The module of each public name; the imports above say the same to type checkers and editors.
_MODULES = {
    "Camera": "xrgs.splat.cameras",
    "Gaussians": "xrgs.splat.gaussians",
    "RasterSettings": "xrgs.splat.settings",
    "Render": "xrgs.splat.rendering",
    "Store": "xrgs.experiment.store",
    "XrgsError": "xrgs.errors",
    "build_dataset": "xrgs.capture.prepare",
    "compose": "xrgs.composing",
    "load_dataset": "xrgs.capture.prepare",
    "load_gaussians": "xrgs.splat.files",
    "load_ply": "xrgs.splat.ply",
    "rasterization": "xrgs.splat.gsplat_api",
    "rasterize": "xrgs.splat.rendering",
    "save_gaussians": "xrgs.splat.files",
    "save_ply": "xrgs.splat.ply",
    "train": "xrgs.training.count_matching",
}


if not TYPE_CHECKING:  # else type checkers would take any name to be there

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first used (PEP 562)."""
        if name not in _MODULES:
            raise AttributeError(f"module 'xrgs' has no attribute {name!r}")
        inner_name = _NAMES_IN_MODULES.get(name, name)
        value = globals()[name] = getattr(import_module(_MODULES[name]), inner_name)
        return value


def __dir__() -> list[str]:
    """List the public names, those that are not imported yet too."""
    return sorted({*globals(), *__all__})
