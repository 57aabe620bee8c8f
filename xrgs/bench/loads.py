"""Makes the loads of a benchmark: Gaussians and a view, random, from a file or from a cell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from xrgs.errors import XrgsError
from xrgs.safeio import npz
from xrgs.safeio.confined import confined
from xrgs.splat.cameras import Camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.capture.dataset import Dataset

#: Standard deviation of a Gaussian in units of the mean distance of N Gaussians spread over the
#: image. About 40 of them then contribute to a pixel for any N and image size, as in a trained
#: scene.
_SIZE_PER_SPACING = 1.5
_DEPTH_RANGE = (2.0, 6.0)  # world units
#: Half the side of the area that projected means cover, in half images: about a tenth of the
#: Gaussians are out of view.
_COVERED_AREA = 1.15

#: The keys of a load's .npz and their shapes, N Gaussians.
_SHAPES = {
    "means": ("N", 3),
    "quats": ("N", 4),
    "scales": ("N", 3),
    "opacities": ("N",),
    "sh": ("N", 16, 3),
    "viewmat": (4, 4),
    "K": (3, 3),
    "width": (),
    "height": (),
}


@dataclass(frozen=True)
class Load:
    """Gaussians with activated float32 parameters, and the view that they are rendered into."""

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
        """The six parameters in the order in which `rasterize_parameters` takes them."""
        sh0, rest = self.sh[:, :1].contiguous(), self.sh[:, 1:].contiguous()
        return self.means, self.quats, self.scales, self.opacities, sh0, rest

    @property
    def pixels(self) -> int:
        """The number of pixels of the view."""
        return self.camera.width * self.camera.height

    def with_camera(self, camera: Camera) -> Load:
        """Return the same Gaussians with another camera.

        Args:
            camera: The new camera.
        """
        return replace(self, camera=camera)

    def downscaled(self, factor: int) -> Load:
        """Return the same view at a lower resolution.

        Args:
            factor: Divisor of width and height; the result is rounded down, to at least 1 px.
        """
        camera = self.camera
        width, height = max(1, camera.width // factor), max(1, camera.height // factor)
        scale = torch.tensor([width / camera.width, height / camera.height, 1.0])
        return self.with_camera(
            replace(camera, K=camera.K * scale[:, None], width=width, height=height)
        )

    def center_crop(self, width: int, height: int) -> Load:
        """Return the middle of the view as a view of its own.

        Args:
            width: Width of the crop, px; at most the view's.
            height: Height of the crop, px; at most the view's.
        """
        camera = self.camera
        width, height = min(width, camera.width), min(height, camera.height)
        K = camera.K.clone()
        K[0, 2] -= (camera.width - width) // 2
        K[1, 2] -= (camera.height - height) // 2
        return self.with_camera(replace(camera, K=K, width=width, height=height))


def random_load(
    count: int, width: int, height: int, seed: int, size_per_spacing: float = _SIZE_PER_SPACING
) -> Load:
    """Make anisotropic Gaussians all over the view and a little beyond, few of them opaque.

    Args:
        count: Number of Gaussians.
        width: Width of the view, px.
        height: Height of the view, px.
        seed: Seed of the random numbers.
        size_per_spacing: Standard deviation of a Gaussian in units of the mean distance of `count`
            Gaussians spread over the image; twice as much makes four times as many contribute to a
            pixel.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    focal = 0.9 * width
    depth = uniform(count, low=_DEPTH_RANGE[0], high=_DEPTH_RANGE[1])
    plane = (
        _COVERED_AREA
        * torch.tensor([width, height])
        / 2
        / focal
        * uniform(count, 2, low=-1, high=1)
    )
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
    """Read a load from a .npz file.

    Args:
        path: File with `means` [N, 3], `quats` [N, 4] wxyz, `scales` [N, 3] in world units,
            `opacities` [N] in 0..1, `sh` [N, 16, 3], `viewmat` [4, 4] world to camera, `K` [3, 3],
            `width` and `height`.

    Raises:
        XrgsError: The file is missing or not a .npz, or a key is missing, of the wrong shape, not
            finite or out of range; the message names the file and the key.
    """
    try:
        with confined(path).open() as file:
            arrays = npz.read(file)
    except (OSError, ValueError) as error:
        raise XrgsError(f"{path}: cannot be read as .npz: {error}") from error
    missing = [key for key in _SHAPES if key not in arrays]
    if missing:
        raise XrgsError(f"{path}: lacks {', '.join(missing)}")
    count = len(arrays["means"]) if arrays["means"].ndim else 0
    for key, shape in _SHAPES.items():
        _check(path, key, arrays[key], tuple(count if side == "N" else side for side in shape))
    _check_range(path, "scales", arrays["scales"] >= 0, "below 0")
    opacities = arrays["opacities"]
    _check_range(path, "opacities", (opacities >= 0) & (opacities <= 1), "outside 0..1")
    tensors = {
        key: torch.from_numpy(np.ascontiguousarray(arrays[key], dtype=np.float32))
        for key in _SHAPES
        if key not in {"width", "height"}
    }
    width, height = (int(arrays[key]) for key in ("width", "height"))
    try:
        camera = Camera(tensors.pop("viewmat"), tensors.pop("K"), width, height)
    except ValueError as error:
        raise XrgsError(f"{path}: {error}") from error
    return Load(name=path.stem, camera=camera, **tensors)


