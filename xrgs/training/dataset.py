"""Loads a variant into memory: images as tensors, cameras and points in the normalised world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from xrgs.config import TRAINING_VIEWS
from xrgs.errors import XrgsError
from xrgs.photos import images, masks
from xrgs.runtime.progress import progress
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import NormalizedScene, normalize_scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.mixture.views import Variant, View

#: Least number of HR training views after `train.validation` holds some out; our choice.
_MIN_HR_LEFT = 2


@dataclass(frozen=True)
class LoadedView:
    """A view in memory. Its photograph has 8 bits, a quarter of the memory of float32."""

    name: str
    """Name of the view's photograph, unique among the views of a split."""
    tag: str
    """`HR` or `LR`."""
    camera: Camera
    """The camera in the normalised world."""
    pixels: torch.Tensor
    """[H, W, 3] photograph: uint8 as in the file, or floats in 0..1. In training views the hidden
    pixels outside the mask are replaced by colours from the inside."""
    sampling_rate: float = 1.0
    """Relative sampling rate in (0, 1], see `xrgs.mixture.views.View`."""
    mask: torch.Tensor | None = None
    """[H, W] bool, True for a used pixel, at least one; None if all are used."""
    supersampling: float = 1.0
    """Factor of width and height to reach the finest views, see `xrgs.mixture.views.View`."""

    def to(self, device: str) -> LoadedView:
        """Return the view with photograph and mask on a device; the camera stays on the CPU."""
        mask = None if self.mask is None else self.mask.to(device)
        return replace(self, pixels=self.pixels.to(device), mask=mask)

    @property
    def image(self) -> torch.Tensor:
        """The photograph [H, W, 3] in 0..1: a new float32 tensor of `pixels` / 255."""
        if self.pixels.is_floating_point():
            return self.pixels
        return self.pixels.float().div_(255)  # in place: allocating takes longer than dividing


@dataclass(frozen=True)
class Dataset:
    """The training and test data of a cell, in gsplat's normalised world."""

    train: tuple[LoadedView, ...]
    test: tuple[LoadedView, ...]
    """The scored views: the variant's test views, or with `train.validation` the held-out HR
    training views."""
    points: torch.Tensor
    """SfM points [P, 3], float32."""
    colors: torch.Tensor
    """Colours of the points [P, 3], float32 in 0..1."""
    scene_scale: float
    """Extent of the scene, world units: the unit of means' learning rate and of size thresholds
    (`xrgs.splat.normalize`)."""
    factor: int
    """Size of HR views over size of LR views, as the method assumes it."""
    degradation: str = "downsample"
    """How LR views were made from HR views, a key of `xrgs.mixture.degradations.DEGRADATIONS`, or
    `none` if a camera took them."""

    @property
    def view_pixels(self) -> int:
        """Number of pixels of the largest training view, for budgets; 0 without views."""
        return max((view.camera.width * view.camera.height for view in self.train), default=0)


def load(
    variant: Variant, use: str = "mixed", *, validation: float = 0.0, seed: int = 0
) -> Dataset:
    """Read a variant's images, in its order, and normalise its world.

    Poses, points and world depend neither on `use` nor on `validation`: SfM has registered all
    views, also held-out and test views. So the controls differ from `mixed` only in the training
    views.

    Args:
        variant: The frozen variant.
        use: Training views to load: `mixed` for all, `all_hr` for all with the originals instead of
            degraded photographs, `hr_only` and `lr_only` for the views of one tag.
        validation: Fraction of the HR training views that are held out, round(validation * n) of
            n, at least one. They are scored instead of the test views, which are not read then. 0
            scores the test views.
        seed: The cell's seed, which selects the held-out views: seeds 0, 1, ... hold out one part
            of the HR views after another, so that 1 / `validation` seeds are the folds of a
            cross-validation. The selection depends only on the variant, `validation` and `seed`.

    Raises:
        UnreadableError: An image can't be read at the moment.
        ImageError: An image is missing, damaged or not of its view's size; the message names it.
        XrgsError: The variant has no such views, too few HR training views are left, or its cameras
            and points can't be normalised; the message names the config's key or the variant.
    """
    scored = _held_out(variant, validation, seed) or [v for v in variant.views if v.split == "test"]
    held_out = {view.name for view in scored if view.split == "train"}
    training = [view for view in _training_views(variant, use) if view.name not in held_out]
    posed = [view for view in variant.views if view.split != "original"]
    world = _normalized(variant, posed)
    viewmats = {
        (view.split, view.name): viewmat
        for view, viewmat in zip(posed, world.viewmats, strict=True)
    }
    # The original of a degraded training view has the same pose.
    entries = [("train", view) for view in training] + [(view.split, view) for view in scored]
    loaded = tuple(
        _load_view(view, viewmats[split, view.name], hide=place < len(training))
        for place, (split, view) in enumerate(progress(entries, "loading", "view"))
    )
    return Dataset(
        train=loaded[: len(training)],
        test=loaded[len(training) :],
        points=torch.from_numpy(world.points).float(),
        colors=torch.from_numpy(variant.colors).float() / 255.0,
        scene_scale=world.scene_scale,
        factor=variant.factor,
        degradation=str(variant.report.get("degradation", "downsample")),
    )


