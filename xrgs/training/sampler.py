"""The order of the training views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.seeding import seeded_generator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from xrgs.training.checkpoint import State
    from xrgs.training.dataset import LoadedView


GOLDEN = (math.sqrt(5) - 1) / 2
"""The golden ratio minus 1. Its multiples modulo 1 fill 0..1 evenly."""


class EpochSampler:
    """Samples training views epoch by epoch, one view a step.

    An epoch is a random permutation of the views that `allows_view` allows at its beginning. A view
    that is no longer allowed at its turn is skipped. A view that becomes allowed during an epoch
    takes part from the next epoch on.

    If the fraction of HR views is below `hr_share`, HR and LR views have separate epochs, and step
    t draws an HR view if

        (offset + t GOLDEN) mod 1 < hr_share,

    with an offset in 0..1 from the seed. In a run of 30,000 steps, the number of HR views in any n
    consecutive steps differs from `hr_share` n by less than 5. If no view of one tag is allowed,
    views of the other are drawn instead.

    Our choice: 3D Gaussian Splatting [kerbl2023] draws every view once in an epoch. The golden
    ratio also spreads the HR views evenly over every k-th step. This matters for refinements and
    `splat.optimizer.shN_every`, which act at every k-th step: if HR and LR views alternated, all
    these steps could have the same tag.
    """

    def __init__(
        self,
        views: Sequence[LoadedView],
        seed: int,
        steps: int,
        allows_view: Callable[[Step], bool],
        hr_share: float = 0.0,
    ) -> None:
        """Start before the first of the run's steps; the names of the views are unique.

        `allows_view` returns whether a step may train on its view. At least a fraction `hr_share`
        of the steps draws an HR view.
        """
        self.views, self.steps = views, steps
        self.allows_view, self.hr_share = allows_view, hr_share
        self.next_step = 0
        """Number of the next step, from 0."""
        self.generator = seeded_generator(seed, "views")
        offset = torch.rand((), generator=seeded_generator(seed, "classes"), dtype=torch.float64)
        self.offset = offset.item()
        high, low = ([view for view in views if view.tag == tag] for tag in ("HR", "LR"))
        apart = len(high) < hr_share * len(views)
        self.classes = [_Class(members) for members in ([high, low] if apart else [views])]
        """Groups of views with separate epochs: HR and LR views, or one group of all views."""

    def __iter__(self) -> Iterator[Step]:
        return self

    def __next__(self) -> Step:
        """Return the next step with its view.

        Raises:
            XrgsError: `allows_view` allows no view at this step.
        """
        if self.next_step >= self.steps:
            raise StopIteration
        draws_hr = (self.offset + self.next_step * GOLDEN) % 1 < self.hr_share
        by_turn = self.classes if draws_hr else self.classes[::-1]
        drawn = (self._draw(members) for members in by_turn)
        view = next((view for view in drawn if view is not None), None)
        if view is None:
            raise XrgsError(
                f"step {self.next_step}: the components that are switched on leave no view to"
                " train on"
            )
        self.next_step += 1
        return Step(self.next_step - 1, self.steps, view)

    def _draw(self, members: _Class) -> LoadedView | None:
        """Return the next view of a group; None if none of its views is allowed."""
        while members.remaining and not self._allows(members.remaining[-1]):
            members.remaining.pop()
        if not members.remaining:
            allowed = [view for view in members.views if self._allows(view)]
            order = torch.randperm(len(allowed), generator=self.generator).tolist()
            members.remaining = [allowed[i] for i in order]
        return members.remaining.pop() if members.remaining else None

    def _allows(self, view: LoadedView) -> bool:
        return self.allows_view(Step(self.next_step, self.steps, view))

    def state_dict(self) -> State:
        """Return the next step's number, the rest of each epoch and the generator's state."""
        return {
            "next_step": self.next_step,
            "remaining": [[view.name for view in c.remaining] for c in self.classes],
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same views, seed, `hr_share` and number of steps."""
        by_name = {view.name: view for view in self.views}
        self.next_step = int(state["next_step"])
        for members, names in zip(self.classes, state["remaining"], strict=True):
            members.remaining = [by_name[name] for name in names]
        self.generator.set_state(state["generator"])


@dataclass
class _Class:
    """Views with a separate epoch."""

    views: Sequence[LoadedView]
    remaining: list[LoadedView] = field(default_factory=list)
    """Remaining views of the present epoch, in reverse order: the next view is the last."""
