"""Each component does its one thing, to the views it is for, and is absent by default."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from xrgs import components
from xrgs.config import (
    ComponentsConf,
    ConsistencyConf,
    GradientScalingConf,
    LossWeightingConf,
)
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import PARAMETERS, Gaussians

FACTOR = 5
HR_SIZE = (60, 75)
LR_SIZE = (12, 15)


@dataclass(frozen=True)
class View:
    name: str
    tag: str
    image: Tensor


def noise(size: tuple[int, int], seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*size, 3, generator=generator, dtype=torch.float64)


HR = View("high", "HR", noise(HR_SIZE, 0))
LR = View("low", "LR", noise(LR_SIZE, 1))


def config(
    *,
    lr_weight: float = 1.0,
    lr_scale: float = 1.0,
    weight: float = 0.0,
    l1: float = 0.8,
    ssim: float = 0.2,
    lr_mode: str = "exact",
) -> ComponentsConf:
    return ComponentsConf(
        LossWeightingConf(lr_weight),
        GradientScalingConf(lr_scale),
        ConsistencyConf(weight, l1, ssim, lr_mode),
    )


def built(conf: ComponentsConf, *views: View) -> components.Components:
    return components.build(conf, views or (HR, LR), FACTOR)


def loss_of(conf: ComponentsConf, image: Tensor, view: View, base: float = 0.0) -> float:
    loss = torch.tensor(base, dtype=torch.float64)
    return built(conf).loss(loss, image, view).item()


def gaussians_with_gradients() -> Gaussians:
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
    generator = torch.Generator().manual_seed(0)
    values = {
        name: torch.randn(6, *shapes.get(name, (3, 3)), generator=generator).requires_grad_()
        for name in PARAMETERS
    }
    for value in values.values():
        value.grad = torch.randn(value.shape, generator=generator)
    return Gaussians(**values)


# --- off ---------------------------------------------------------------------------------------


def test_the_baseline_has_no_component() -> None:
    none = built(config())
    assert none == ()
    loss = torch.tensor(0.3, requires_grad=True)
    assert none.loss(loss, LR.image, LR) is loss
    gaussians = gaussians_with_gradients()
    before = {name: gaussians[name].grad.clone() for name in PARAMETERS}
    none.after_backward(LR, gaussians)
    assert all(torch.equal(gaussians[name].grad, before[name]) for name in PARAMETERS)


def test_a_component_that_overrides_nothing_is_the_identity() -> None:
    loss = torch.tensor(0.3)
    assert components.Component().loss(loss, LR.image, LR) is loss


def test_each_is_on_alone() -> None:
    kinds = {
        components.LossWeighting: config(lr_weight=0.25),
        components.GradientScaling: config(lr_scale=0.3),
        components.Consistency: config(weight=0.1),
    }
    for kind, conf in kinds.items():
        assert [type(component) for component in built(conf)] == [kind]
    every = built(config(lr_weight=0.25, lr_scale=0.3, weight=0.1))
    assert {type(component) for component in every} == set(kinds)


def test_training_needs_no_hydra() -> None:
    code = "import sys, xrgs.components; sys.exit('hydra' in sys.modules)"
    run = subprocess.run([sys.executable, "-P", "-c", code], check=False)
    assert run.returncode == 0


# --- loss weighting ----------------------------------------------------------------------------


def test_the_loss_of_an_lr_view_is_weighted() -> None:
    assert loss_of(config(lr_weight=0.25), LR.image, LR, base=0.8) == 0.2
    assert loss_of(config(lr_weight=0.25), HR.image, HR, base=0.8) == 0.8


def test_its_gradients_are_weighted_with_it() -> None:
    x = torch.tensor(3.0, requires_grad=True)
    built(config(lr_weight=0.25)).loss(x * 2, LR.image, LR).backward()
    assert x.grad == 0.5


# --- gradient scaling --------------------------------------------------------------------------


@pytest.mark.parametrize(("view", "factor"), [(LR, 0.3), (HR, 1.0)])
def test_only_the_scales_gradient_is_scaled(view: View, factor: float) -> None:
    gaussians = gaussians_with_gradients()
    before = {name: gaussians[name].grad.clone() for name in PARAMETERS}
    built(config(lr_scale=0.3)).after_backward(view, gaussians)
    for name in PARAMETERS:
        expected = before[name] * (factor if name == "scales" else 1.0)
        assert torch.equal(gaussians[name].grad, expected), name
    assert (before["scales"] != 0).all()


def test_without_a_gradient_there_is_nothing_to_scale() -> None:
    gaussians = gaussians_with_gradients()
    gaussians.scales.grad = None
    built(config(lr_scale=0.3)).after_backward(LR, gaussians)
    assert gaussians.scales.grad is None


# --- consistency -------------------------------------------------------------------------------


def keys_matrix(size: int, target: int) -> NDArray[np.float64]:
    """[target, size]: Keys' cubic convolution (a = -0.5), stretched when it shrinks."""
    step = size / target
    stretch = max(step, 1.0)
    centre = (np.arange(target)[:, None] + 0.5) * step
    t = np.abs(np.arange(size)[None] + 0.5 - centre) / stretch
    near = 1.5 * t**3 - 2.5 * t**2 + 1
    far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    weights = np.where(t < 1, near, np.where(t < 2, far, 0))
    return weights / weights.sum(axis=1, keepdims=True)


