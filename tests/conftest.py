"""What several rooms' tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from xrgs import config


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Tensors of a test are small: two threads wait for each other longer than they work."""
    torch.set_num_threads(1)


@pytest.fixture
def baseline() -> config.Conf:
    """The baseline's config as `conf/` gives it, 40 steps on the torch backend."""
    from hydra import compose, initialize_config_dir

    config.register()
    with initialize_config_dir(str(config.CONF_DIR), version_base="1.3"):
        composed = compose("config", ["train.steps=40", "splat.backend=torch"])
    return config.to_conf(composed)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real photographs; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("XRGS_TEST_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no photographs in {folder}: set XRGS_TEST_DATA")
    return folder
