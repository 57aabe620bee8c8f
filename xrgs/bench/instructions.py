"""Counts the vector instructions that the rasterizer's stages ideally need.

Times alone do not say what is left to gain. This module says how much of the time of a stage the
instructions that it cannot do without would take, if one were issued wherever the processor can
issue a fused multiply-add: a processor whose multiply-add units do all vector work (Intel's with
AVX-512) then needs at least that long. One that adds, compares or permutes in other units beside
them (AMD's) can need less, down to the share of the multiplications alone, so both are reported.

The counts are those of the operations of `xrgs/csrc/simd/simd.h` in the source of a stage, each as
one instruction on vectors of sixteen lanes, as with AVX-512. What an ideal compiler saves is left
out: loads, stores and broadcasts (operands in memory), masks that zero or keep lanes (part of the
instruction that they belong to), loop control, and what is computed once per tile. A transpose of
sixteen vectors is 64 permutations. A division or a root counts as one multiplication, though it
takes several times as long: the count stays a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

LANES = 16


@dataclass(frozen=True)
class Instructions:
    """The vector instructions of one unit of work."""

    multiply: int = 0
    """Products, fused multiply-adds, divisions and roots: what only a multiply-add unit does."""
    add: int = 0
    compare: int = 0
    """Comparisons, minima and maxima, absolute values and selections."""
    integer: int = 0
    permute: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.multiply + self.add + self.compare + self.integer + self.permute


class Work(NamedTuple):
    """A kind of work of a stage."""

    unit: str
    """The key of a row of `rendering.time_load` that counts these units."""
    per: int
    """The number of units that the instructions do together."""
    instructions: Instructions
    source: str
    """The function in `xrgs/csrc/raster` that does it."""


#: Of alphas_at, for sixteen pixels. Additions: dx, dy, and three that round and reduce the argument
#: of exp2. Multiplications: three of u and v, two to add -u^2 - v^2 to log2(opacity), and the six
#: steps of exp2's polynomial. Comparisons: with alpha_min, and the minimum with alpha_max.
#: Integers: a shift and an addition make the power of two.
_ALPHA = Instructions(multiply=11, add=5, compare=2, integer=2)

#: What each stage does, with SH degree 3.
STAGES: dict[str, tuple[Work, ...]] = {
    "project": (
        # Inputs (permutations: 6 for each of means and scales, 8 for quaternions), the camera
        # transform, rotation matrix, Jacobian, covariance and conic; the SH basis, 45 coefficients
        # (192 permutations) times it, and the derivatives of three colours by direction; the
        # transpose of the projected Gaussians.
        Work(
            "gaussians",
            LANES,
            Instructions(multiply=415, add=62, compare=56, integer=5, permute=282),
            "project.cpp: project_group",
        ),
    ),
    "composite": (
        # Beside alpha: alpha T and three colours (multiplications), T (addition), the test against
        # transmittance_min, and the choice of the final T.
        Work(
            "evaluations",
            LANES,
            Instructions(
                multiply=_ALPHA.multiply + 4,
                add=_ALPHA.add + 1,
                compare=_ALPHA.compare + 2,
                integer=_ALPHA.integer,
            ),
            "composite.cpp: composite_block",
        ),
        # Sixteen subtractions of the tile's centre and a transpose; then, for each of four rows of
        # blocks, strip_extent (16 multiplications, 3 additions, 8 comparisons, 4 integers) and two
        # comparisons for each of four blocks; 2 negations.
        Work(
            "pairs",
            LANES,
            Instructions(multiply=64, add=30, compare=64, integer=16, permute=64),
            "composite.cpp: load_and_cull_batch",
        ),
    ),
    "composite_backward": (
        # Alpha again, alpha T and T, the test and two masked results. Then, back to front: the
        # colour's gradient (3 multiplications), R (an addition and a multiplication), g (a
        # multiplication, and the comparison with alpha_max), two products of 4x4 matrices (4
        # multiplications and 4 permutations each), the rows' sums (4, 4 and an addition), and the
        # addition to the colours' sums.
        Work(
            "evaluations",
            LANES,
            Instructions(
                multiply=_ALPHA.multiply + 18,
                add=_ALPHA.add + 4,
                compare=_ALPHA.compare + 4,
                integer=_ALPHA.integer,
                permute=12,
            ),
            "composite_backward.cpp: recompute_alphas, accumulate_moments",
        ),
        # Sixteen subtractions of the tile's centre, three transposes, the rows of the colours' sums
        # added (2 permutations, 2 additions and a selection for each pair), and the moments moved
        # to the mean.
        Work(
            "pairs",
            LANES,
            Instructions(multiply=23, add=49, compare=16, permute=224),
            "composite_backward.cpp: load_batch, write_pair_grads",
        ),
    ),
    "project_backward": (
        Work("pairs", 1, Instructions(add=1), "project_backward.cpp: sum_pair_grads"),
        # The transpose of the sums; the inputs and the projection again; the chain rule through
        # conic, covariance, Jacobian and rotation; 45 products of the SH basis (192 permutations);
        # the test that all are finite; and the permutations of what is written.
        Work(
            "gaussians",
            LANES,
            Instructions(multiply=425, add=46, compare=44, permute=302),
            "project_backward.cpp: backward_group",
        ),
    ),
}


def ideal_counts(stage: str, row: Mapping[str, Any]) -> tuple[float, float]:
    """Count the vector instructions that a stage ideally needs for one render.

    Args:
        stage: A key of `STAGES`.
        row: A row of `rendering.time_load` of the native backend.

    Returns:
        All instructions, and how many of them multiply.
    """
    works = [(row[work.unit] / work.per, work.instructions) for work in STAGES[stage]]
    total = sum(units * instructions.total for units, instructions in works)
    return total, sum(units * instructions.multiply for units, instructions in works)


def shares_of_peak(
    row: Mapping[str, Any], multiply_adds_per_s: float
) -> dict[str, tuple[float, float]]:
    """Compute the share of the time of each stage that its ideal instructions take at the peak.

    Args:
        row: A row of `rendering.time_load` of the native backend, with `stages_ms`.
        multiply_adds_per_s: The measured peak of scalar multiply-adds a second on the row's number
            of threads.

    Returns:
        For each stage, the share of all instructions and that of the multiplications.
    """
    shares = {}
    for stage in STAGES:
        slots = 1e-3 * row["stages_ms"][stage] * multiply_adds_per_s / LANES
        total, multiply = ideal_counts(stage, row)
        shares[stage] = (total / slots, multiply / slots)
    return shares
