"""Makes overrides for a folder of photographs, or a video, that commands take by its path."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.errors import XrgsError
from xrgs.photos.images import SUFFIXES
from xrgs.photos.scenes.folder import VIDEOS
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.safeio.paths import user_path

if TYPE_CHECKING:
    from collections.abc import Iterable


def as_they_are(photographs: str) -> list[str]:
    """Return the overrides for a folder of photographs, or a video, without any degradation.

    Views are tagged HR and LR by their measured sampling rates.

    Raises:
        XrgsError: There is no such folder or video.
    """
    path = user_path(photographs.removesuffix(ALL_BELOW))
    if path.suffix.lower() in SUFFIXES and not path.is_dir():
        raise XrgsError(f"{photographs}: is a photograph; name the folder that it is in")
    if not path.exists():
        raise XrgsError(f"{photographs}: there is no such folder or video")
    kind = "folder" if path.is_dir() else "video"
    if kind == "video" and path.suffix.lower() not in VIDEOS:
        raise XrgsError(f"{photographs}: is neither a folder of photographs nor a video")
    # `factor=1` crops nothing, and with `min_hr=1` two training photographs are enough.
    variant = ("variant=sampling_rate", "variant.factor=1", "variant.min_hr=1")
    return [f"scene={kind}", f"scene.path={photographs}", *variant]


def last_of_each_key(words: Iterable[str]) -> list[str]:
    """Keep only the last override of each key: Hydra refuses a group that is given twice."""
    return list({word.lstrip("+").partition("=")[0]: word for word in words}.values())
