"""Finds the photographs in scikit-image's wheel, without importing scikit-image."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from xrgs.errors import XrgsError


def bundled_photograph(name: str) -> Path:
    """Find a file in scikit-image's `data` folder.

    Args:
        name: The file's name.

    Returns:
        Its path.

    Raises:
        XrgsError: scikit-image, or the file in it, is not installed.
    """
    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise XrgsError("scikit-image is not installed: it holds the embedded scenes' photographs")
    path = Path(spec.origin).parent / "data" / name
    if not path.is_file():
        raise XrgsError(f"{path}: missing from this scikit-image, which the embedded scenes need")
    return path