def phi(image: Tensor, height: int, width: int) -> NDArray[np.float64]:
    rows = keys_matrix(image.shape[0], height)
    columns = keys_matrix(image.shape[1], width)
    return np.einsum("ah,hwc,bw->abc", rows, image.numpy(), columns)


def paper_5_6(image: Tensor, view: View, *, weight: float, l1: float, ssim: float) -> float:
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
    return weight * (l1 * float(np.abs(projected - pair).mean()) + ssim * (1 - similarity))


@pytest.mark.parametrize("view", [HR, LR], ids=["HR", "LR"])
@pytest.mark.parametrize(("l1", "ssim"), [(0.8, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_consistency_is_the_papers_formula(view: View, l1: float, ssim: float) -> None:
    image = view.image + 0.4 * (noise(tuple(view.image.shape[:2]), 7) - 0.5)
    expected = paper_5_6(image, view, weight=0.1, l1=l1, ssim=ssim)
    assert expected > 1e-4
    value = loss_of(config(weight=0.1, l1=l1, ssim=ssim), image, view, base=0.5)
    assert value == pytest.approx(0.5 + expected, rel=1e-9)


@pytest.mark.parametrize("view", [HR, LR], ids=["HR", "LR"])
def test_a_render_of_the_photograph_is_consistent(view: View) -> None:
    assert loss_of(config(weight=0.1), view.image, view) == pytest.approx(0, abs=1e-12)


def test_its_gradient_reaches_the_render() -> None:
    for view in (HR, LR):
        image = (view.image * 0.9).requires_grad_()
        zero = torch.tensor(0.0, dtype=torch.float64)
        built(config(weight=0.1)).loss(zero, image, view).backward()
        assert image.grad is not None
        assert (image.grad != 0).float().mean() > 0.9


def test_phi_is_not_clamped() -> None:
    edge = torch.zeros(20, 20, 3)
    edge[:, 10:] = 1.0
    up = components.resize(edge, 100, 100)
    assert up.min() < -0.01
    assert up.max() > 1.01


def test_the_weight_of_a_view_multiplies_its_consistency() -> None:
    image = LR.image * 0.8
    alone = loss_of(config(weight=0.1), image, LR)
    assert alone > 0
    both = loss_of(config(weight=0.1, lr_weight=0.25), image, LR, base=0.5)
    assert both == pytest.approx(0.25 * (0.5 + alone))


def test_pairs_are_made_once() -> None:
    (consistency,) = built(config(weight=0.1))
    assert isinstance(consistency, components.Consistency)
    sizes = {name: tuple(pair.image.shape) for name, pair in consistency.pairs.items()}
    assert sizes == {"high": (*LR_SIZE, 3), "low": (*HR_SIZE, 3)}
    before = dict(consistency.pairs)
    consistency.loss(torch.tensor(0.0), HR.image, HR)
    assert all(consistency.pairs[name] is pair for name, pair in before.items())


def test_off_leaves_lr_views_alone() -> None:
    image = LR.image * 0.8
    loss = torch.tensor(0.5, dtype=torch.float64)
    parts = built(config(weight=0.1, lr_mode="off"))
    assert parts.loss(loss, image, LR) is loss
    expected = loss_of(config(weight=0.1), HR.image * 0.8, HR)
    assert parts.loss(loss, HR.image * 0.8, HR).item() == pytest.approx(0.5 + expected)


def test_fold_is_more_weight_on_l1() -> None:
    image = LR.image + 0.3 * (noise(LR_SIZE, 3) - 0.5)
    error = np.abs(image.numpy() - LR.image.numpy()).mean()
    fold = config(weight=0.1, lr_mode="fold")
    assert loss_of(fold, image, LR, base=0.5) == pytest.approx(0.5 + 0.1 * 0.8 * error, rel=1e-12)
    # HR views are as in the other modes.
    hr = HR.image * 0.8
    assert loss_of(fold, hr, HR) == loss_of(config(weight=0.1), hr, HR)
    (consistency,) = built(fold)
    assert isinstance(consistency, components.Consistency)
    assert set(consistency.pairs) == {"high"}  # nothing is upsampled


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("one sign", 0.99, 1.01), ("smooth", 0.99, 1.01), ("white", 1.15, 1.3)],
)
def test_how_far_fold_is_from_exact(kind: str, low: float, high: float) -> None:
    size = (40, 50)
    error = {
        "one sign": noise(size, 5),
        "smooth": components.resize(noise((4, 5), 5) - 0.5, *size),
        "white": torch.randn(
            *size, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64
        ),
    }[kind]
    view = View("low", "LR", noise(size, 6))
    zero = torch.tensor(0.0, dtype=torch.float64)
    fold, exact = (
        built(config(weight=0.1, l1=1.0, ssim=0.0, lr_mode=mode), view).loss(
            zero, view.image + error, view
        )
        for mode in ("fold", "exact")
    )
    assert low < (fold / exact).item() < high


# --- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(10, 15), (15, 10)])
def test_an_lr_image_smaller_than_the_window_is_refused(size: tuple[int, int]) -> None:
    hr = View("wide", "HR", noise((size[0] * FACTOR, size[1] * FACTOR), 0))
    with pytest.raises(XrgsError, match=rf"variant\.factor=5: view wide.*{size[1]} x {size[0]} px"):
        built(config(weight=0.1), hr)
    assert built(config(), hr) == ()


@pytest.mark.parametrize(
    ("conf", "key"),
    [
        (config(lr_weight=-0.1), "components.loss_weighting.lr_weight=-0.1"),
        (config(lr_weight=float("nan")), "components.loss_weighting.lr_weight=nan"),
        (config(lr_scale=float("inf")), "components.gradient_scaling.lr_scale=inf"),
        (config(weight=-1.0), "components.consistency.weight=-1.0"),
        (config(l1=-1.0), "components.consistency.l1=-1.0"),
        (config(ssim=-1.0), "components.consistency.ssim=-1.0"),
        (config(weight=0.1, lr_mode="folded"), "components.consistency.lr_mode=folded"),
    ],
)
def test_a_value_out_of_range_names_its_key(conf: ComponentsConf, key: str) -> None:
    with pytest.raises(XrgsError) as caught:
        built(conf)
    assert str(caught.value).startswith(key)


@pytest.mark.parametrize(("height", "width"), [(15, 20), (75, 100), (100, 37)])
def test_phi_is_torchs_antialiased_bicubic(height: int, width: int) -> None:
    image = torch.rand(45, 60, 3, dtype=torch.float64)
    planes = image.permute(2, 0, 1)[None]
    expected = torch.nn.functional.interpolate(
        planes, size=(height, width), mode="bicubic", antialias=True
    )[0].permute(1, 2, 0)
    torch.testing.assert_close(components.resize(image, height, width), expected, rtol=0, atol=1e-9)
