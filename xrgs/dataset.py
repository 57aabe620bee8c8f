"""A variant in memory: images as tensors, cameras in the normalised world, SfM points."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from xrgs import images
from xrgs.machine import usable_cores
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import normalize_scene

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from xrgs.variant import Variant, View

_T = TypeVar("_T")


@dataclass(frozen=True)
class LoadedView:
    """One photograph in memory."""

    name: str
    tag: str
    """`HR` or `LR`."""
    camera: Camera
    image: torch.Tensor  # [H, W, 3] float32, 0..1


@dataclass(frozen=True)
class Dataset:
    """What a cell trains and is tested on, in gsplat's normalised world."""

    train: tuple[LoadedView, ...]
    test: tuple[LoadedView, ...]
    points: torch.Tensor  # [P, 3]
    colors: torch.Tensor  # [P, 3] 0..1
    scene_scale: float
    """Unit of the learning rate of means and of the size thresholds."""
    factor: int


def load(variant: Variant) -> Dataset:
    """Read a variant's images and normalise its world.

    Raises:
        ImageError: an image is missing or unreadable; the message names it.
    """
    viewmats = np.stack([view.viewmat for view in variant.views])
    world = normalize_scene(viewmats, variant.points)
    loaded = [
        _load_view(view, viewmat)
        for view, viewmat in zip(variant.views, world.viewmats, strict=True)
    ]
    pairs = list(zip(variant.views, loaded, strict=True))
    return Dataset(
        train=tuple(image for view, image in pairs if view.split == "train"),
        test=tuple(image for view, image in pairs if view.split == "test"),
        points=torch.from_numpy(world.points).float(),
        colors=torch.from_numpy(variant.colors).float() / 255.0,
        scene_scale=world.scene_scale,
        factor=variant.factor,
    )


def _load_view(view: View, viewmat: NDArray[np.float64]) -> LoadedView:
    camera = Camera(
        viewmat=torch.from_numpy(viewmat).float(),
        K=torch.from_numpy(view.K).float(),
        width=view.width,
        height=view.height,
    )
    return LoadedView(view.name, view.tag, camera, torch.from_numpy(images.read(view.file)))


def progress(items: Iterable[_T], what: str, unit: str, total: int | None = None) -> tqdm[_T]:
    """A progress bar on stderr with the time left, for what takes longer than two seconds."""
    return tqdm(items, what, total, unit=unit, mininterval=0.5, delay=2.0, file=sys.stderr)


def use_threads(wanted: int) -> int:
    """Set torch's threads; 0 takes every core that this process may use. Returns the number."""
    torch.set_num_threads(wanted or usable_cores())
    return torch.get_num_threads()
