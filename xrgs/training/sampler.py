"""The order of the training views."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from xrgs.errors import XrgsError
from xrgs.training.components import Step
from xrgs.training.seeding import seeded_generator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from xrgs.capture.dataset import LoadedView
    from xrgs.training.checkpoint import State


class EpochSampler:
    """Samples training views epoch by epoch, one view a step.

    An epoch is a random permutation of the views that `allows_view` allows when the epoch begins. A
    view that is no longer allowed at its turn is skipped. A view that becomes allowed during an
    epoch takes part from the next epoch on.

    Attributes:
        next_step: The number of the next step, from 0.
        remaining: The views left in the current epoch, in reverse order: the next one is the last.
    """

    def __init__(
        self,
        views: Sequence[LoadedView],
        seed: int,
        steps: int,
        allows_view: Callable[[Step], bool],
    ) -> None:
        """Start before the first step.

        Args:
            views: The training views; their names are unique.
            seed: `seed` of the config; the order of the views depends on it alone.
            steps: Number of steps of the whole run.
            allows_view: Whether a step may train on its view.
        """
        self.views = views
        self.steps = steps
        self.allows_view = allows_view
        self.next_step = 0
        self.generator = seeded_generator(seed, "views")
        self.remaining: list[LoadedView] = []

    def __iter__(self) -> Iterator[Step]:
        return self

    def __next__(self) -> Step:
        """Return the next step with its view.

        Raises:
            XrgsError: `allows_view` allows no view at this step.
        """
        if self.next_step >= self.steps:
            raise StopIteration
        while self.remaining and not self._allows(self.remaining[-1]):
            self.remaining.pop()
        if not self.remaining:
            self._begin_epoch()
        self.next_step += 1
        return Step(self.next_step - 1, self.steps, self.remaining.pop())

    def _begin_epoch(self) -> None:
        allowed = [view for view in self.views if self._allows(view)]
        if not allowed:
            raise XrgsError(
                f"step {self.next_step}: the components that are switched on leave no view to"
                " train on"
            )
        order = torch.randperm(len(allowed), generator=self.generator).tolist()
        self.remaining = [allowed[i] for i in order]

    def _allows(self, view: LoadedView) -> bool:
        return self.allows_view(Step(self.next_step, self.steps, view))

    def state_dict(self) -> State:
        """Return the next step's number, the rest of the epoch and the generator's state."""
        return {
            "next_step": self.next_step,
            "remaining": [view.name for view in self.remaining],
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: State) -> None:
        """Continue a run of the same views, seed and number of steps.

        Raises:
            KeyError: An entry is missing, or names an unknown view.
        """
        by_name = {view.name: view for view in self.views}
        self.next_step = int(state["next_step"])
        self.remaining = [by_name[name] for name in state["remaining"]]
        self.generator.set_state(state["generator"])
