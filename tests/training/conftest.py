"""How the tests of training compare two results, and the configs that they train."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import pytest
import torch

from xrgs import composing
from xrgs.config import Conf
from xrgs.splat.gaussians import PARAMETERS, Gaussians
from xrgs.training.recorder import TrainingResult


def _same(first: Gaussians, second: Gaussians) -> bool:
    return all(torch.equal(first[name], second[name]) for name in PARAMETERS)


def _comparable(result: TrainingResult) -> dict[str, Any]:
    parameters = {name: result.gaussians[name].detach().numpy().tobytes() for name in PARAMETERS}
    others = {name: value for name, value in vars(result).items() if name != "gaussians"}
    columns = [list(row) for row in result.history]
    return parameters | others | {"seconds": None, "stage_seconds": None, "columns": columns}


@pytest.fixture(scope="session")
def same() -> Callable[[Gaussians, Gaussians], bool]:
    """(first, second) -> whether two models are equal bit for bit."""
    return _same


@pytest.fixture(scope="session")
def comparable() -> Callable[[TrainingResult], dict[str, Any]]:
    """(result) -> everything in it but the training time, as values that `==` compares exactly."""
    return _comparable


_composed = functools.cache(composing.compose)


@pytest.fixture(scope="session")
def compose() -> Callable[..., Conf]:
    """(*overrides) -> a copy of the config: Hydra composes the same overrides once."""
    return lambda *overrides: copy.deepcopy(_composed(*overrides))


@pytest.fixture
def short(compose: Callable[..., Conf]) -> Conf:
    """The baseline's config, 40 steps with the fastest renderer that is installed."""
    return compose("train.steps=40", "splat.backend=auto")
