"""Makes the loads of the benchmark: random Gaussians and a view, or those of a file or a cell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.cameras import Camera
from xrgs.splat.gaussians import ActivatedGaussians
from xrgs.splat.loss import WINDOW

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Standard deviation of a random Gaussian over the mean distance between Gaussians in the image.
#: With this value, about 40 Gaussians contribute to a pixel, for any number and image size.
_SIZE_PER_SPACING = 1.5
_DEPTH_RANGE = (2.0, 6.0)  # world units
_COVERED_AREA = 1.15  # sides over the image's; about a tenth of the Gaussians are out of view
_TENSORS = {
    "means": ("N", 3),
    "quats": ("N", 4),
    "scales": ("N", 3),
    "opacities": ("N",),
    "sh": ("N", 16, 3),
    "viewmat": (4, 4),
    "K": (3, 3),
}
#: Array of a load's .npz file -> its shape, for N Gaussians.
SHAPES: dict[str, tuple[int | str, ...]] = {**_TENSORS, "width": (), "height": ()}


@dataclass(frozen=True)
class Load:
    """Gaussians of float32 with 16 harmonics each, and a view to render."""

    name: str
    gaussians: ActivatedGaussians
    camera: Camera

    def __len__(self) -> int:
        return len(self.gaussians.means)

    @property
    def sizes(self) -> dict[str, str | int]:
        """Columns of a result that describe the load."""
        width, height = self.camera.width, self.camera.height
        return {"load": self.name, "gaussians": len(self), "width": width, "height": height}

    def downscaled(self, factor: int) -> Load:
        """Return the same view at a lower resolution.

        Args:
            factor: Divisor of width and height, which are rounded down, but at least 11 px, the
                side of the SSIM window.
        """
        sides = (self.camera.width, self.camera.height)
        camera = self.camera.resized(*(max(WINDOW, side // factor) for side in sides))
        return replace(self, camera=camera)

    def center_crop(self, width: int, height: int) -> Load:
        """Crop the view around its centre, to at most the given size, px."""
        camera = self.camera
        width, height = min(width, camera.width), min(height, camera.height)
        K = camera.K.clone()
        K[0, 2] -= (camera.width - width) // 2
        K[1, 2] -= (camera.height - height) // 2
        return replace(self, camera=replace(camera, K=K, width=width, height=height))


def random_load(
    count: int, width: int, height: int, seed: int, size_per_spacing: float = _SIZE_PER_SPACING
) -> Load:
    """Make anisotropic, mostly transparent Gaussians that fill the view and a little more.

    Args:
        count: Number of Gaussians.
        width: Width of the view, px.
        height: Height of the view, px.
        seed: Seed of the random numbers.
        size_per_spacing: Standard deviation of a Gaussian over the mean distance between Gaussians
            in the image. The number of Gaussians that contribute to a pixel grows with its square.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    focal = 0.9 * width
    depth = uniform(count, low=_DEPTH_RANGE[0], high=_DEPTH_RANGE[1])
    half_extent = _COVERED_AREA * torch.tensor([width, height]) / 2 / focal
    plane = half_extent * uniform(count, 2, low=-1, high=1)
    means = torch.cat([plane * depth[:, None], depth[:, None]], dim=1)
    spacing = math.sqrt(width * height / count) / focal * depth  # [N] world units
    spread = torch.exp(0.5 * torch.randn(count, 3, generator=generator) - 0.25)
    sh = 0.1 * torch.randn(count, 16, 3, generator=generator)
    sh[:, 0] = uniform(count, 3, low=-1.5, high=1.5)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    gaussians = ActivatedGaussians(
        means,
        torch.randn(count, 4, generator=generator),
        size_per_spacing * spacing[:, None] * spread,
        torch.sigmoid(1.5 * torch.randn(count, generator=generator) - 1.5),
        *_by_band(sh),
    )
    return Load("random", gaussians, Camera(torch.eye(4), K, width, height))


