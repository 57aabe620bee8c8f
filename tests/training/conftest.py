"""How the tests of training compare two results, and what they train."""

from __future__ import annotations

import hashlib
import json
import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.conftest import composed as compose
from tests.conftest import ramps
from tests.splat.conftest import backend
from xrgs.config import Conf
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.splat.loss import photometric_loss
from xrgs.training import checkpoint, loop, recorder
from xrgs.training.checkpoint import Checkpoint
from xrgs.training.count_matching import train_cell
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.recorder import TrainingResult

__all__ = ["backend"]


def same(first: Gaussians, second: Gaussians) -> bool:
    """Whether two models are equal bit for bit."""
    return all(torch.equal(first[name], second[name]) for name in PARAMETERS)


def comparable(result: TrainingResult) -> dict[str, Any]:
    """Everything in a result but the training time, as values that `==` compares exactly."""
    parameters = {name: result.gaussians[name].detach().numpy().tobytes() for name in PARAMETERS}
    others = {name: value for name, value in vars(result).items() if name != "gaussians"}
    columns = [list(row) for row in result.history]
    return parameters | others | {"seconds": None, "stage_seconds": None, "columns": columns}


def masked(data: Dataset) -> Dataset:
    """The dataset with a third of every photograph outside a mask."""
    views = []
    for view in data.train:
        mask = torch.ones(view.camera.height, view.camera.width, dtype=torch.bool)
        mask[: len(mask) // 3] = False
        views.append(replace(view, mask=mask))
    return replace(data, train=tuple(views))


@pytest.fixture
def short() -> Conf:
    """The baseline's config, 40 steps with the fastest renderer that is installed."""
    return compose("train.steps=40", "splat.backend=auto")


@pytest.fixture(scope="session")
def trained() -> TrainingResult:
    """What `short` makes of `data`; only to be read."""
    return train(ramps(), compose("train.steps=40", "splat.backend=auto"))


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
    # Some rows: logs that wait for their row are part of the state.
    monkeypatch.setattr(recorder, "_HISTORY_ROWS", 6)
    return counter


def train_with_checkpoints(
    file: Path, every: int, losses: Losses, data: Dataset, conf: Conf
) -> TrainingResult:
    """Train on from the checkpoint where there is one, and write one at every n-th step."""
    written = CheckpointEveryFewSteps(file, every, losses)
    written.load()
    return train_cell(data, conf, written)


def killed_and_not(
    data: Dataset, conf: Conf, losses: Losses, folder: Path
) -> tuple[TrainingResult, TrainingResult]:
    """Train once, and again with kills in between; return the two results, which are the same."""
    file, steps = folder / "checkpoint.npz", conf.train.steps
    never_killed = train_with_checkpoints(file, steps, losses, data, conf)
    total = losses.count
    # Count matching takes more than one attempt.
    assert (total > steps) == (conf.components.count_matched.gaussians > 0)
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
    return never_killed, resumed
