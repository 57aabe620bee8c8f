"""Section 5.6 against its formula in float64, and its cheaper modes against the exact one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.splat.scenes import noise
from tests.training.components.conftest import NO_GAUSSIANS, Build, make_view
from xrgs.config import ComponentsConf, ConsistencyConf
from xrgs.errors import XrgsError
from xrgs.training.components import Components, Step, TrainingView
from xrgs.training.components.consistency import Consistency

HR_SIZE, LR_SIZE = (60, 75), (12, 15)


@pytest.fixture
def on(off: ComponentsConf) -> ComponentsConf:
    off.consistency.weight = 0.1
    return off


def loss_of(parts: Components, image: Tensor, step: Step, base: float = 0.0) -> float:
    return parts.modify_loss(
        torch.tensor(base, dtype=torch.float64), image, NO_GAUSSIANS, step
    ).item()


def keys_matrix(size: int, target: int) -> NDArray[np.float64]:
    """[target, size]: Keys' cubic convolution (a = -0.5), stretched when it shrinks."""
    step = size / target
    stretch = max(step, 1.0)
    centre = (np.arange(target)[:, None] + 0.5) * step
    t = np.abs(np.arange(size)[None] + 0.5 - centre) / stretch
    near = 1.5 * t**3 - 2.5 * t**2 + 1
    far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    weights = np.where(t < 1, near, np.where(t < 2, far, 0))
    normalised: NDArray[np.float64] = weights / weights.sum(axis=1, keepdims=True)
    return normalised


def phi(image: Tensor, height: int, width: int) -> NDArray[np.float64]:
    rows = keys_matrix(image.shape[0], height)
    columns = keys_matrix(image.shape[1], width)
    projected: NDArray[np.float64] = np.einsum("ah,hwc,bw->abc", rows, image.numpy(), columns)
    return projected


def paper_5_6(image: Tensor, view: TrainingView, *, weight: float, l1: float, ssim: float) -> float:
    """The formula of the paper, in numpy and scikit-image."""
    from skimage.metrics import structural_similarity

    size = LR_SIZE if view.tag == "HR" else HR_SIZE
    projected, pair = phi(image, *size), phi(view.image, *size)
    similarity = structural_similarity(
        projected,
        pair,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    return weight * (l1 * float(np.abs(projected - pair).mean()) + ssim * (1 - float(similarity)))


@pytest.mark.parametrize(
    ("tag", "l1", "ssim"), [("HR", 0.8, 0.2), ("LR", 0.8, 0.2), ("LR", 1.0, 0.0), ("HR", 0.0, 1.0)]
)
def test_it_is_the_papers_formula(
    tag: str, l1: float, ssim: float, build: Build, on: ComponentsConf, steps: dict[str, Step]
) -> None:
    step = steps[tag]
    photograph = step.view.image
    image = photograph + 0.4 * (noise(photograph.shape[0], photograph.shape[1], 7) - 0.5)
    expected = paper_5_6(image, step.view, weight=0.1, l1=l1, ssim=ssim)
    assert expected > 1e-4
    on.consistency.l1, on.consistency.ssim = l1, ssim
    value = loss_of(build(on), image, step, base=0.5)
    assert value == pytest.approx(0.5 + expected, rel=1e-9)
    assert step.log == {f"consistency.{tag}": pytest.approx(expected)}
    on.loss_weighting.lr_weight = 0.25  # multiplies it too
    weighted = loss_of(build(on), image, step, base=0.5)
    assert weighted == pytest.approx((0.25 if tag == "LR" else 1) * value, rel=1e-9)


def test_fold_is_more_weight_on_l1(build: Build, on: ComponentsConf, hr: Step, lr: Step) -> None:
    exact = loss_of(build(on), hr.view.image * 0.8, hr)
    image = lr.view.image + 0.3 * (noise(*LR_SIZE, 3) - 0.5)
    error = np.abs(image.numpy() - lr.view.image.numpy()).mean()
    on.consistency.lr_mode = "fold"
    parts = build(on)
    assert loss_of(parts, image, lr, base=0.5) == pytest.approx(0.5 + 0.1 * 0.8 * error, rel=1e-12)
    # HR views are as in the other modes.
    assert loss_of(parts, hr.view.image * 0.8, hr) == exact
    (consistency,) = parts
    assert isinstance(consistency, Consistency)
    assert set(consistency.paired_targets) == {"hr"}  # nothing is upsampled
    on.consistency.lr_mode = "off"
    loss = torch.tensor(0.5, dtype=torch.float64)
    assert build(on).modify_loss(loss, image, NO_GAUSSIANS, lr) is loss


@pytest.mark.parametrize(
    ("size", "paired"), [((24, 30), (48, 60)), ((24, 36), (12, 18)), ((28, 35), (56, 70))]
)
def test_the_opposite_resolution_of_an_lr_view_goes_by_its_size(
    size: tuple[int, int], paired: tuple[int, int]
) -> None:
    """HR views are 50 px long and the factor is 2, so that 50 / sqrt(2) = 35.4 px separates."""
    views = [make_view("HR", noise(40, 50, 0)), make_view("LR", noise(*size, 1))]
    settings = ConsistencyConf(weight=0.1, l1=0.8, ssim=0.2, lr_mode="exact")
    targets = Consistency(settings, views, factor=2).paired_targets
    assert targets["lr"].image.shape[:2] == paired
    assert targets["hr"].image.shape[:2] == (20, 25)


def test_an_lr_view_of_full_size_is_compared_below_it(
    build: Build, on: ComponentsConf, hr: Step
) -> None:
    zoomed = make_view("LR", noise(*HR_SIZE, 3))
    as_hr = make_view("HR", zoomed.image)
    image = zoomed.image * 0.9
    with pytest.raises(XrgsError, match=r"variant\.factor=5: view hr.*10 x 15 px"):
        build(on, make_view("HR", noise(75, 50, 0)))  # smaller than the window of SSIM
    value = loss_of(build(on, hr.view, zoomed), image, Step(0, 30_000, zoomed))
    assert value == pytest.approx(paper_5_6(image, as_hr, weight=0.1, l1=0.8, ssim=0.2), rel=1e-9)
