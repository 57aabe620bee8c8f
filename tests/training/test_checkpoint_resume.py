"""A killed run continues from its checkpoint, and ends with the result of one never killed."""

from __future__ import annotations

import hashlib
import json
import math
import random
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.conftest import composed as compose
from tests.training.conftest import comparable
from xrgs.config import Conf
from xrgs.splat.loss import photometric_loss
from xrgs.training import checkpoint, loop, recorder
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.count_matching import train_cell
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.recorder import TrainingResult

STEPS = 24
#: Densification every fourth step: every single step, as the schedule of so few steps has it, would
#: leave no statistics to be restored.
SHORT = (f"train.steps={STEPS}", "splat.densify.every=5000", "splat.densify.stop=25000")
CASES = {
    "baseline": (),
    # 60 Gaussians of at most 180: a limit that began with those at the restart would be another.
    "xrgs": (
        "+ablation=[xrgs_per_class,curriculum,harmonics_every,budget]",
        "splat.densify.budget=0.05",
    ),
    # The rates of `mip` are found anew between refinements too, or they would be new at every
    # restart.
    "photographs": (
        "+ablation=[mip,resolution_schedule,formation,exposure,near_limit,hr_share]",
        "components.mip.every=7",
        "components.floaters.near_share=1",
    ),
    "natural_selection": (
        "+ablation=natural_selection",
        "components.natural_selection.budget=0.003",
        "splat.densify.stop=10000",
    ),
    "mcmc": ("+ablation=mcmc", "splat.densify.budget=0.03"),
    # Without the reset, after which too few Gaussians are left for numbers to be matched.
    "count_matched": ("splat.densify.reset_every=50000",),
}


class Kill(BaseException):
    """Ends a run as a kill does: no code of the package may catch it."""


class Losses:
    """Counts the losses of a run, which are its steps, and kills the run at one of them."""

    def __init__(self) -> None:
        self.restart()
        self.states: dict[tuple[int, int], str] = {}
        """Digest of the state after each step of each attempt of count matching."""

    def restart(self, last: float = math.inf) -> None:
        """Count from 0 again, and kill the run after so many losses."""
        self.last = last
        self.count = 0
        self.at_checkpoint = 0
        """The count when the last checkpoint was written."""

    def __call__(self, *arguments: Any, **named: Any) -> torch.Tensor:
        self.count += 1
        if self.count > self.last:
            raise Kill
        return photometric_loss(*arguments, **named)


class CheckpointEveryFewSteps(Checkpoint):
    """Is written at every n-th step, and asserts that a step gives the same state each time."""

    def __init__(self, file: Path, every: int, losses: Losses) -> None:
        super().__init__(file, "cell", every_s=1e-9)
        self.every, self.losses = every, losses

    def save_if_due(self, step: int) -> float:
        states = {name: value.state_dict() for name, value in self._objects.items()}
        del states["recorder"]["seconds"], states["recorder"]["stage_seconds"]
        attempt = len(states.get("search", {}).get("tried", ()))
        state = digest_of(states)
        assert self.losses.states.setdefault((attempt, step), state) == state
        if step % self.every != 0:
            return 0.0
        self.losses.at_checkpoint = self.losses.count
        return super().save_if_due(step)


def digest_of(states: dict[str, Any]) -> str:
    arrays: dict[str, Any] = {}
    plain = checkpoint._split_off_tensors(states, "", arrays)
    digest = hashlib.sha256(json.dumps(plain).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> Losses:
    counter = Losses()
    monkeypatch.setattr(loop, "photometric_loss", counter)
    # A row every fourth step: logs that wait for their row are part of the state.
    monkeypatch.setattr(recorder, "_HISTORY_ROWS", STEPS // 4)
    return counter


@pytest.fixture
def conf() -> Conf:
    return compose(*SHORT, "splat.backend=auto")


def train_with_checkpoints(
    file: Path, every: int, losses: Losses, data: Dataset, conf: Conf
) -> TrainingResult:
    """Train on from the checkpoint where there is one, and write one at every n-th step."""
    written = CheckpointEveryFewSteps(file, every, losses)
    written.load()
    return train_cell(data, conf, written)


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend",
    ["native", pytest.param("torch", marks=[pytest.mark.slow, pytest.mark.exhaustive])],
)
@pytest.mark.parametrize("case", CASES)
def test_a_killed_run_ends_as_one_never_killed(
    case: str, backend: str, data: Dataset, losses: Losses, tmp_path: Path
) -> None:
    if backend == "native":
        pytest.importorskip("xrgs._native")
    conf = compose(*SHORT, f"splat.backend={backend}", *CASES[case])
    file = tmp_path / "checkpoint.npz"
    if case == "count_matched":
        count = len(train(data, conf).gaussians)
        conf.components.count_matched.gaussians = round(0.8 * count)
        losses.restart()
    never_killed = train_with_checkpoints(file, STEPS, losses, data, conf)
    total = losses.count
    assert (total > STEPS) == (case == "count_matched")  # which takes more than one attempt

    every = random.randint(1, 9)
    kills = [random.randrange(total // 4, total), random.randrange(1, total)]
    file.unlink()
    done = 0
    for kill in kills:
        losses.restart(kill)
        try:
            train_with_checkpoints(file, every, losses, data, conf)
        except Kill:
            done += losses.at_checkpoint
        else:  # fewer steps were left than the kill would have needed
            assert done + losses.count == total
            done += losses.at_checkpoint
    losses.restart()
    resumed = train_with_checkpoints(file, every, losses, data, conf)
    assert comparable(resumed) == comparable(never_killed), (kills, every)
    assert done + losses.count == total  # only steps behind the last checkpoint were repeated


def test_a_run_killed_after_its_last_step_trains_no_step_again(
    data: Dataset, conf: Conf, losses: Losses, tmp_path: Path
) -> None:
    file = tmp_path / "checkpoint.npz"
    first = train_with_checkpoints(file, 1, losses, data, conf)
    losses.restart()
    again = train_with_checkpoints(file, 1, losses, data, conf)
    assert losses.count == 0
    assert comparable(again) == comparable(first)
