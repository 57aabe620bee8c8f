"""The order of the views: epochs, skipped views and continuation from a state."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from xrgs.capture.dataset import Dataset
from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.sampler import EpochSampler
from xrgs.training.seeding import seeded_generator

ALL = ["v0", "v1", "v2", "v3"]


def always(step: Step) -> bool:
    return True


def sampled_names(
    data: Dataset, steps: int, allows_view: Callable[[Step], bool], seed: int = 0
) -> list[str]:
    """The view of each step, after a check that the steps are numbered in turn."""
    sampled = list(EpochSampler(data.train, seed, steps, allows_view))
    assert [(step.number, step.total) for step in sampled] == [(n, steps) for n in range(steps)]
    return [step.view.name for step in sampled]


def epochs(names: list[str], size: int) -> list[tuple[str, ...]]:
    return [tuple(names[start : start + size]) for start in range(0, len(names), size)]


def test_every_view_is_sampled_once_an_epoch_in_a_new_order(data: Dataset) -> None:
    orders = epochs(sampled_names(data, 40, always), 4)
    assert all(sorted(order) == ALL for order in orders)
    assert len(set(orders)) > 1


def test_an_epoch_is_a_permutation_drawn_from_the_seeds_generator(data: Dataset) -> None:
    generator = seeded_generator(5, "views")
    orders = [torch.randperm(4, generator=generator).flip(0).tolist() for _ in range(3)]
    expected = [f"v{i}" for order in orders for i in order]
    assert sampled_names(data, 12, always, seed=5) == expected


def test_a_view_that_is_not_allowed_is_not_sampled(data: Dataset) -> None:
    names = sampled_names(
        data, 40, lambda step: step.number >= 20 or step.view.name in {"v1", "v3"}
    )
    assert all(sorted(order) == ["v1", "v3"] for order in epochs(names[:20], 2))
    assert all(sorted(order) == ALL for order in epochs(names[20:], 4))


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


@pytest.mark.parametrize("steps_before", [0, 5, 8, 40])
def test_a_restored_sampler_continues_with_the_same_views(data: Dataset, steps_before: int) -> None:
    first = EpochSampler(data.train, 0, 40, always)
    for _ in range(steps_before):
        next(first)
    second = EpochSampler(data.train, 0, 40, always)
    second.load_state_dict(first.state_dict())
    assert second.next_step == steps_before
    assert list(second) == list(first)
