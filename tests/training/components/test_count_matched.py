"""The baseline with another cell's number of Gaussians: the search for its threshold."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xrgs.config import CountMatchedConf
from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.components.count_matched import CountMatched, CountOff, Search

WITHIN = 0.05


def trainer(power: float, at_start: int, wanted: int, ripple: float = 0.0):
    """A run whose count is `at_start` at 2e-4 and falls with the threshold, which it gives back."""
    thresholds = []

    def run(threshold: float) -> float:
        thresholds.append(threshold)
        wave = 1 + ripple * math.sin(1e6 * threshold)
        count = round(at_start * wave * (threshold / 2e-4) ** -power)
        if abs(count / wanted - 1) > WITHIN:
            raise CountOff(count)
        return threshold

    return run, thresholds


@given(
    power=st.floats(0.4, 4.0),
    at_start=st.integers(2_000, 1_000_000),
    share=st.floats(0.05, 2.0),
    ripple=st.floats(0.0, 0.02),
)
def test_a_threshold_is_found_in_few_runs(
    power: float, at_start: int, share: float, ripple: float
) -> None:
    wanted = round(at_start * share)
    run, thresholds = trainer(power, at_start, wanted, ripple)
    found = Search(2e-4, wanted)(run)
    assert found == thresholds[-1]
    assert len(thresholds) <= 8
    assert (found > 2e-4) == (len(thresholds) > 1 and share < 1)


def test_the_first_threshold_is_kept_where_it_suits() -> None:
    run, thresholds = trainer(1.5, 1000, 1010)
    assert Search(2e-4, 1010)(run) == 2e-4
    assert thresholds == [2e-4]


def test_a_number_out_of_reach_is_said() -> None:
    def run(threshold: float) -> None:
        raise CountOff(500 if threshold > 3e-4 else 50_000)

    with pytest.raises(XrgsError, match=r"count_matched\.gaussians=5000.*0\.0002: 50000"):
        Search(2e-4, 5000)(run)


class Many:
    """As many as its length says."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count


@pytest.mark.parametrize(("count", "off"), [(104, False), (106, True), (96, False), (94, True)])
def test_the_number_is_looked_at_once_densification_has_stopped(count: int, off: bool) -> None:
    component = CountMatched(CountMatchedConf(gaussians=100, tolerance=WITHIN), stop=15_000)
    component.after_backward(Many(count), Step(1499, 3000, None))
    for look in (
        lambda: component.after_backward(Many(count), Step(1500, 3000, None)),
        lambda: component.after_training(Many(count)),
    ):
        if off:
            with pytest.raises(CountOff) as caught:
                look()
            assert caught.value.count == count
        else:
            look()
