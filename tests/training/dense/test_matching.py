"""Correlations against numpy's in float64, and the costs of exact depths and of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.training.dense.conftest import TrueScene
from xrgs.training.dense.levels import swept_views
from xrgs.training.dense.matching import (
    BEST,
    JUMP,
    REACH,
    STEP,
    Windows,
    costs,
    minimum,
    smoothed,
)


def test_correlation_is_that_of_each_window() -> None:
    """Against `numpy.corrcoef` in float64, and the noise in the denominator."""
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 9, 12)).astype(np.float32)
    second = 0.6 * first + 0.4 * second
    computed = Windows(first).zncc(np.stack([second, 1 - second]))
    for row in range(9):
        for column in range(12):
            window = (
                slice(max(row - REACH, 0), row + REACH + 1),
                slice(max(column - REACH, 0), column + REACH + 1),
            )
            pair = (first[window].ravel().astype(float), second[window].ravel().astype(float))
            expected = np.corrcoef(*pair)[0, 1]
            shrink = np.prod([np.sqrt(v / (v + 1e-5)) for v in map(np.var, pair)])
            np.testing.assert_allclose(computed[0, row, column], expected * shrink, atol=2e-6)
            np.testing.assert_allclose(computed[1, row, column], -expected * shrink, atol=2e-6)


def test_true_depths_cost_least(scene: TrueScene) -> None:
    """At most pixels, the exact depth costs less than depths 5 % nearer and farther."""
    views = swept_views(scene.data.train[:6], "torch")
    exact = scene.depths(0, views[0].coarse)
    depths = np.stack([0.95 * exact, exact, 1.05 * exact])
    volume = costs(views[0].coarse, [v.coarse for v in views[1:]], (1 / depths).astype(np.float32))
    assert volume.shape == (3, *exact.shape)
    assert volume.min() >= 0
    assert volume.max() <= 1
    assert (volume.argmin(axis=0) == 1).mean() > 0.7


def test_fewer_views_than_the_best_are_enough(scene: TrueScene) -> None:
    """With one other view the score is its correlation; what no view sees has none."""
    level, other = (view.coarse for view in swept_views(scene.data.train[:2], "torch"))
    assert BEST > 1
    behind = np.full((1, 1, 1), -1e3, np.float32)  # behind both cameras
    assert (costs(level, [other], behind) == 1).all()
    volume = costs(level, [level], np.ones((1, 1, 1), np.float32))  # with itself
    np.testing.assert_allclose(
        1 - volume[0], Windows(level.gray).zncc(level.gray).clip(0), atol=1e-3
    )


@pytest.mark.parametrize("per_pixel", [False, True])
def test_compiled_costs_are_those_of_numpy_to_the_bit(scene: TrueScene, per_pixel: bool) -> None:
    """With every instruction set, with masks, and with pixels outside other views and behind."""
    native = pytest.importorskip("xrgs._native")
    rng = np.random.default_rng(0)
    views = [view.finest for view in swept_views(scene.data.train[:6], "torch")]
    level, *others = (
        replace(v, used=rng.random(v.used.shape) > n / 9) for n, v in enumerate(views)
    )
    shape = (7, *level.gray.shape) if per_pixel else (7, 1, 1)
    inverse_depths = rng.uniform(-0.1, 1.5, shape).astype(np.float32)
    expected = costs(level, others, inverse_depths)
    assert 0.05 < (expected < 1).mean() < 0.99  # otherwise nothing would be compared
    selected = native.isa()
    try:
        for isa in native.available_isas():
            native.set_isa(isa)
            np.testing.assert_array_equal(costs(level, others, inverse_depths, "native"), expected)
            two = costs(level, others[:2], inverse_depths, "native")
            np.testing.assert_array_equal(two, costs(level, others[:2], inverse_depths))
    finally:
        native.set_isa(selected)


Array = NDArray[np.float64]


def along(line: Array) -> Array:
    """The costs [n, D] summed up along a line by the recursion of hirschmuller2008, equation 13."""
    result = [line[0]]
    for here in line[1:]:
        before, least = result[-1], result[-1].min()
        result.append(
            np.array(
                [
                    cost
                    + min(
                        before[d],
                        least + JUMP,
                        *(before[n] + STEP for n in (d - 1, d + 1) if 0 <= n < len(before)),
                    )
                    - least
                    for d, cost in enumerate(here)
                ]
            )
        )
    return np.stack(result)


def test_four_directions_are_summed() -> None:
    costs = np.random.default_rng(0).random((5, 4, 6))
    expected = np.zeros_like(costs)
    for row in range(4):
        line = costs[:, row].T
        expected[:, row] += (along(line) + along(line[::-1])[::-1]).T
    for column in range(6):
        line = costs[:, :, column].T
        expected[:, :, column] += (along(line) + along(line[::-1])[::-1]).T
    np.testing.assert_allclose(smoothed(costs.astype(np.float32)), expected, rtol=1e-5)


@pytest.mark.parametrize("shape", [(5, 4, 6), (3, 33, 1), (1, 2, 50)])
def test_compiled_sums_are_those_of_numpy_to_the_bit(shape: tuple[int, int, int]) -> None:
    pytest.importorskip("xrgs._native")
    costs = np.random.default_rng(1).random(shape).astype(np.float32)
    np.testing.assert_array_equal(smoothed(costs, "native"), smoothed(costs))


def test_the_least_cost_of_a_parabola_is_found_between_planes() -> None:
    true = np.array([[1.3, 2.0, 2.49, 0.0, 4.0, -0.3, 4.4]])
    planes = np.arange(5)[:, None, None]
    found = minimum(((planes - true) ** 2).astype(np.float32))
    # At the ends of the range there is no parabola.
    np.testing.assert_allclose(found, np.clip(true, 0, 4), atol=1e-5)
