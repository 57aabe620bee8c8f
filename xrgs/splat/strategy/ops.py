"""Operations for strategies: budgets, the choice of the highest scores, and splits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from xrgs.splat.quaternions import rotate, rotation_matrices

SPLIT_SHRINK = 1.6
"""Random split: each half has the Gaussian's scales divided by this [kerbl2023, section 5.2]."""

LONG_AXIS_OFFSET = 0.5
"""Long-axis split: distance of each half's mean from the Gaussian's, in scales of that axis."""
LONG_AXIS_SHRINK = 0.5
"""Long-axis split: factor of the longest scale."""
SHORT_AXES_SHRINK = 0.85
"""Long-axis split: factor of the other two scales."""
HALF_OPACITY = 0.6
"""Long-axis split: factor of the opacity."""


@dataclass(frozen=True)
class Budget:
    """A cap on the number of Gaussians, which rises during densification.

    The growth control of ImprovedGS [deng2025]: at a fraction p of the steps from the start of
    densification to its last refinement, the cap is

        first + (most - first) * sqrt(p)

    so that most Gaussians are added early and have time to train. Our choice: the cap starts at the
    number of SfM points, where the authors' code has `most * sqrt(p)`. If there are more than
    `most` points, nothing grows until pruning has brought the number below `most`.
    """

    first: int
    """The number of Gaussians before training."""
    most: int
    """The cap at the end of densification."""

    def cap(self, progress: float) -> int:
        """Return the cap at a fraction `progress` of densification, 0..1."""
        first = min(self.first, self.most)
        return first + int((self.most - first) * math.sqrt(progress))


def gaussians_of(budget: float, view_pixels: int) -> int:
    """Convert a budget per pixel of the largest view to a number of Gaussians, at least 1."""
    return max(1, round(budget * view_pixels))


def top_k(candidates: Tensor, scores: Tensor, count: int) -> Tensor:
    """Choose `count` candidates with the highest scores; ties go to the lower indices.

    ImprovedGS [deng2025] draws candidates with probabilities in proportion to their scores. Our
    choice: the highest scores, which needs no random numbers. Candidates and the result are
    [N] bool; scores [N] that are infinite or NaN count as 0.
    """
    index = candidates.nonzero()[:, 0]  # [M]
    ranked = torch.nan_to_num(scores[index], nan=0.0, posinf=0.0, neginf=0.0)
    order = torch.sort(ranked, descending=True, stable=True).indices
    chosen = torch.zeros_like(candidates)
    chosen[index[order[:count]]] = True
    return chosen


def split_at_random(
    old: Mapping[str, Tensor], scales: Tensor, generator: torch.Generator
) -> dict[str, Tensor]:
    """Split each Gaussian into two smaller ones with means drawn from it (gsplat's `split`).

    `old` are raw parameters [M, ...] by name, `scales` [M, 3] are in world units.

    Returns:
        Raw parameters [2 M, ...]: the first half of every Gaussian, then the second.
    """
    # In double, since the numbers that torch draws in float32 depend on the processor.
    noise = torch.randn(2, len(scales), 3, generator=generator, dtype=torch.float64)
    offsets = rotate(old["quats"], noise.to(scales) * scales)  # [2, M, 3]
    halves = {name: torch.cat([value, value]) for name, value in old.items()}
    halves["means"] = (old["means"] + offsets).reshape(-1, 3)
    halves["scales"] = (old["scales"] - math.log(SPLIT_SHRINK)).repeat(2, 1)
    return halves


def split_along_longest_axis(old: Mapping[str, Tensor], scales: Tensor) -> dict[str, Tensor]:
    """Split each Gaussian into two smaller ones, side by side along its longest axis.

    The long-axis split of ImprovedGS [deng2025], with the constants of ImprovedGS+ [munoz2026]. For
    a mean m, scales s with the largest at k, rotation R and opacity o, the halves have

        m +- 0.5 s_k R e_k,  s_k' = 0.5 s_k,  s_j' = 0.85 s_j for the others,  o' = 0.6 o.

    Rotation and colour are kept. ImprovedGS's own code has an offset of 1.35 s_k and factors of
    0.55 and 0.89 for the scales. Among equal scales the first counts as the longest.

    The arguments are those of `split_at_random`. In the result [2 M, ...] all halves on the
    positive side of the axis come first.
    """
    longest = old["scales"].argmax(dim=-1, keepdim=True)  # [M, 1]
    axis = longest[:, None].expand(-1, 3, -1)  # [M, 3, 1]
    direction = rotation_matrices(old["quats"]).gather(-1, axis)[..., 0]  # [M, 3]
    offset = LONG_AXIS_OFFSET * scales.gather(-1, longest) * direction
    shrink = torch.full_like(scales, math.log(SHORT_AXES_SHRINK))
    shrink.scatter_(-1, longest, math.log(LONG_AXIS_SHRINK))
    # logit(f sigmoid(x)), in double, since float32's logarithms depend on the processor.
    opacities = old["opacities"].double()
    rest = opacities.new_tensor(math.log(1 - HALF_OPACITY))
    logits = math.log(HALF_OPACITY) - torch.logaddexp(rest, -opacities)
    halves = {name: torch.cat([value, value]) for name, value in old.items()}
    halves["means"] = torch.cat([old["means"] + offset, old["means"] - offset])
    halves["scales"] = (old["scales"] + shrink).repeat(2, 1)
    halves["opacities"] = logits.to(old["opacities"]).repeat(2)
    return halves
