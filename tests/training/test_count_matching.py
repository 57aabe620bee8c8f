"""Count matching: the search for the threshold, the check that ends a run, and both together."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import composed as compose
from tests.training.conftest import same
from xrgs.config import Conf
from xrgs.errors import XrgsError
from xrgs.splat.gaussians import Gaussians
from xrgs.training import count_matching, loop
from xrgs.training.components import Step
from xrgs.training.count_matching import (
    CountCheck,
    CountMismatchError,
    ThresholdSearch,
    next_threshold,
    train_cell,
)
from xrgs.training.dataset import Dataset
from xrgs.training.recorder import TrainingResult

TOLERANCE = 0.05


def simulated_training(
    power: float, at_start: int, target: int, ripple: float = 0.0
) -> tuple[Callable[[float], float], list[float]]:
    """A training that gives `at_start` Gaussians at 2e-4 and fewer with a higher threshold.

    It returns its threshold; the list has those that it was called with.
    """
    thresholds: list[float] = []

    def train_at(threshold: float) -> float:
        thresholds.append(threshold)
        wave = 1 + ripple * math.sin(1e6 * threshold)
        count = round(at_start * wave * (threshold / 2e-4) ** -power)
        if abs(count / target - 1) > TOLERANCE:
            raise CountMismatchError(count)
        return threshold

    return train_at, thresholds


@pytest.mark.slow
@given(
    power=st.floats(0.4, 4.0),
    at_start=st.integers(2_000, 1_000_000),
    share=st.floats(0.05, 2.0),
    ripple=st.floats(0.0, 0.02),
)
def test_a_threshold_is_found_in_few_attempts(
    power: float, at_start: int, share: float, ripple: float
) -> None:
    target = round(at_start * share)
    train_at, thresholds = simulated_training(power, at_start, target, ripple)
    threshold = ThresholdSearch(2e-4, target).run(train_at)
    assert threshold == thresholds[-1]
    assert len(thresholds) <= 8
    assert (threshold > 2e-4) == (len(thresholds) > 1 and share < 1)


def test_a_number_that_no_threshold_gives_is_an_error_after_ten_attempts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    calls = []

    def train_at(threshold: float) -> None:
        calls.append(threshold)
        raise CountMismatchError(500 if threshold > 3e-4 else 50_000)

    with (
        caplog.at_level("INFO"),
        pytest.raises(XrgsError, match=r"count_matched\.gaussians=5000: .*0\.0002: 50000"),
    ):
        ThresholdSearch(2e-4, 5000).run(train_at)
    assert len(calls) == len(caplog.messages) == 10
    assert caplog.messages[0].endswith("threshold 0.0002 gave 50000 Gaussians, the target is 5000")


POWER = 2.3


@pytest.mark.parametrize(
    ("tried", "target", "expected"),
    [
        # The second threshold assumes a power of one and a half.
        ([(2e-4, 8000)], 1000, 2e-4 * 8 ** (2 / 3)),
        # The secant through two attempts finds a power law at once.
        ([(2e-4, 100_000), (5e-4, round(100_000 * 2.5**-POWER))], 10_000, 2e-4 * 10 ** (1 / POWER)),
        # A higher threshold gave more Gaussians: the slope has the wrong sign.
        ([(2e-4, 1000), (3e-4, 1010)], 500, 3e-4 * (1010 / 500) ** 2),
        # A fall so steep that the slope would hardly step.
        ([(2e-4, 10_000), (2.1e-4, 1000)], 500, 2.1e-4 * 2**0.2),
        # The secant of the last two leads to 9.6e-4 and more, beyond what gave too few.
        ([(9e-4, 400), (2e-4, 1000), (4e-4, 990)], 500, math.sqrt(4e-4 * 9e-4)),
        # Too many at the higher threshold, too few at the lower one: one of them is noise.
        ([(3e-4, 600), (2e-4, 450)], 500, 2e-4 * (450 / 500) ** 2 / 1.1),
        ([(2e-4, 450), (3e-4, 600)], 500, 3e-4 * (600 / 500) ** 2 * 1.1),
        # A count of zero is no obstacle.
        ([(2e-4, 0)], 500, 2e-4 * 500 ** (-1 / 1.5)),
        ([(2e-4, 1000), (9e-4, 0)], 500, math.sqrt(2e-4 * 9e-4)),
    ],
)
def test_the_next_threshold(tried: list[tuple[float, int]], target: int, expected: float) -> None:
    assert next_threshold(tried, target) == pytest.approx(expected, rel=1e-4)


def model_of(count: int) -> Gaussians:
    """A model of so many Gaussians."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator)
    return Gaussians.from_points(points, points, init_opacity=0.1, sh_degree=0, generator=generator)


@pytest.mark.parametrize(("count", "mismatch"), [(150, False), (151, True), (49, True)])
def test_the_count_is_checked_once_densification_has_stopped(
    count: int, mismatch: bool, data: Dataset
) -> None:
    check, gaussians = CountCheck(100, 0.5, stop=15_000), model_of(count)
    check.after_backward(gaussians, Step(1499, 3000, data.train[0]))
    stopped = Step(1500, 3000, data.train[0])
    checks: tuple[Callable[[], None], ...] = (
        lambda: check.after_backward(gaussians, stopped),
        lambda: check.after_training(gaussians),
    )
    for checked in checks:
        if mismatch:
            with pytest.raises(CountMismatchError) as raised:
                checked()
            assert raised.value.count == count
        else:
            checked()


@pytest.mark.slow
def test_the_matched_run_is_the_plain_run_with_its_threshold(
    data: Dataset, short: Conf, trained: TrainingResult
) -> None:
    target = round(0.8 * len(trained.gaussians))
    short.components.count_matched.gaussians = target
    matched = train_cell(data, short)
    assert abs(len(matched.gaussians) / target - 1) <= short.components.count_matched.tolerance
    assert matched.grow_grad2d > trained.grow_grad2d == short.splat.densify.grow_grad2d
    short.splat.densify.grow_grad2d = matched.grow_grad2d
    # A single training does not read the count.
    assert same(loop.train(data, short).gaussians, matched.gaussians)


@pytest.mark.slow
def test_mcmc_takes_the_count_as_its_budget(data: Dataset) -> None:
    overrides = "train.steps=60", "splat.densify.every=1500", "splat.backend=auto"
    conf = compose("+ablation=mcmc", *overrides)
    conf.components.count_matched.gaussians = 100
    assert len(train_cell(data, conf).gaussians) == 100
    conf.components.count_matched.gaussians = 10**6
    with pytest.raises(XrgsError, match=r"gaussians=1000000: splat\.strategy=mcmc ended with \d+;"):
        train_cell(data, conf)


@pytest.mark.parametrize(
    ("name", "value"),
    [("gaussians", -1), ("tolerance", math.nan)],
)
def test_a_value_out_of_range_names_its_key(
    name: str, value: float, data: Dataset, short: Conf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(count_matching, "train", lambda *_: pytest.fail("training has begun"))
    setattr(short.components.count_matched, name, value)
    with pytest.raises(XrgsError, match=rf"^components\.count_matched\.{name}={value}"):
        train_cell(data, short)
