"""Makes the loads of the benchmark: random Gaussians and a view, or those of a file or a cell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.atomic import atomic_writer
from xrgs.splat.cameras import Camera
from xrgs.splat.loss import WINDOW

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
    """Gaussians with activated float32 parameters, and a view to render."""

    name: str
    means: Tensor  # [N, 3] world units
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] world units
    opacities: Tensor  # [N] 0..1
    sh: Tensor  # [N, 16, 3]
    camera: Camera

    def __len__(self) -> int:
        return len(self.means)

    @property
    def parameters(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The six parameters in the order of `rasterize_parameters`."""
        sh0, rest = self.sh[:, :1].contiguous(), self.sh[:, 1:].contiguous()
        return self.means, self.quats, self.scales, self.opacities, sh0, rest

    @property
    def sizes(self) -> dict[str, str | int]:
        """Columns of a result that describe the load."""
        width, height = self.camera.width, self.camera.height
        return {"load": self.name, "gaussians": len(self), "width": width, "height": height}

    def downscaled(self, factor: int) -> Load:
        """Return the same view with width and height divided by a factor.

        They are rounded down, but at least 11 px, the side of the SSIM window.
        """
        camera = self.camera
        width, height = (max(WINDOW, side // factor) for side in (camera.width, camera.height))
        scale = torch.tensor([width / camera.width, height / camera.height, 1.0])
        K = camera.K * scale[:, None]
        return replace(self, camera=replace(camera, K=K, width=width, height=height))

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
    """Make `count` anisotropic, mostly transparent Gaussians that fill the view and a little more.

    `size_per_spacing` is the standard deviation of a Gaussian over the mean distance between
    Gaussians in the image. The number of Gaussians that contribute to a pixel grows with its
    square.
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
    return Load(
        name="random",
        means=means,
        quats=torch.randn(count, 4, generator=generator),
        scales=size_per_spacing * spacing[:, None] * spread,
        opacities=torch.sigmoid(1.5 * torch.randn(count, generator=generator) - 1.5),
        sh=sh,
        camera=Camera(viewmat=torch.eye(4), K=K, width=width, height=height),
    )


def read(path: Path) -> Load:
    """Read a load from a .npz file with the arrays of `SHAPES`.

    `scales` are in world units, `opacities` in 0..1, `viewmat` is from world to camera, and the
    other arrays are as in `Load` and `Camera`. XrgsError names the file, and the array that is
    missing, of the wrong shape, not finite or out of range.
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
    return Load(name=path.stem, camera=camera, **tensors)


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
    """Write a load as a .npz file for `read`; XrgsError if it can't be written."""
    camera = load.camera
    tensors = {key: getattr(camera if key in {"viewmat", "K"} else load, key) for key in _TENSORS}
    arrays = {key: value.numpy() for key, value in tensors.items()}
    try:
        with atomic_writer(path) as file:
            np.savez(file, **arrays, width=camera.width, height=camera.height)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be written: {error.strerror}") from error


def load_from_cell(folder: Path, view_name: str) -> Load:
    """Make a load of a trained cell's Gaussians and one of its views.

    XrgsError says that the cell isn't done, its variant isn't in the store, or it has no such view.
    """
    from xrgs.store.cell_folder import CellFolder

    cell = CellFolder(folder)
    state = cell.state()
    if state.name != "done":
        raise XrgsError(f"--cell {folder}: is {state.name} {state.reason}".rstrip())
    data = cell.dataset()
    views = {view.name: view for view in (*data.train, *data.test)}
    if view_name not in views:
        raise XrgsError(f"view={view_name}: must be one of {', '.join(sorted(views))}")
    means, quats, scales, opacities, sh0, rest = (
        value.detach() for value in cell.gaussians().activated()
    )
    sh = torch.zeros(len(means), 16, 3)
    sh[:, : 1 + rest.shape[1]] = torch.cat([sh0, rest], dim=1)
    camera = views[view_name].camera
    return Load(f"{folder.name}:{view_name}", means, quats, scales, opacities, sh, camera)
