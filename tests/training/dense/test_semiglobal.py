"""Semi-global matching against its recursion, pixel by pixel in float64."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from xrgs.training.dense.semiglobal import JUMP, STEP, minimum, smoothed

Array = NDArray[np.float64]


def along(line: Array) -> Array:
    """The costs [n, D] summed up along a line by the recursion of hirschmuller2008, equation 13."""
    result = [line[0]]
    for costs in line[1:]:
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
                    for d, cost in enumerate(costs)
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
