"""The photographs that scikit-image's wheel itself carries; found without importing it."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from xrgs.errors import XrgsError


def photograph(name: str) -> Path:
    """Path of a photograph of scikit-image's `data` folder.

    Raises:
        XrgsError: scikit-image, or the file in it, is not there.
    """
    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise XrgsError("scikit-image is not installed: it holds the embedded scenes' photographs")
    path = Path(spec.origin).parent / "data" / name
    if not path.is_file():
        raise XrgsError(f"{path}: missing from this scikit-image, which the embedded scenes need")
    return path
