"""Training inside masks: closed forms, and the same bits whatever a mask hides."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from tests.conftest import composed as compose
from tests.splat.scenes import noise
from tests.training.components.conftest import make_view
from tests.training.components.test_mip import CLOSE, FAR
from tests.training.conftest import comparable
from xrgs.evaluation import protocol
from xrgs.mixture.views import Variant, View
from xrgs.photos import images
from xrgs.splat.gaussians import Gaussians
from xrgs.splat.loss import photometric_loss, prepare_target
from xrgs.splat.rendering import attribute_pixels, rasterize_parameters
from xrgs.splat.strategy.default import DefaultStrategy
from xrgs.store.trimming import texture
from xrgs.training import dataset
from xrgs.training.components.mip import sampling_rates
from xrgs.training.components.weighting import _box_mean, mean_gradient, region_attenuations
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.rendering import inside_mask
from xrgs.training.seeding import seeded_generator

SIZES = {"HR": (36, 28), "LR": (18, 14)}


def left_half(view_size: tuple[int, int]) -> NDArray[np.bool_]:
    """The left half is used, and one pixel on the right."""
    width, height = view_size
    mask = np.zeros((height, width), np.bool_)
    mask[:, : width // 2] = True
    mask[2, width - 3] = True
    return mask


# what a mask hides


def frozen(folder: Path, seed: int) -> Variant:
    """Two HR and two LR views and a test view, of which most have noise of `seed` under a mask."""
    rng, hidden = np.random.default_rng(0), np.random.default_rng(seed)
    folder.mkdir()
    views = []
    for number, (split, tag) in enumerate(
        [("train", "HR"), ("train", "LR"), ("train", "HR"), ("train", "LR"), ("test", "HR")]
    ):
        (width, height), mask = SIZES[tag], None
        smooth = Image.fromarray(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8))
        pixels = np.asarray(smooth.resize((width, height), Image.Resampling.BICUBIC))
        if number != 2:
            used = left_half((width, height))
            mask = folder / "masks" / f"v{number}.png"
            images.save_mask(mask, used)
            noise_under = hidden.integers(0, 255, pixels.shape, dtype=np.uint8)
            pixels = np.where(used[..., None], pixels, noise_under)
        file = folder / "images" / f"v{number}.png"
        images.save(file, pixels.astype(np.float32) / np.float32(255))
        viewmat = np.eye(4)
        viewmat[:2, 3] = 0.1 * number, 0.05 * (number % 2)
        K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        rho = width / 36
        views.append(View(f"v{number}", file, split, tag, width, height, K, viewmat, rho, mask))
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (80, 3))
    colors = rng.integers(0, 255, (80, 3), dtype=np.uint8)
    return Variant("id", folder, "x", 2, True, tuple(views), points, colors, {})


#: Every component that reads photographs, errors or gradients.
COMPONENTS = (
    "components.loss_weighting.lr_weight=0.5",
    "components.adaptive_weighting.texture=0.3",
    "components.region_weighting.texture=0.3",
    "components.consistency.weight=0.1",
    "components.mip.variance=0.2",
    "components.supersampled.factor=2",
    "components.resolution_schedule.start_share=0.3",
    "splat.densify.budget=0.05",
)


@pytest.mark.slow
@pytest.mark.parametrize("components", [(), COMPONENTS], ids=["baseline", "components"])
def test_hidden_pixels_change_no_bit_of_training_and_no_score(
    tmp_path: Path, backend: str, components: tuple[str, ...]
) -> None:
    conf = compose(
        f"splat.backend={backend}",
        *("train.steps=9", "splat.densify.start=0", "splat.densify.every=10000"),
        *("splat.densify.grow_grad2d=1e-4", *components),
    )
    results, scores = [], []
    for seed in (1, 2):
        data = dataset.load(frozen(tmp_path / str(seed), seed))
        results.append(train(data, conf))
        scores.append(protocol.mean_scores(results[-1].gaussians, data.test, conf.splat))
    assert len(results[0].gaussians) != 80  # densification took part
    assert comparable(results[0]) == comparable(results[1])
    assert scores[0]["psnr"] == scores[1]["psnr"]
    assert scores[0]["ssim"] == scores[1]["ssim"]
    assert scores[0]["psnr_plain"] != scores[1]["psnr_plain"]


# loss and statistics


def test_a_mask_takes_the_loss_outside_and_changes_no_gradient_far_inside(backend: str) -> None:
    photograph, mask = noise(48, 60).float(), torch.from_numpy(left_half((60, 48)))
    gradients, losses = [], []
    target = prepare_target(photograph)
    for used in (None, mask):
        image = noise(48, 60, 1).float().requires_grad_()
        composed = inside_mask(image, photograph, used)
        loss = photometric_loss(composed, target, l1=0.8, ssim=0.2, backend=backend)
        torch.autograd.backward(loss)
        assert image.grad is not None
        gradients.append(image.grad)
        losses.append(loss.item())
    whole, masked = gradients
    assert (masked[~mask] == 0).all()
    assert torch.equal(masked[:, :19], whole[:, :19])  # 11 px from the border
    assert (masked[:, 29] != whole[:, 29]).any()
    assert masked[2, 57].abs().min() > 0
    assert losses[1] < losses[0]
    # It stays a mean over all pixels.
    loss = photometric_loss(composed, target, l1=1, ssim=0, backend=backend)
    expected = (image.double() - photograph.double())[mask].abs().sum() / photograph.numel()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("absgrad", ["false", "true"])
def test_a_view_counts_for_the_gaussians_that_it_shows_inside_its_mask(
    data: Dataset, monkeypatch: pytest.MonkeyPatch, backend: str, absgrad: str
) -> None:
    """Against the sums of the Gaussians' weights in the used pixels, in the first step."""
    mask = torch.from_numpy(left_half((60, 60)))
    conf = compose("train.steps=1", f"splat.backend={backend}", f"splat.raster.absgrad={absgrad}")
    seen: list[tuple[Tensor, Tensor]] = []
    after_step = DefaultStrategy.after_step

    def watched(self: Any, step: int, grad2d: Tensor, visible: Tensor, **others: Any) -> Any:
        used = attribute_pixels(
            mask.float(),
            start.activated(backend=backend),
            view.camera,
            conf.splat.raster,
            backend=backend,
        ).sums
        seen.append((visible.clone(), used > 0))
        return after_step(self, step, grad2d, visible, **others)

    view = replace(data.train[0], mask=mask, pixels=noise(60, 60).float())
    points = 0.8 * (torch.rand(2000, 3, generator=torch.Generator().manual_seed(4)) - 0.5)
    points[:, 2] += 2
    only = replace(data, train=(view,), points=points, colors=points.abs().clamp(0, 1))
    start = Gaussians.from_points(
        only.points,
        only.colors,
        init_opacity=conf.splat.init_opacity,
        sh_degree=3,
        generator=seeded_generator(conf.seed, "init"),
    )
    monkeypatch.setattr(DefaultStrategy, "after_step", watched)
    train(only, conf)
    ((visible, expected),) = seen
    assert torch.equal(visible, expected)
    assert 0.2 < visible.float().mean() < 0.8
    plain = rasterize_parameters(
        *start.activated(backend=backend),
        view.camera,
        conf.splat.raster,
        sh_degree=0,
        backend=backend,
    ).visible
    assert plain.sum() > visible.sum()


