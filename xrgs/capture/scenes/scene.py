"""The dataclass of a scene: its photographs in order, and the cameras that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scene:
    """The photographs of a scene, and the cameras where they are known.

    The key of all mappings is the name of a photograph, which its view gets.
    """

    name: str
    """The name of the scene in tables."""
    fingerprint: str
    """A hash of the photographs' names and bytes, or of what they are rendered from."""
    files: Mapping[str, Path]
    """The photographs, sorted by name; one that a user named is a path by itself."""
    intrinsics: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Exact intrinsics [3, 3] in px of the file, without distortion; SfM gets them, and does not
    refine them."""
    viewmats: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Exact world-to-camera matrices [4, 4]. SfM never gets them: its poses are compared with
    them."""
