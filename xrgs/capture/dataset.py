"""A variant in memory: images as tensors, cameras in the normalised world, SfM points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from xrgs.capture import images
from xrgs.errors import XrgsError
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import progress
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import normalize_scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.capture.views import Variant, View

#: Which training views a cell may use.
USES = ("mixed", "all_hr", "hr_only", "lr_only")


@dataclass(frozen=True)
class LoadedView:
    """One photograph in memory."""

    name: str
    tag: str
    """`HR` or `LR`."""
    camera: Camera
    image: torch.Tensor  # [H, W, 3] float32, 0..1
    rho: float = 1.0
    """Relative sampling rate in (0, 1], see `xrgs.capture.variant.View`."""


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


def load(variant: Variant, use: str = "mixed") -> Dataset:
    """Read a variant's images and normalise its world.

    Args:
        variant: What was frozen.
        use: Which training views: `mixed` takes all as they are, `all_hr` the originals in place
            of the degraded ones, `hr_only` and `lr_only` those of one tag. Poses, points, world
            and tests are the same in each: the controls differ in what is trained on alone.

    Raises:
        ImageError: an image is missing or unreadable; the message names it.
        XrgsError: `use` is none of these, or the variant has no such views.
    """
    chosen = _training_views(variant, use)
    placed = [view for view in variant.views if view.split != "original"]
    world = normalize_scene(np.stack([view.viewmat for view in placed]), variant.points)
    viewmats = {
        (view.split, view.name): viewmat
        for view, viewmat in zip(placed, world.viewmats, strict=True)
    }
    tests = [view for view in placed if view.split == "test"]
    wanted = [("train", view) for view in chosen] + [("test", view) for view in tests]
    loaded = tuple(
        _load_view(view, viewmats[split, view.name])
        for split, view in progress(wanted, "loading", "view")
    )
    return Dataset(
        train=loaded[: len(chosen)],
        test=loaded[len(chosen) :],
        points=torch.from_numpy(world.points).float(),
        colors=torch.from_numpy(variant.colors).float() / 255.0,
        scene_scale=world.scene_scale,
        factor=variant.factor,
    )


def _training_views(variant: Variant, use: str) -> list[View]:
    """Those of the variant that `use` names, in the variant's order."""
    if use not in USES:
        raise XrgsError(f"train.views={use}: must be one of {', '.join(USES)}")
    views = [view for view in variant.views if view.split == "train"]
    if use == "mixed":
        return views
    if use == "all_hr":
        originals = {view.name: view for view in variant.views if view.split == "original"}
        views = [originals.get(view.name, view) for view in views]
        low = [view.name for view in views if view.tag == "LR"]
        if low:
            raise XrgsError(
                f"variant {variant.id} has no original of {low[0]} (LR by nature): "
                "all_hr is for variants whose LR views were made"
            )
        return views
    tag = "HR" if use == "hr_only" else "LR"
    views = [view for view in views if view.tag == tag]
    if not views:
        raise XrgsError(f"variant {variant.id} has no {tag} view to train on: not for {use}")
    return views


def _load_view(view: View, viewmat: NDArray[np.float64]) -> LoadedView:
    camera = Camera(
        viewmat=torch.from_numpy(viewmat).float(),
        K=torch.from_numpy(view.K).float(),
        width=view.width,
        height=view.height,
    )
    image = torch.from_numpy(images.read(view.file))
    return LoadedView(view.name, view.tag, camera, image, view.rho)


def use_threads(wanted: int) -> int:
    """Set torch's threads; 0 takes every core that this process may use. Returns the number."""
    torch.set_num_threads(wanted or usable_cores())
    return torch.get_num_threads()