# components


def test_the_texture_inside_a_mask_is_the_texture_of_the_part() -> None:
    image, mask = noise(20, 30), torch.zeros(20, 30, dtype=torch.bool)
    mask[4:14, 5:25] = True
    part = image[4:14, 5:25].numpy()
    assert mean_gradient(image, mask) == pytest.approx(texture(part), rel=1e-6)
    assert texture(image.numpy(), mask.numpy()) == pytest.approx(texture(part), rel=1e-12)
    assert mean_gradient(image, torch.zeros_like(mask)) == 0
    assert np.isnan(texture(image.numpy(), np.zeros((20, 30), np.bool_)))


def test_the_mean_of_a_window_is_over_its_used_pixels() -> None:
    values, mask = noise(12, 15)[..., 0], torch.from_numpy(left_half((15, 12)))
    means = _box_mean(values, mask)
    for row in range(12):
        for column in range(15):
            window = (
                slice(max(0, row - 2), row + 3),
                slice(max(0, column - 2), column + 3),
            )
            if mask[window].any():
                expected = values[window][mask[window]].mean()
                assert means[row, column].item() == pytest.approx(expected.item(), rel=1e-5)


def test_the_attenuation_of_a_view_has_the_mean_of_its_used_pixels() -> None:
    high, low = make_view("HR", noise(60, 75).float()), make_view("LR", noise(12, 15, 1).float())
    mask = torch.from_numpy(left_half((15, 12)))
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    points[:, 2] += 2
    given_views = [high, replace(low, mask=mask)]
    (region,) = region_attenuations(given_views, points, texture=5.0, near=0.01).values()
    assert 0 < region[mask].mean() < 1
    assert region.mean().item() == pytest.approx(region[mask].mean().item(), rel=1e-6)


def test_a_masked_pixel_sets_no_sampling_rate() -> None:
    mask = torch.ones(40, 40, dtype=torch.bool)
    mask[:, 25:] = False  # 0.2 and more to the right of the axis of `FAR`
    means = torch.tensor([[0.0, 0.0, 0.0], [0.19, 0.3, 0.0], [0.21, 0.3, 0.0], [0.85, 0.0, 0.0]])
    rates = sampling_rates(means, [FAR, CLOSE], 0.01, [mask, None])
    assert rates.tolist() == [25.0, 25.0, 20.0, 20.0]
    assert sampling_rates(means, [FAR], 0.01, [~mask]).tolist() == [0.0, 0.0, 25.0, 25.0]