def write(path: Path, load: Load) -> None:
    """Write a load as a .npz file that `read` reads.

    Args:
        path: File to write.
        load: What is written.

    Raises:
        XrgsError: The file cannot be written.
    """
    camera = load.camera
    arrays = {key: getattr(load, key).numpy() for key in list(_SHAPES)[:5]}
    arrays |= {"viewmat": camera.viewmat.numpy(), "K": camera.K.numpy()}
    try:
        with path.open("wb") as file:
            np.savez(file, **arrays, width=camera.width, height=camera.height)
    except OSError as error:
        raise XrgsError(f"{path}: cannot be written: {error.strerror}") from error


def load_from_cell(folder: Path, view_name: str) -> Load:
    """Make a load of a trained cell's Gaussians and one of its views.

    Args:
        folder: Folder of the cell in its store.
        view_name: Name of a training or test view.

    Raises:
        XrgsError: The cell isn't done, its variant isn't in the store, or it has no such view.
    """
    from xrgs.splat.ply import load_ply

    data = load_cell_dataset(folder)
    views = {view.name: view for view in (*data.train, *data.test)}
    if view_name not in views:
        raise XrgsError(f"view={view_name}: {folder} has {', '.join(sorted(views))}")
    means, quats, scales, opacities, sh0, rest = (
        value.detach() for value in load_ply(folder / "splats.ply").activated()
    )
    sh = torch.zeros(len(means), 16, 3)
    sh[:, : 1 + rest.shape[1]] = torch.cat([sh0, rest], dim=1)
    camera = views[view_name].camera
    return Load(f"{folder.name}:{view_name}", means, quats, scales, opacities, sh, camera)


def load_cell_dataset(folder: Path) -> Dataset:
    """Load the dataset that a cell was trained and tested on.

    Args:
        folder: Folder of the cell in its store.

    Raises:
        XrgsError: The cell isn't done, or its variant isn't in the store.
    """
    from xrgs.experiment.cell_folder import CellFolder

    cell = CellFolder(folder)
    state = cell.state()
    if state.name != "done":
        raise XrgsError(f"cell={folder}: is {state.name} {state.reason}".rstrip())
    return cell.dataset()


def _check(path: Path, key: str, value: NDArray[np.generic], shape: tuple[object, ...]) -> None:
    if value.shape != shape:
        raise XrgsError(f"{path}: {key} must be {list(_SHAPES[key])}, got {list(value.shape)}")
    if value.dtype.kind not in "fiu":
        raise XrgsError(f"{path}: {key} must be numbers, got {value.dtype}")
    if not np.isfinite(value).all():
        raise XrgsError(f"{path}: {key} has values that are not finite")


def _check_range(path: Path, key: str, inside: NDArray[np.bool_], outside: str) -> None:
    if not inside.all():
        raise XrgsError(f"{path}: {key} has values {outside}")
