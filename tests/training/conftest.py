"""How the tests of training compare two results, and what they train."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from tests.conftest import composed as compose
from tests.conftest import ramps
from xrgs.config import Conf
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train
from xrgs.training.recorder import TrainingResult


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
