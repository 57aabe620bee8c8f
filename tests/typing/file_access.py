"""A plugin of mypy that refuses the methods of `pathlib.Path` that reach the disk.

Below a store, a variant or the folder of a report, a method of `Path` would follow links, wait for
pipes, or make a folder again that has vanished: `xrgs.safeio.confined.ConfinedPath` is the one way
there. `ALLOWED` has every module that may use such a method all the same, and why. Functions such
as `open` and `json.loads` are refused by tests/test_architecture.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mypy.errorcodes import ErrorCode
from mypy.plugin import MethodContext, Plugin

if TYPE_CHECKING:
    from collections.abc import Callable

    from mypy.types import Type

ROOT = Path(__file__).parents[2]
_CODE = ErrorCode("file-access", "A method of pathlib.Path that reaches the disk", "Project")
_PATHS = frozenset({"pathlib.Path", "pathlib.PosixPath", "pathlib.WindowsPath"})
METHODS = frozenset(
    (
        *("chmod", "exists", "expanduser", "glob", "hardlink_to", "is_dir", "is_fifo", "is_file"),
        *("is_mount", "is_socket", "is_symlink", "iterdir", "lstat", "mkdir", "open", "read_bytes"),
        *("read_text", "readlink", "rename", "replace", "resolve", "rglob", "rmdir", "samefile"),
        *("stat", "symlink_to", "touch", "unlink", "walk", "write_bytes", "write_text"),
    )
)
#: Why a module may use some of the methods.
ALLOWED: dict[str, tuple[str, str]] = {
    "bench/against": ("is_file open read_text", "its own folder in /tmp"),
    "bench/loads": ("open", "the file that the user names is written"),
    "bench/memory": ("exists read_text", "/proc"),
    "bench/run": ("mkdir write_bytes write_text", "the folder that the user names is written"),
    "bench/scale": (
        "is_dir is_file iterdir mkdir read_bytes rglob stat write_bytes write_text",
        "its own folder in /tmp",
    ),
    "capture/download/scenes": ("exists is_dir is_file iterdir", "the folder that the user names"),
    "capture/mixing": ("read_text rglob", "COLMAP's logs, in a new folder of its own"),
    "capture/photographs": ("exists", "a new folder of its own"),
    "capture/poses": ("is_file", "the path that the user names"),
    "capture/registration": ("mkdir", "a new folder of its own, for COLMAP"),
    "capture/scenes/__init__": ("resolve", "the name of the folder that the user names"),
    "capture/scenes/bundled": ("is_file", "an installed package"),
    "capture/scenes/folder": (
        "is_dir is_file is_symlink iterdir",
        "the photographs that the user names",
    ),
    "capture/scenes/procedural": ("read_bytes", "the installed package"),
    "capture/sealed": ("resolve", "the name of the folder that the user names"),
    "capture/sfm": ("exists write_text", "a new folder of its own, for COLMAP"),
    "cli/hydra_words": (
        "exists is_dir rglob",
        "the paths on the command line, the package's configs",
    ),
    "cli/data": ("exists glob", "a path on the command line, the package's configs"),
    "config": ("is_dir", "the installed package"),
    "evaluation/lpips/download": (
        "expanduser glob is_file open write_text",
        "its own folder in /tmp, and a file that the user names",
    ),
    "evaluation/lpips/weights": (
        "expanduser is_file mkdir",
        "the cache of the user, who may name a link",
    ),
    "experiment/provenance": ("read_text", "/proc"),
    "experiment/store": ("exists is_symlink", "the folders above the store that the user names"),
    "runtime/processes": ("exists iterdir read_text readlink write_text", "/proc"),
    "sweep/jobs/worker": ("exists", "its own folder in /tmp"),
    "sweep/launch": ("expanduser", "the folder that Hydra is given, and a path of the user"),
    "sweep/rerun": ("exists resolve", "the folder of a cell that the user names"),
    "training/plugins": ("is_file rglob", "installed packages"),
}


def module_of(path: str) -> str | None:
    """Return the module of the package that a file is, as `report/page`; None for other files."""
    file = Path(path) if Path(path).is_absolute() else ROOT / path
    folder = ROOT / "xrgs"
    if not file.is_relative_to(folder):
        return None
    return file.relative_to(folder).with_suffix("").as_posix()


class FileAccess(Plugin):
    """Refuses a call of a method in `METHODS` where `ALLOWED` does not have it."""

    def get_method_hook(self, fullname: str) -> Callable[[MethodContext], Type] | None:
        """Return the check of a call of a method; None for a method of no interest.

        Args:
            fullname: The method's name with module and class.
        """
        kind, _, name = fullname.rpartition(".")
        return _checked(name) if kind in _PATHS and name in METHODS else None


def _checked(name: str) -> Callable[[MethodContext], Type]:
    def check(context: MethodContext) -> Type:
        module = module_of(context.api.path)
        outside = module is None or module.startswith("safeio/")
        if not outside and name not in ALLOWED.get(module or "", ("", ""))[0].split():
            context.api.fail(
                f"Path.{name} in {module}: use ConfinedPath, or allow it in {Path(__file__).name}",
                context.context,
                code=_CODE,
            )
        return context.default_return_type

    return check


def plugin(version: str) -> type[Plugin]:
    """Return the plugin; mypy calls this.

    Args:
        version: The version of mypy.
    """
    return FileAccess
