"""The checkpoint file: what is written comes back exactly, and any other file is refused."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.training.conftest import comparable
from xrgs.config import Conf
from xrgs.training import checkpoint
from xrgs.training.checkpoint import Checkpoint, CheckpointError
from xrgs.training.dataset import Dataset
from xrgs.training.loop import train

#: Seconds between two checkpoints that are so few that one is written at every step.
EVERY_STEP = 1e-9


class Holder:
    """An object whose state is whatever it is given."""

    def __init__(self, state: dict[str, Any] | None = None) -> None:
        self.state = state

    def state_dict(self) -> dict[str, Any]:
        assert self.state is not None
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def write(file: Path, cell_id: str = "cell", **states: dict[str, Any]) -> Path:
    """Write a checkpoint of these states after step 6."""
    written = Checkpoint(file, cell_id, EVERY_STEP)
    written.register(**{name: Holder(state) for name, state in states.items()})
    written.save_if_due(6)
    return file


def restored(file: Path, name: str) -> dict[str, Any]:
    """The state of that name in a checkpoint."""
    loaded, holder = Checkpoint(file, "cell"), Holder()
    assert loaded.load() == 7  # steps done
    loaded.register(**{name: holder})
    assert holder.state is not None
    return holder.state


@pytest.fixture
def few_steps(short: Conf) -> Conf:
    """Three steps without densification."""
    short.train.steps, short.splat.densify.stop = 3, 0
    return short


texts = st.text(st.characters(exclude_categories=["Cs"]))
values = st.floats(allow_nan=False) | st.integers() | texts | st.none() | st.booleans()


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=st.lists(values), bits=st.lists(st.integers(0, 2**32 - 1), max_size=9))
def test_values_come_back_to_the_last_bit(
    tmp_path: Path, value: list[Any], bits: list[int]
) -> None:
    array = np.array(bits, np.uint32).view(np.float32)  # every pattern, those of NaN too
    inner = {"tensor": torch.from_numpy(array), "none": {}}
    state = restored(write(tmp_path / "c.npz", holder={"value": value, "inner": inner}), "holder")
    assert repr(state["value"]) == repr(value)
    assert state["inner"]["tensor"].numpy().tobytes() == array.tobytes()
    assert state["inner"]["none"] == {}


def test_shapes_and_types_come_back(tmp_path: Path) -> None:
    tensors = {
        "number": torch.tensor(3.0),
        "empty": torch.empty(0, 15, 3),
        "bytes": torch.Generator().get_state(),
        "leaf": torch.ones(2, 3, requires_grad=True),
    }
    state = restored(write(tmp_path / "c.npz", holder=tensors), "holder")
    for name, tensor in tensors.items():
        back = state[name]
        assert (back.shape, back.dtype) == (tensor.shape, tensor.dtype)
        assert torch.equal(back, tensor.detach())
        assert back.data_ptr() % 64 == 0 or back.numel() == 0


def test_it_is_written_once_in_an_interval(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(checkpoint, "time", SimpleNamespace(monotonic=lambda: now))
    file = tmp_path / "c.npz"
    written = Checkpoint(file, "cell", every_s=60)
    written.register(holder=Holder({}))
    steps = []
    for step in range(20):
        now += 15
        written.save_if_due(step)
        if file.exists():
            steps.append(step)
            file.unlink()
    assert steps == [3, 7, 11, 15, 19]
    Checkpoint(file, "cell", every_s=0).save_if_due(20)
    assert not file.exists()
    assert Checkpoint(file, "cell").load() is None


def test_a_flipped_bit_another_cell_and_a_missing_state_are_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "c.npz", first={"a": torch.full((64,), 1.5)})
    with pytest.raises(CheckpointError, match=r"c\.npz: belongs to cell cell, not to other"):
        Checkpoint(file, "other").load()
    loaded = Checkpoint(file, "cell")
    loaded.load()
    with pytest.raises(CheckpointError, match=r"c\.npz: second: KeyError"):
        loaded.register(first=Holder(), second=Holder())
    content = bytearray(file.read_bytes())
    content[content.index(np.float32(1.5).tobytes() * 64) + 17] ^= 1
    file.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        Checkpoint(file, "cell").load()


def test_a_state_that_does_not_fit_is_refused_by_its_object(
    data: Dataset, few_steps: Conf, tmp_path: Path
) -> None:
    file = tmp_path / "c.npz"
    train(data, few_steps, Checkpoint(file, "cell", EVERY_STEP))
    with np.load(file, allow_pickle=False) as arrays:  # as any program can read it
        assert json.loads(arrays["state.json"].tobytes())["steps"] == few_steps.train.steps
        assert arrays["states/optimizer/gaussians/means"].shape[1] == 3
    for member, value in (
        ("optimizer/gaussians/means", np.zeros((3, 3), np.float32)),
        ("optimizer/gaussians/shN", np.zeros((60, 15, 3))),
        ("optimizer/adam/sh0/exp_avg", np.zeros((1, 1, 3), np.float32)),
        ("optimizer/adam/quats/step", np.zeros(4, np.float32)),
        ("strategy/visible_count", np.zeros((2, 60), np.float32)),
        ("strategy/generator", np.zeros(7, np.uint8)),
        ("sampler/generator", np.zeros(5056, np.float32)),
    ):
        state = checkpoint._load(file)
        owner, *folders, name = member.split("/")
        inner = state["states"][owner]
        for folder in folders:
            inner = inner[folder]
        assert name in inner
        inner[name] = torch.from_numpy(value)
        changed = tmp_path / "changed.npz"
        checkpoint._save(changed, state)
        loaded = Checkpoint(changed, "cell")
        loaded.load()
        with pytest.raises(CheckpointError, match=rf"changed\.npz: {owner}: "):
            train(data, few_steps, loaded)
    loaded.set_aside()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["c.npz", "refused-changed.npz"]
    assert comparable(train(data, few_steps, loaded)) == comparable(train(data, few_steps))


def test_a_full_disk_costs_the_checkpoint_and_not_the_run(
    data: Dataset,
    few_steps: Conf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with caplog.at_level(logging.WARNING):
        result = train(data, few_steps, Checkpoint(tmp_path / "c.npz", "cell", EVERY_STEP))
    assert comparable(result) == comparable(train(data, few_steps))
    reason = "[Errno 28] No space left on device"
    assert f"c.npz: no checkpoint was written after step 0 ({reason}" in caplog.text
    assert not list(tmp_path.iterdir())