def _by_band(sh: Tensor) -> tuple[Tensor, Tensor]:
    """Return band 0 [N, 1, 3] and the others [N, 15, 3] of harmonics [N, 16, 3]."""
    return sh[:, :1].contiguous(), sh[:, 1:].contiguous()


def read(path: Path) -> Load:
    """Read a load from a .npz file.

    Args:
        path: File with the arrays of `SHAPES`: `scales` in world units, `opacities` in 0..1,
            `viewmat` from world to camera, and the other arrays as in `Load` and `Camera`.

    Raises:
        XrgsError: The file cannot be read, or an array is missing, of the wrong shape, not finite
            or out of range. The message names the file and the array.
    """
    try:
        with path.open("rb") as file:
            arrays = npz.read(file)
    except (OSError, ValueError) as error:
        raise XrgsError(f"{path}: cannot be read as .npz: {error}") from error
    if missing := [key for key in SHAPES if key not in arrays]:
        raise XrgsError(f"{path}: lacks {', '.join(missing)}")
    count = len(arrays["means"]) if arrays["means"].ndim else 0
    try:
        for key, shape in SHAPES.items():
            _check(key, arrays[key], tuple(count if side == "N" else side for side in shape))
        tensors = {
            key: torch.from_numpy(np.ascontiguousarray(arrays[key], dtype=np.float32))
            for key in _TENSORS
        }
        width, height = (int(arrays[key]) for key in ("width", "height"))
        if min(width, height) < WINDOW:  # a training step computes SSIM
            raise ValueError(f"width and height must be at least {WINDOW}, got {width}x{height}")
        camera = Camera(tensors.pop("viewmat"), tensors.pop("K"), width, height)
    except ValueError as error:
        raise XrgsError(f"{path}: {error}") from error
    sh0, rest = _by_band(tensors.pop("sh"))
    return Load(path.stem, ActivatedGaussians(**tensors, sh0=sh0, shN=rest), camera)


def _check(key: str, value: NDArray[Any], shape: tuple[int | str, ...]) -> None:
    if value.shape != shape:
        raise ValueError(f"{key} must be {list(SHAPES[key])}, got {list(value.shape)}")
    if value.dtype.kind not in "fiu":
        raise ValueError(f"{key} must be numbers, got {value.dtype}")
    if not np.isfinite(value).all():
        raise ValueError(f"{key} must be finite")
    if key in {"scales", "opacities"} and (value < 0).any():
        raise ValueError(f"{key} must be at least 0")
    if key == "opacities" and (value > 1).any():
        raise ValueError(f"{key} must be at most 1")


def write(path: Path, load: Load) -> None:
    """Write a load as a .npz file for `read`.

    Raises:
        XrgsError: The file cannot be written.
    """
    camera, tensors = load.camera, load.gaussians._asdict()
    tensors["sh"] = torch.cat([tensors.pop("sh0"), tensors.pop("shN")], dim=1)
    tensors |= {"viewmat": camera.viewmat, "K": camera.K}
    arrays = {key: value.numpy() for key, value in tensors.items()}
    try:
        with atomic_writer(path) as file:
            np.savez(file, **arrays, width=camera.width, height=camera.height)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be written: {error.strerror}") from error


def load_from_cell(folder: Path, view_name: str) -> Load:
    """Make a load of a trained cell's Gaussians and one of its views.

    Raises:
        XrgsError: The cell isn't done, its variant isn't in the store, or it has no such view.
    """
    from xrgs.store.cell_folder import CellFolder

    cell = CellFolder(folder)
    cell.check_done()
    data = cell.dataset()
    views = {view.name: view for view in (*data.train, *data.test)}
    if view_name not in views:
        raise XrgsError(f"view={view_name}: must be one of {', '.join(sorted(views))}")
    gaussians = ActivatedGaussians(*(value.detach() for value in cell.gaussians().activated()))
    rest = torch.zeros(len(gaussians.means), 15, 3)
    rest[:, : gaussians.shN.shape[1]] = gaussians.shN
    camera = views[view_name].camera
    return Load(f"{folder.name}:{view_name}", gaussians._replace(shN=rest), camera)
