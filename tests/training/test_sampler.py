"""The order of the views: epochs, skipped views and continuation from a state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.dataset import Dataset
from xrgs.training.sampler import EpochSampler
from xrgs.training.seeding import seeded_generator

ALL = ["v0", "v1", "v2", "v3"]


def always(step: Step) -> bool:
    return True


def sampled_names(
    data: Dataset,
    steps: int,
    allows_view: Callable[[Step], bool],
    seed: int = 0,
    hr_share: float = 0.0,
) -> list[str]:
    """The view of each step, after a check that the steps are numbered in turn."""
    sampled = list(EpochSampler(data.train, seed, steps, allows_view, hr_share))
    assert [(step.number, step.total) for step in sampled] == [(n, steps) for n in range(steps)]
    return [step.view.name for step in sampled]


def epochs(names: list[str], size: int) -> list[tuple[str, ...]]:
    return [tuple(names[start : start + size]) for start in range(0, len(names), size)]


def test_an_epoch_is_a_permutation_drawn_from_the_seeds_generator(data: Dataset) -> None:
    generator = seeded_generator(5, "views")
    orders = [torch.randperm(4, generator=generator).flip(0).tolist() for _ in range(3)]
    expected = [f"v{i}" for order in orders for i in order]
    assert sampled_names(data, 12, always, seed=5) == expected


def test_a_view_that_becomes_allowed_takes_part_from_the_next_epoch_on(data: Dataset) -> None:
    names = sampled_names(data, 19, lambda step: step.number >= 4 or step.view.name != "v2")
    # Step 4 is the second of the second epoch of three views.
    assert all(sorted(order) == ["v0", "v1", "v3"] for order in epochs(names[:6], 3))
    assert all(sorted(order) == ALL for order in epochs(names[6:18], 4))


def test_a_view_that_is_no_longer_allowed_is_skipped_within_the_epoch(data: Dataset) -> None:
    for seed in range(8):  # in some epochs it would have been next, in others later
        names = sampled_names(
            data, 40, lambda step: step.number < 2 or step.view.name != "v2", seed
        )
        assert "v2" not in names[2:]
        first = names[: 4 if "v2" in names[:2] else 3]
        assert len(set(first)) == len(first)


def test_it_is_an_error_where_no_view_is_allowed(data: Dataset) -> None:
    with pytest.raises(XrgsError, match=r"step 7: the components .* leave no view to train on"):
        sampled_names(data, 40, lambda step: step.number < 7)


#: HR views of `data`.
HIGH = {"v0", "v2"}


@pytest.mark.parametrize(("share", "seed"), [(0.51, 0), (0.9, 7)])
def test_a_share_of_hr_views_holds_in_every_window(data: Dataset, share: float, seed: int) -> None:
    steps = 30_000
    names = sampled_names(data, steps, always, seed, share)
    high = np.array([name in HIGH for name in names])
    excess = np.cumsum(high) - share * np.arange(1, steps + 1)
    assert excess.max() - excess.min() < 5
    for every in (2, 4, 100):  # where shN moves, where Gaussians are refined
        excess = np.cumsum(high[::every] - share)
        assert excess.max() - excess.min() < 7


def test_each_class_has_epochs_of_its_own(data: Dataset) -> None:
    names = sampled_names(data, 4000, always, hr_share=0.8)
    for members in (HIGH, {"v1", "v3"}):
        orders = epochs([name for name in names if name in members], 2)[:-1]
        assert all(set(order) == members for order in orders)
        assert len(set(orders)) == 2
    high = [[name in HIGH for name in sampled_names(data, 400, always, n, 0.8)] for n in (0, 1)]
    assert high[0] != high[1]  # the seed decides which steps draw HR views


@pytest.mark.parametrize(("share", "tags"), [(0.5, "HR LR HR LR"), (0.5, "LR LR LR LR")])
def test_where_no_class_has_too_few_views_each_view_is_drawn_once_an_epoch(
    data: Dataset, share: float, tags: str
) -> None:
    views = zip(data.train, tags.split(), strict=True)
    tagged = replace(data, train=tuple(replace(view, tag=tag) for view, tag in views))
    assert sampled_names(tagged, 50, always, hr_share=share) == sampled_names(tagged, 50, always)


def test_a_class_that_is_not_allowed_leaves_its_draws_to_the_other(data: Dataset) -> None:
    names = sampled_names(
        data, 2000, lambda step: step.number >= 999 or step.view.tag == "LR", hr_share=0.6
    )
    assert all(set(order) == {"v1", "v3"} for order in epochs(names[:998], 2))
    assert sum(name in HIGH for name in names[999:]) == pytest.approx(0.6 * 1001, abs=4)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_sampler_continues_from_its_state(data: Dataset, share: float) -> None:
    first, second = (EpochSampler(data.train, 3, 50, always, share) for _ in range(2))
    for _ in range(17):
        next(first)
    second.load_state_dict(first.state_dict())
    assert list(first) == list(second)
    with pytest.raises(ValueError, match="zip"):  # not the epochs of the other share
        EpochSampler(data.train, 3, 50, always, 0.6 - share).load_state_dict(first.state_dict())
