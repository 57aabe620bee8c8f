"""The camera of a photograph before undistortion, and undistortion itself.

Nothing here imports pycolmap before a lens with distortion is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from xrgs.errors import XrgsError
from xrgs.photos.images import ImageArray
from xrgs.runtime.signals import handlers_kept

#: COLMAP's camera models -> their parameters: focal length, principal point, terms of distortion.
#: The models' numbers in binary files count from 0 in this order.
MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": (*("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *("fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5"),
        *("p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),
}
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
#: The models that are a pinhole camera where all terms of distortion are 0.
_PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")
#: The angle from the optical axis to a side of the undistorted image is at most 60 degrees: beyond,
#: a pinhole camera stretches the picture more than 4 times, 1 / cos², and shrinks its centre.
_MAX_TANGENT = np.tan(np.radians(60.0))
#: The largest ratio of the undistorted image's focal length to the photograph's.
_MAX_ZOOM = 8.0
#: The least ratio of focal length to the image's longer side, and the largest parameter: no camera
#: comes near them, and powers of such numbers stay finite.
_LEAST_FOCAL, _MAX_VALUE = 1e-3, 1e9
_Row = tuple[float, float, float]


@dataclass(frozen=True)
class Lens:
    """The camera of an image: COLMAP's camera, and the map from its pixels to the image's.

    The image may have been turned by quarters, resized and cropped since COLMAP saw it. Pixel
    centres are at +0.5.
    """

    model: str
    """The name of COLMAP's camera model."""
    params: tuple[float, ...]
    """Its parameters in COLMAP's order, in px of the image that COLMAP saw."""
    width: int
    """Width of the image now, px."""
    height: int
    """Height of the image now, px."""
    from_camera: tuple[_Row, _Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    """The affine map [2, 3] from pixels that COLMAP saw to pixels of the image."""

    @property
    def is_pinhole(self) -> bool:
        """Whether the image has no distortion."""
        return self.model in _PINHOLES

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """The intrinsics [3, 3], px, without the distortion."""
        focal, centre = (2, 4) if MODELS[self.model][0] == "fx" else (1, 3)
        linear, shift = self._affine()
        K = np.eye(3)
        K[:2, :2] = linear * self.params[:focal] @ np.sign(linear).T
        K[:2, 2] = linear @ self.params[focal:centre] + shift
        return K

    def resized(self, width: int, height: int) -> Lens:
        """Return the camera of the image after it is resized to this size, px."""
        scale = np.diag([width / self.width, height / self.height])
        return self._moved(scale, np.zeros(2), (width, height))

    def cropped(self, left: int, top: int, width: int, height: int) -> Lens:
        """Return the camera of a part of the image; the arguments are in px."""
        return self._moved(np.eye(2), np.array([-left, -top], np.float64), (width, height))

    def turned(self, quarters: int) -> Lens:
        """Return the camera of the image after 1, 2 or 3 quarter turns clockwise.

        A ray (x, y, 1) of this camera is (R (x, y), 1) of the new one, R = quarter_turn(quarters).
        """
        R, size = quarter_turn(quarters), np.array([self.width, self.height])
        shift = -np.minimum(R @ size, 0)  # the turned image begins at 0 again
        width, height = np.abs(R @ size).astype(int).tolist()
        return self._moved(R, shift, (width, height))

    def undistorted(self) -> Lens:
        """Return the pinhole camera of the undistorted image; XrgsError if there is none.

        It has the same size and principal point, and the smallest focal length with which every
        pixel has a source inside the photograph and no side is more than 60 degrees from the axis.
        """
        if self.is_pinhole:
            return self
        K = self.K
        zoom = _zoom(self)
        params = (K[0, 0] * zoom, K[1, 1] * zoom, K[0, 2], K[1, 2])
        return Lens("PINHOLE", tuple(map(float, params)), self.width, self.height)

    def kept(self) -> float:
        """Return the share of the photograph that the undistorted image shows, 0 to 1."""
        if self.is_pinhole:
            return 1.0
        x, y = self.project(_rays(_border(self), self.undistorted().K)).T
        enclosed = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        return float(enclosed / (self.width * self.height))

    def project(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project rays, points [N, 2] on the plane z = 1 in the axes of the image, by pycolmap.

        Returns:
            Pixels [N, 2] of the image; NaN for a ray that the camera model can't project.
        """
        import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap where it is imported before zlib

        with handlers_kept():
            import pycolmap

        camera = pycolmap.Camera(model=self.model, width=1, height=1, params=self.params)
        linear, shift = self._affine()
        own = rays @ np.sign(linear)  # in the axes of the image that COLMAP saw
        seen = camera.img_from_cam(np.concatenate([own, np.ones((len(own), 1))], axis=1))
        return np.asarray(seen @ linear.T + shift, np.float64)

    def _affine(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        matrix = np.array(self.from_camera)
        return matrix[:, :2], matrix[:, 2]

    def _moved(
        self, linear: NDArray[np.float64], shift: NDArray[np.float64], size: tuple[int, int]
    ) -> Lens:
        """Return the camera after pixels x of the image become linear @ x + shift."""
        own, own_shift = self._affine()
        rows = np.concatenate([linear @ own, (linear @ own_shift + shift)[:, None]], axis=1)
        (a, b, c), (d, e, f) = (rows + 0.0).tolist()  # + 0.0: no negative zeros
        return replace(self, width=size[0], height=size[1], from_camera=((a, b, c), (d, e, f)))


def lens_of_model(model: str, size: tuple[int, int], params: Sequence[float]) -> Lens:
    """Make the lens of COLMAP's camera for images of a size, px; without distortion it is PINHOLE.

    Raises:
        XrgsError: The model is not supported, or a value is out of its range.
    """
    if model == "EQUIRECTANGULAR":
        raise XrgsError(
            f"camera model {model}: a panorama has no pinhole camera; cut it into perspective views"
            " first, as COLMAP's example panorama_sfm.py does"
        )
    if model not in MODELS:
        served = ", ".join(name for name in MODELS if name != "EQUIRECTANGULAR")
        raise XrgsError(f"camera model {model}: must be one of {served}")
    names, values = MODELS[model], tuple(map(float, params))
    if len(values) != len(names):
        raise XrgsError(
            f"camera model {model}: it has {len(values)} parameters; {len(names)} are needed "
            f"({', '.join(names)})"
        )
    focal = values[: 2 if names[0] == "fx" else 1]
    has_size = 0 < min(size) <= max(size) < _MAX_VALUE
    if (
        not has_size
        or not (np.abs(values) < _MAX_VALUE).all()
        or min(focal) < _LEAST_FOCAL * max(size)
    ):
        raise XrgsError(
            f"camera model {model}: its size and focal length must be above 0, and all values "
            f"finite: {size[0]}x{size[1]} px, {', '.join(f'{v:g}' for v in values)}"
        )
    if model in _PERSPECTIVE and not any(values[len(focal) + 2 :]):
        values = (focal[0], focal[-1], *values[len(focal) : len(focal) + 2])
        return Lens("PINHOLE", values, *size)
    return Lens(model, values, *size)


def quarter_turn(quarters: int) -> NDArray[np.float64]:
    """Return the rotation [2, 2] of pixel positions by clockwise quarter turns of the image."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarters)


def undistort(image: ImageArray, lens: Lens, order: int = 3) -> ImageArray:
    """Resample a photograph [H, W, C] to the image of `lens.undistorted()` by splines.

    The order of the spline is 3 for photographs, and 1 for masks. The result is not clamped; it is
    the image itself where the lens is a pinhole. Image and lens must be of one size.
    """
    if image.shape[:2] != (lens.height, lens.width):
        raise ValueError(f"image {image.shape[:2]}, lens {(lens.height, lens.width)}")
    if lens.is_pinhole:
        return image
    from skimage.transform import warp

    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    pixels = np.stack([columns.ravel(), rows.ravel()], -1)
    source = lens.project(_rays(pixels, lens.undistorted().K)) - 0.5
    coords = source.T[::-1].reshape(2, lens.height, lens.width)  # row, column
    bands = [warp(image[..., c], coords, order=order, mode="edge") for c in range(image.shape[2])]
    return np.stack(bands, axis=-1).astype(np.float32)


def _rays(pixels: NDArray[np.float64], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays [N, 2] of pixels [N, 2] of a pinhole camera."""
    rays: NDArray[np.float64] = (pixels - K[:2, 2]) / (K[0, 0], K[1, 1])
    return rays


def _border(lens: Lens) -> NDArray[np.float64]:
    """Return points [256, 2] around the border of an image, in order, px."""
    t = np.arange(64) / 64
    sides = [(t, 0 * t), (0 * t + 1, t), (1 - t, 0 * t + 1), (0 * t, 1 - t)]
    return np.concatenate([np.stack(side, -1) for side in sides]) * (lens.width, lens.height)


@cache
def _zoom(lens: Lens) -> float:
    """Find the ratio of the undistorted image's focal length to the photograph's.

    It depends only on the border of the image, so that resized copies get the same ratio.
    """
    rays = _rays(_border(lens), lens.K)
    low, high = float(np.abs(rays).max() / _MAX_TANGENT), _MAX_ZOOM
    if _fills(lens, rays / low):
        return low
    if not _fills(lens, rays / high):
        raise XrgsError(
            f"camera model {lens.model}: it can't be undistorted, because its distortion folds the "
            "picture or its principal point is outside of the picture: "
            f"{', '.join(f'{value:g}' for value in lens.params)}"
        )
    for _ in range(40):
        zoom = (low + high) / 2
        low, high = (low, zoom) if _fills(lens, rays / zoom) else (zoom, high)
    return high


def _fills(lens: Lens, rays: NDArray[np.float64]) -> bool:
    """Return whether every ray inside a border of rays [N, 2] falls into the photograph."""
    steps = np.append(np.linspace(0, 1, 9), 1.001)  # from the axis to the border, and just beyond
    path = lens.project((steps[:, None, None] * rays).reshape(-1, 2)).reshape(len(steps), -1, 2)
    # Where the radius falls on the way out, the lens would fold the image.
    radius = np.linalg.norm(path - path[0], axis=-1)
    inside = (path[-2] >= -1e-9) & (path[-2] <= np.array([lens.width, lens.height]) + 1e-9)
    return bool(inside.all() and (np.diff(radius, axis=0) > 0).all())