def _normalized(variant: Variant, posed: list[View]) -> NormalizedScene:
    """Normalise the world of a variant; fails if given poses and points do not belong together."""
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return normalize_scene(np.stack([view.viewmat for view in posed]), variant.points)
    except (FloatingPointError, ValueError, np.linalg.LinAlgError) as error:
        why = f"its cameras and points can't be of one scene ({error})"
        raise XrgsError(f"{variant.folder}: {why}") from error


def _held_out(variant: Variant, share: float, seed: int) -> list[View]:
    """Choose the held-out HR training views, in the variant's order."""
    if share == 0:
        return []
    views = [view for view in variant.views if view.split == "train" and view.tag == "HR"]
    count = max(1, round(share * len(views))) if 0 < share < 1 else len(views)
    if len(views) - count < _MIN_HR_LEFT:
        raise XrgsError(
            f"train.validation={share}: must be 0, or a share below 1 that leaves at least "
            f"{_MIN_HR_LEFT} HR training views; variant {variant.id} has {len(views)}"
        )
    order = np.random.default_rng(0).permutation(len(views))
    fold = [int(order[(seed * count + i) % len(views)]) for i in range(count)]
    return [views[i] for i in sorted(fold)]


def _training_views(variant: Variant, use: str) -> list[View]:
    """Select the training views for `use`, in the variant's order."""
    if use not in TRAINING_VIEWS:
        raise XrgsError(f"train.views={use}: must be one of {', '.join(TRAINING_VIEWS)}")
    views = [view for view in variant.views if view.split == "train"]
    if use == "mixed":
        return views
    if use == "all_hr":
        originals = {view.name: view for view in variant.views if view.split == "original"}
        views = [originals.get(view.name, view) for view in views]
        low = [view.name for view in views if view.tag == "LR"]
        if low:
            raise XrgsError(
                f"train.views=all_hr: variant {variant.id} has no original of {low[0]}, which was "
                "not degraded; all_hr is for variants whose LR views were made from HR ones"
            )
        return views
    tag = "HR" if use == "hr_only" else "LR"
    views = [view for view in views if view.tag == tag]
    if not views:
        raise XrgsError(f"train.views={use}: variant {variant.id} has no {tag} training view")
    return views


def _load_view(view: View, viewmat: NDArray[np.float64], *, hide: bool) -> LoadedView:
    """Load a view; with `hide`, pixels outside its mask are replaced (`masks.filled`)."""
    size = view.width, view.height
    camera = Camera(torch.from_numpy(viewmat).float(), torch.from_numpy(view.K).float(), *size)
    # A copy, since PIL's memory is read-only.
    pixels = np.array(images.read_png_pil(view.file, size))
    mask = None if view.mask is None else images.read_mask(view.mask, size)
    if hide:
        pixels = masks.filled(pixels, mask)
    return LoadedView(
        view.name,
        view.tag,
        camera,
        torch.from_numpy(pixels),
        view.sampling_rate,
        None if mask is None else torch.from_numpy(mask),
        view.supersampling,
    )
