"""What a scene is to the rest of the program: photographs in order, and what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scene:
    """Photographs, sorted by name, and the cameras where they are known.

    A photograph's name is its file name without the ending; it is the key of both mappings.
    """

    name: str
    fingerprint: str
    """Hash of the photographs' names and bytes, or of what they are rendered from."""
    files: tuple[Path, ...]
    intrinsics: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """[3, 3] px at the file's own size, no distortion; given to SfM and not refined."""
    viewmats: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """[4, 4] exact world-to-camera; a yardstick, never given to SfM."""
