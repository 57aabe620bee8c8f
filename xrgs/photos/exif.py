"""Reads from EXIF and XMP which camera took a photograph, and whether it was zoomed or cropped.

Nothing here is sure: programs that crop, zoom or stitch may keep all tags as they were.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xrgs.photos import images

_MAKE, _MODEL = 0x010F, 0x0110
_FOCAL, _FOCAL_35MM = 0x920A, 0xA405  # mm; the second is the 35 mm equivalent
_DIGITAL_ZOOM, _CUSTOM_RENDERED = 0xA404, 0xA401
_WIDTH, _HEIGHT = 0xA002, 0xA003  # size of the picture as saved by the camera, px
#: The value of CustomRendered by which Apple's cameras mark a panorama.
_APPLE_PANORAMA = 6
#: The largest relative deviation of a picture's aspect ratio from EXIF's, for rounded sides.
_ASPECT_TOLERANCE = 0.01
#: Finds the projection in XMP, in any namespace (Google's is GPano), and the values of ordinary
#: photographs.
_PROJECTION = re.compile(r":ProjectionType\s*(?:=\s*[\"']|>)\s*([^\"'<]*)")
_PERSPECTIVE = ("", "none", "perspective", "rectilinear", "planar")
#: Find the crop that Adobe's programs write into XMP, as fractions of the picture's sides.
_HAS_CROP = re.compile(r"crs:HasCrop\s*(?:=\s*[\"']|>)\s*true", re.IGNORECASE)
_CROP = re.compile(r"crs:Crop(Top|Left|Bottom|Right|Angle)\s*(?:=\s*[\"']|>)\s*([-+.\d]+)")


@dataclass(frozen=True)
class Taken:
    """How a photograph was taken, by its metadata."""

    camera: str = ""
    """`make/model/focal length/35 mm equivalent`; empty if EXIF has none of them."""
    cut: str = ""
    """The digital zoom and the crop that the metadata name; empty if they name neither.
    Photographs that differ in it have different intrinsics."""
    focal_35mm: float | None = None
    """The 35 mm equivalent focal length (film of 36 x 24 mm), mm."""
    projection: str = ""
    """The projection of a panorama; empty for an ordinary photograph."""


def read(path: Path) -> Taken:
    """Read the metadata of a photograph; damaged entries are skipped."""
    exif, details, xmp = images.metadata(path)
    values = [exif.get(_MAKE), exif.get(_MODEL), details.get(_FOCAL), details.get(_FOCAL_35MM)]
    camera = "/".join("" if v is None else str(v).strip("\0 ") for v in values).strip("/")
    focal = _number(details.get(_FOCAL_35MM))
    return Taken(
        camera,
        _cut(details, xmp, images.size(path)),
        focal if focal is not None and 1 < focal < 10_000 else None,
        _projection(exif, details, xmp),
    )


def _number(value: object) -> float | None:
    """Convert a value of EXIF to a number; None if that fails, as for a fraction n / 0."""
    with suppress(Exception):
        return float(value)  # type: ignore[arg-type]
    return None


def _cut(details: dict[int, Any], xmp: str, size: tuple[int, int]) -> str:
    """Return `Taken.cut` of a photograph of this size, px."""
    parts = []
    zoom = _number(details.get(_DIGITAL_ZOOM)) or 1.0  # 0 means no zoom
    if zoom > 1:
        parts.append(f"zoomed {zoom:.2f}")
    if _HAS_CROP.search(xmp) and (sides := sorted(_CROP.findall(xmp))):
        parts.append("cropped " + " ".join(f"{side} {value}" for side, value in sides))
    taken = [_number(details.get(tag)) or 0.0 for tag in (_WIDTH, _HEIGHT)]
    if min(taken) > 0:
        aspect = max(taken) / min(taken) / (max(size) / min(size))
        if abs(aspect - 1) > _ASPECT_TOLERANCE:
            parts.append(f"cut to {size[0]}x{size[1]}")
    return ", ".join(parts)


def _projection(exif: Any, details: dict[int, Any], xmp: str) -> str:
    if (found := _PROJECTION.search(xmp)) and found[1].strip().lower() not in _PERSPECTIVE:
        return found[1].strip()
    is_apple = str(exif.get(_MAKE)).startswith("Apple")
    return "panorama" if is_apple and details.get(_CUSTOM_RENDERED) == _APPLE_PANORAMA else ""
