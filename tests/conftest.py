"""What several rooms' tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import hydra
import pytest
import torch

from xrgs import config


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Tensors of a test are small: two threads wait for each other longer than they work."""
    torch.set_num_threads(1)


@pytest.fixture
def compose() -> Callable[..., config.Conf]:
    """(*overrides) -> the config that `conf/` gives with them."""

    def composed(*overrides: str) -> config.Conf:
        config.register()
        with hydra.initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
            return config.to_conf(hydra.compose("config", list(overrides)))

    return composed


@pytest.fixture
def baseline(compose: Callable[..., config.Conf]) -> config.Conf:
    """The baseline's config as `conf/` gives it, 40 steps on the torch backend."""
    return compose("train.steps=40", "splat.backend=torch")


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real photographs; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("XRGS_TEST_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no photographs in {folder}: set XRGS_TEST_DATA")
    return folder
