"""Loads a variant into memory: images as tensors, cameras and points in the normalised world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from xrgs.errors import XrgsError
from xrgs.photos import images, masks
from xrgs.runtime.progress import progress
from xrgs.splat.cameras import Camera
from xrgs.splat.normalize import NormalizedScene, normalize_scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from xrgs.mixture.views import Variant, View

#: The values of `train.views`: which training views a cell uses.
USES = ("mixed", "all_hr", "hr_only", "lr_only")
#: HR training views that `train.validation` must leave to train on; our choice.
_MIN_HR_LEFT = 2


@dataclass(frozen=True)
class LoadedView:
    """One view in memory, with its photograph in 8 bits: a quarter of what float32 takes."""

    name: str
    tag: str
    """`HR` or `LR`."""
    camera: Camera
    pixels: torch.Tensor
    """[H, W, 3], uint8 as the file has them; floats are taken as they are, in 0..1."""
    sampling_rate: float = 1.0
    """The relative sampling rate in (0, 1], see `xrgs.mixture.views.View`."""
    mask: torch.Tensor | None = None
    """[H, W] bool, True for a pixel that is used; None uses all."""
    supersampling: float = 1.0
    """How many times as many px a side the view needs, see `xrgs.mixture.views.View`."""

    def to(self, device: str) -> LoadedView:
        """Return the view with its photograph and mask on a device; its camera stays."""
        mask = None if self.mask is None else self.mask.to(device)
        return replace(self, pixels=self.pixels.to(device), mask=mask)

    @property
    def image(self) -> torch.Tensor:
        """The photograph [H, W, 3] in 0..1: a new float32 tensor of `pixels` / 255."""
        if self.pixels.is_floating_point():
            return self.pixels
        return self.pixels.float().div_(255)  # in place: new memory takes longer than the division


@dataclass(frozen=True)
class Dataset:
    """What a cell trains and is evaluated on, in gsplat's normalised world."""

    train: tuple[LoadedView, ...]
    test: tuple[LoadedView, ...]
    """The views that are scored: the variant's test views, or with `train.validation` the HR
    training views that are held out."""
    points: torch.Tensor
    """SfM points [P, 3], float32."""
    colors: torch.Tensor
    """Their colours [P, 3], float32 in 0..1."""
    scene_scale: float
    """The unit of the learning rate of means and of the size thresholds, see
    `xrgs.splat.normalize`."""
    factor: int
    """How many times fewer pixels per side the method takes LR views to have."""
    degradation: str = "downsample"
    """How LR views were made of HR ones, a key of `xrgs.mixture.degradations.DEGRADATIONS`, or
    `none` where a camera took them."""

    @property
    def view_pixels(self) -> int:
        """The most pixels of a training view, the unit of budgets of Gaussians; 0 without views."""
        return max((view.camera.width * view.camera.height for view in self.train), default=0)


def load(
    variant: Variant, use: str = "mixed", *, validation: float = 0.0, seed: int = 0
) -> Dataset:
    """Read a variant's images and normalise its world.

    Poses, points and world depend neither on `use` nor on `validation`: SfM has placed held-out
    training views among the others, as it has placed test views. The controls differ from `mixed`
    in the training views alone.

    Args:
        variant: The frozen variant.
        use: Which training views to load: `mixed` for all as they are, `all_hr` with the originals
            in the place of the degraded ones, `hr_only` and `lr_only` for views of one tag.
        validation: Share of the HR training views that are held out and scored in place of the
            test views, which are not read then: round(validation * n) of n, at least one. 0 scores
            the test views.
        seed: The cell's seed, which chooses the held-out views: the seeds 0, 1, ... hold out one
            part of the HR views after another, so that 1 / `validation` seeds are the folds of a
            cross-validation. The choice depends on the variant, `validation` and `seed` alone.

    Returns:
        The dataset, with views in the order of the variant.

    Raises:
        UnreadableError: An image can't be read now.
        ImageError: An image is missing, unreadable or not of its view's size; the message names it.
        XrgsError: The variant has no such views, too few HR training views are left, or its cameras
            and points can't be normalised; the message names the key.
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
    # An original has the pose of the training view that it replaces.
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
    """Normalise the world of a variant; given poses need not be of the points' world."""
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return normalize_scene(np.stack([view.viewmat for view in posed]), variant.points)
    except (FloatingPointError, ValueError, np.linalg.LinAlgError) as error:
        why = f"its cameras and points can't be of one scene ({error})"
        raise XrgsError(f"{variant.folder}: {why}") from error


def _held_out(variant: Variant, share: float, seed: int) -> list[View]:
    """Choose the HR training views that are scored and not trained on, in the variant's order."""
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
    """Select the training views that `use` names, in the variant's order."""
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
    """Load a view; with `hide`, what is outside its mask is not loaded (`masks.filled`)."""
    camera = Camera(
        viewmat=torch.from_numpy(viewmat).float(),
        K=torch.from_numpy(view.K).float(),
        width=view.width,
        height=view.height,
    )
    size = view.width, view.height
    # A copy, since the array of PIL's memory is read-only.
    pixels = np.array(images.read_png_pil(view.file, size))
    mask = None if view.mask is None else images.read_mask(view.mask, size)
    if hide:
        pixels = masks.filled(pixels, mask)
    used = None if mask is None else torch.from_numpy(mask)
    return LoadedView(
        view.name,
        view.tag,
        camera,
        torch.from_numpy(pixels),
        view.sampling_rate,
        used,
        view.supersampling,
    )
