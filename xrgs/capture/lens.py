"""The camera model of photographs before undistortion, and undistortion itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from xrgs.capture.images import ImageArray

UNDISTORT = "Undistort the photographs first, as `colmap image_undistorter` does"
#: The parameters of the camera models of COLMAP that a `Lens` can stand for.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


@dataclass(frozen=True)
class Lens:
    """A camera with one radial distortion term, in px; pixel centres are at +0.5.

    It is COLMAP's SIMPLE_RADIAL with a focal length per axis: a point (x, y) on the plane z = 1
    projects to the pixel (fx x (1 + k r²) + cx, fy y (1 + k r²) + cy), with r² = x² + y².
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k: float = 0.0
    """The radial term; 0 for a pinhole camera."""

    def resized(self, width: int, height: int) -> Lens:
        """Return the camera of the same image after it was resized; its rays are the same."""
        sx, sy = width / self.width, height / self.height
        return Lens(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, self.k)

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """The intrinsics [3, 3], px, without the distortion."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def undistorted(self) -> Lens:
        """Return the pinhole camera (k = 0) of the undistorted image.

        It has the same size and principal point, and the smallest focal length with which every
        pixel has a source inside the photograph. The focal length depends on the image's border
        alone, so that an image and its resized copy are zoomed alike.
        """
        if self.k == 0:
            return self
        t = np.linspace(0.0, 1.0, 257)
        edge = np.concatenate(
            [np.stack([t, 0 * t + s], -1) for s in (0.0, 1.0)]
            + [np.stack([0 * t + s, t], -1) for s in (0.0, 1.0)]
        )  # [B, 2] in fractions of the image
        border = edge * (self.width, self.height)
        low, high = 0.25, 8.0
        for _ in range(50):
            zoom = (low + high) / 2
            source = self.source_pixels(border, zoom)
            inside = np.all((source >= -1e-9) & (source <= (self.width, self.height)))
            # Where d/dr (r + k r³) < 0, beyond this radius, a barrel lens would fold the image.
            x = (border - (self.cx, self.cy)) / (self.fx * zoom, self.fy * zoom)
            inside &= np.all(1 + 3 * self.k * np.sum(x**2, axis=-1) > 0)
            low, high = (low, zoom) if inside else (zoom, high)
        return Lens(self.width, self.height, self.fx * high, self.fy * high, self.cx, self.cy)

    def source_pixels(self, pixels: NDArray[np.float64], zoom: float) -> NDArray[np.float64]:
        """Map pixels of a pinhole camera to where the photograph shows the same rays.

        Args:
            pixels: Pixel coordinates [..., 2] (x, y) of the pinhole camera.
            zoom: The ratio of the pinhole camera's focal length to this camera's.

        Returns:
            Pixel coordinates [..., 2] in the photograph.
        """
        centre = np.array([self.cx, self.cy])
        focal = np.array([self.fx, self.fy])
        x = (pixels - centre) / (focal * zoom)
        r2 = np.sum(x**2, axis=-1, keepdims=True)
        source: NDArray[np.float64] = focal * x * (1 + self.k * r2) + centre
        return source


def undistort(image: ImageArray, lens: Lens, order: int = 3) -> ImageArray:
    """Resample a photograph to the image of `lens.undistorted()`, by spline interpolation.

    Args:
        image: The photograph, [H, W, C] in 0..1.
        lens: Its camera, of the same size.
        order: The order of the spline: 3 for photographs, 1 for masks.

    Returns:
        The undistorted image [H, W, C], not clamped; the image itself where the lens has k = 0.

    Raises:
        ValueError: The image and the lens differ in size.
    """
    if image.shape[:2] != (lens.height, lens.width):
        raise ValueError(f"image {image.shape[:2]}, lens {(lens.height, lens.width)}")
    if lens.k == 0:
        return image
    from skimage.transform import warp

    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    zoom = lens.undistorted().fx / lens.fx
    source = lens.source_pixels(np.stack([columns, rows], -1), zoom) - 0.5  # [H, W, 2]
    coords = source[..., ::-1].transpose(2, 0, 1)  # [2, H, W] row, column
    bands = [warp(image[..., c], coords, order=order, mode="edge") for c in range(image.shape[2])]
    return np.stack(bands, axis=-1).astype(np.float32)


def lens_of_model(model: str, size: tuple[int, int], params: Sequence[float]) -> Lens:
    """Convert a camera of COLMAP.

    Args:
        model: The name of COLMAP's camera model.
        size: Width and height of its images, px.
        params: The model's parameters, in COLMAP's order.

    Raises:
        XrgsError: The model, or a distortion term that is not 0, is not supported.
    """
    if model not in _MODELS:
        served = ", ".join(_MODELS)
        raise XrgsError(f"camera model {model}: must be one of {served}. {UNDISTORT}")
    return lens_of_terms(model, size, dict(zip(_MODELS[model], params, strict=True)))


def lens_of_terms(model: str, size: tuple[int, int], terms: Mapping[str, float]) -> Lens:
    """Make a camera of the terms of OpenCV's model.

    Args:
        model: The name of the camera in messages.
        size: Width and height of its images, px.
        terms: `f`, or `fx` and `fy`, and `cx`, `cy`, px; distortion terms by their names.

    Raises:
        XrgsError: A focal length is not above 0, a value is not finite, or a distortion term other
            than `k1` is not 0.
    """
    values = dict(terms)
    fx, fy = (values.pop(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    values.pop("f", None)
    cx, cy, k = values.pop("cx"), values.pop("cy"), values.pop("k1", 0.0)
    if not np.isfinite([fx, fy, cx, cy, k]).all() or min(fx, fy, *size) <= 0:
        raise XrgsError(
            f"camera {model}: its size and focal length must be above 0, and all values finite"
        )
    if others := [f"{name}={value:g}" for name, value in values.items() if value != 0]:
        raise XrgsError(
            f"camera {model}: distortion terms beside k1 must be 0 ({', '.join(others)}). "
            f"{UNDISTORT}"
        )
    return Lens(*size, fx, fy, cx, cy, k)
