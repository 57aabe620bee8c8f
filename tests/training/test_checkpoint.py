"""A run that is killed goes on from its checkpoint, and ends as if it had not been."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from xrgs.capture.dataset import Dataset
from xrgs.config import Conf
from xrgs.splat.gaussians import PARAMETERS
from xrgs.training import checkpoint
from xrgs.training import loop as train
from xrgs.training.checkpoint import Checkpoint, CheckpointError
from xrgs.training.loop import Trained

STEPS = 24
#: Refined at each fourth step: at each one, as so few scale it to, no statistics outlive a step.
SHORT = (f"train.steps={STEPS}", "splat.densify.every=5000", "splat.densify.stop=25000")
CASES = {
    "baseline": [],
    "groups": ["+ablation=densify"],
    "current_view": ["+ablation=densify", "components.densify.decide=current_view"],
    "xrgs": ["+ablation=xrgs"],
    "curriculum": ["+ablation=curriculum"],
    # Measured between refinements too, or at a kill it would be as new.
    "mip": ["+ablation=mip", "components.mip.every=7"],
    "count_matched": [],
}


@pytest.fixture
def baseline(compose: Callable[..., Conf]) -> Conf:
    """Of `STEPS` steps, with the renderer that is slow and there everywhere."""
    return compose(*SHORT, "splat.backend=torch")


class Kill(BaseException):
    """What no code of ours may catch."""


class EveryFew(Checkpoint):
    """Written at each `every`-th step; knows how many renders had a loss by then.

    After each step all state must be what it was after that step before.
    """

    def __init__(self, file: Path, every: int, losses: Losses) -> None:
        super().__init__(file, "cell", every_s=1e-9)
        self.every, self.losses = every, losses

    def after_step(self, number: int) -> float:
        arrays: dict[str, Any] = {}
        pieces = {name: piece.state_dict() for name, piece in self._pieces.items()}
        del pieces["ledger"]["seconds"]
        state = hashlib.sha256(json.dumps(checkpoint._without_tensors(pieces, "", arrays)).encode())
        for name, array in arrays.items():
            state.update(f"{name} {array.shape}".encode() + array.tobytes())
        run = len(pieces.get("search", {}).get("tried", ()))
        known = self.losses.states.setdefault((run, number), state.hexdigest())
        assert known == state.hexdigest()
        if number % self.every != 0:
            return 0.0
        self.losses.written = self.losses.count
        return super().after_step(number)


class Losses:
    """Counts the losses of a run, and ends it at one of them."""

    def __init__(self) -> None:
        self.real = train.photometric_loss
        self.count = self.written = 0
        self.last = math.inf
        self.states: dict[tuple[int, int], str] = {}

    def __call__(self, *arguments: Any, **named: Any) -> torch.Tensor:
        self.count += 1
        if self.count > self.last:
            raise Kill
        return self.real(*arguments, **named)

    def restart(self, last: float = math.inf) -> None:
        self.count, self.written, self.last = 0, 0, last


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> Losses:
    counter = Losses()
    monkeypatch.setattr(train, "photometric_loss", counter)
    monkeypatch.setattr(train, "_LOGGED_ROWS", STEPS // 4)  # what is noted waits for its row
    return counter


def outcome(trained: Trained) -> dict[str, Any]:
    """All of a result but the time that it took."""
    values = {name: trained.gaussians[name].detach().numpy().tobytes() for name in PARAMETERS}
    told = {name: value for name, value in vars(trained).items() if name != "gaussians"}
    return values | told | {"seconds": None, "columns": [list(row) for row in trained.history]}


def resumed(file: Path, every: int, losses: Losses, data: Dataset, conf: Conf) -> Trained:
    kept = EveryFew(file, every, losses)
    kept.read()
    return train.train(data, conf, kept)


@pytest.mark.parametrize("backend", ["torch", "native"])
@pytest.mark.parametrize("case", CASES)
def test_a_killed_run_ends_as_if_it_had_not_been(
    case: str,
    backend: str,
    data: Dataset,
    compose: Callable[..., Conf],
    losses: Losses,
    tmp_path: Path,
) -> None:
    if backend == "native":
        pytest.importorskip("xrgs._native")
    conf = compose(*SHORT, f"splat.backend={backend}", *CASES[case])
    file = tmp_path / "checkpoint.npz"
    if case == "count_matched":
        count = len(train.train(data, conf).gaussians)
        conf.components.count_matched.gaussians = round(0.8 * count)
        losses.restart()
    whole = resumed(file, STEPS, losses, data, conf)
    total = losses.count
    assert (total > STEPS) == (case == "count_matched")  # more than one threshold

    # hypothesis starts with the smallest kill there is, so one anywhere goes before; a step of
    # torch's takes ten times as long, and has that alone.
    anywhere = [random.randrange(total // 4, total), random.randrange(1, total)]
    phases = [Phase.explicit] if backend == "torch" else [Phase.explicit, Phase.generate]

    @settings(max_examples=2, phases=phases, deadline=None)
    @example(kills=anywhere, every=random.randint(1, 9))
    @given(kills=st.lists(st.integers(1, total), min_size=1, max_size=2), every=st.integers(1, 9))
    def check(kills: list[int], every: int) -> None:
        file.unlink(missing_ok=True)
        done = 0
        for kill in kills:
            losses.restart(kill)
            try:
                resumed(file, every, losses, data, conf)
            except Kill:
                done += losses.written
            else:  # so little was left that it came to the end
                assert done + losses.count == total
                done += losses.written
        losses.restart()
        assert outcome(resumed(file, every, losses, data, conf)) == outcome(whole)
        assert done + losses.count == total  # nothing was done twice but what no checkpoint had

    check()


def test_a_run_that_ended_but_for_its_last_words_says_them_again(
    data: Dataset, baseline: Conf, losses: Losses, tmp_path: Path
) -> None:
    file = tmp_path / "checkpoint.npz"
    whole = resumed(file, 1, losses, data, baseline)
    losses.restart()
    again = resumed(file, 1, losses, data, baseline)
    assert losses.count == 0
    assert outcome(again) == outcome(whole)


def test_the_training_time_is_the_sum_and_has_no_writing_in_it(
    data: Dataset,
    baseline: Conf,
    losses: Losses,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """By a clock that only a step, a writing and a night between two runs move."""
    now = 0.0
    clock = SimpleNamespace(perf_counter=lambda: now, monotonic=lambda: now)

    def taking(seconds: float, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal now
            now += seconds
            return real(*arguments, **named)

        return call

    for module in (train, checkpoint):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(train, "photometric_loss", taking(1.0, losses))
    monkeypatch.setattr(checkpoint, "_save", taking(100.0, checkpoint._save))
    file = tmp_path / "checkpoint.npz"
    losses.restart(STEPS // 2)
    with pytest.raises(Kill):
        train.train(data, baseline, Checkpoint(file, "cell", 1e-9))
    now += 10_000.0
    losses.restart()
    kept = Checkpoint(file, "cell", 1e-9)
    assert kept.read() == STEPS // 2
    assert train.train(data, baseline, kept).seconds == STEPS
    assert now == 10_000 + (STEPS + 1) + 100 * STEPS  # one step was begun, and lost


class Piece:
    """Anything."""

    def __init__(self, state: dict[str, Any] | None = None) -> None:
        self.state = state

    def state_dict(self) -> dict[str, Any]:
        assert self.state is not None
        return self.state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state = state


def write(file: Path, cell: str = "cell", **states: dict[str, Any]) -> Path:
    kept = Checkpoint(file, cell, 1e-9)
    kept.keep(**{name: Piece(state) for name, state in states.items()})
    kept.after_step(6)
    return file


numbers = st.floats(allow_nan=False) | st.integers() | st.text() | st.none() | st.booleans()


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=st.lists(numbers), bits=st.lists(st.integers(0, 2**32 - 1), max_size=9))
def test_what_is_kept_comes_back_to_the_last_bit(
    tmp_path: Path, value: list[Any], bits: list[int]
) -> None:
    array = np.array(bits, np.uint32).view(np.float32)  # every pattern, those of NaN too
    state = {"value": value, "inner": {"tensor": torch.from_numpy(array), "none": {}}}
    kept = Checkpoint(write(tmp_path / "c.npz", piece=state), "cell")
    assert kept.read() == 7
    piece = Piece()
    kept.keep(piece=piece)
    assert piece.state is not None
    assert repr(piece.state["value"]) == repr(value)
    assert piece.state["inner"]["tensor"].numpy().tobytes() == array.tobytes()
    assert piece.state["inner"]["none"] == {}


def test_shapes_and_types_come_back(tmp_path: Path) -> None:
    tensors = {
        "number": torch.tensor(3.0),
        "empty": torch.empty(0, 15, 3),
        "bytes": torch.Generator().get_state(),
        "leaf": torch.ones(2, 3, requires_grad=True),
    }
    kept, piece = Checkpoint(write(tmp_path / "c.npz", piece=tensors), "cell"), Piece()
    kept.read()
    kept.keep(piece=piece)
    assert piece.state is not None
    for name, tensor in tensors.items():
        back = piece.state[name]
        assert (back.shape, back.dtype) == (tensor.shape, tensor.dtype)
        assert torch.equal(back, tensor.detach())
        assert back.data_ptr() % 64 == 0 or back.numel() == 0


def test_a_name_takes_what_was_left_once(tmp_path: Path) -> None:
    kept = Checkpoint(write(tmp_path / "c.npz", piece={"a": 1}), "cell")
    kept.read()
    first, second = Piece(), Piece({"a": 2})
    kept.keep(piece=first)
    kept.keep(piece=second)
    assert (first.state, second.state) == ({"a": 1}, {"a": 2})


def test_it_is_written_every_so_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(checkpoint.time, "monotonic", lambda: now[0])
    kept = Checkpoint(tmp_path / "c.npz", "cell", every_s=60)
    kept.keep(piece=Piece({}))
    written = []
    for step in range(20):
        now[0] += 15
        kept.after_step(step)
        if kept.file is not None and kept.file.exists():
            written.append(step)
            kept.file.unlink()
    assert written == [3, 7, 11, 15, 19]


def test_never_writes_none(data: Dataset, baseline: Conf, tmp_path: Path) -> None:
    train.train(data, baseline, Checkpoint(tmp_path / "c.npz", "cell", 0))
    assert not list(tmp_path.iterdir())


def test_where_there_is_none_training_starts(tmp_path: Path) -> None:
    assert Checkpoint(tmp_path / "c.npz", "cell").read() is None


def test_another_cells_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "c.npz", cell="one")
    with pytest.raises(CheckpointError, match=r"c\.npz: of cell one, not of other"):
        Checkpoint(tmp_path / "c.npz", "other").read()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_truncated_one_is_named(tmp_path: Path, share: float) -> None:
    file = write(tmp_path / "c.npz", piece={"a": torch.arange(99.0)})
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"c\.npz"):
        Checkpoint(file, "cell").read()


def test_a_flipped_bit_is_found(tmp_path: Path) -> None:
    file = write(tmp_path / "c.npz", piece={"a": torch.full((64,), 1.5)})
    content = bytearray(file.read_bytes())
    content[content.index(np.float32(1.5).tobytes() * 64) + 17] ^= 1
    file.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        Checkpoint(file, "cell").read()


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.folder),)


def _bare(file: Path, evil: Evil) -> None:
    file.write_bytes(pickle.dumps(evil))


def _torch(file: Path, evil: Evil) -> None:
    torch.save({"cell": "cell", "steps": 1, "pieces": evil}, file)


def _npy(file: Path, evil: Evil) -> None:
    with zipfile.ZipFile(file, "w") as archive, archive.open("state.json", "w") as member:
        np.lib.format.write_array(member, np.array([evil], object), allow_pickle=True)


@pytest.mark.parametrize("disguise", [_bare, _torch, _npy])
def test_a_pickle_in_its_place_is_not_run(
    tmp_path: Path, disguise: Callable[[Path, Evil], None]
) -> None:
    file, trap = tmp_path / "c.npz", tmp_path / "trap"
    disguise(file, Evil(trap))
    with pytest.raises(CheckpointError, match=r"c\.npz"):
        Checkpoint(file, "cell").read()
    assert not trap.exists()
    pickle.loads(pickle.dumps(Evil(trap)))  # noqa: S301 - the trap itself works
    assert trap.exists()


def test_a_compressed_one_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    file = tmp_path / "c.npz"
    np.savez_compressed(file, zeros=np.zeros(10**6))
    with pytest.raises(CheckpointError, match="compressed"):
        Checkpoint(file, "cell").read()


@pytest.mark.parametrize(
    ("member", "value", "named"),
    [
        ("pieces/optimizer/gaussians/means", np.zeros((3, 3), np.float32), "optimizer"),
        ("pieces/optimizer/gaussians/shN", np.zeros((60, 15, 3)), "optimizer"),
        ("pieces/optimizer/adam/sh0/exp_avg", np.zeros((1, 1, 3), np.float32), "optimizer"),
        ("pieces/optimizer/adam/quats/step", np.zeros(4, np.float32), "optimizer"),
        ("pieces/densifier/visible_count", np.zeros((2, 60), np.float32), "densifier"),
        ("pieces/densifier/generator", np.zeros(7, np.uint8), "densifier"),
        ("pieces/drawn/generator", np.zeros(5056, np.float32), "drawn"),
    ],
)
def test_one_that_does_not_fit_is_refused_by_the_piece(
    data: Dataset, baseline: Conf, tmp_path: Path, member: str, value: np.ndarray, named: str
) -> None:
    file = tmp_path / "c.npz"
    baseline.train.steps, baseline.splat.densify.stop = 3, 0
    train.train(data, baseline, Checkpoint(file, "cell", 1e-9))
    state = checkpoint._load(file)
    *folders, name = member.split("/")
    place = state
    for folder in folders:
        place = place[folder]
    assert name in place
    place[name] = torch.from_numpy(value)
    checkpoint._save(file, state)
    kept = Checkpoint(file, "cell")
    kept.read()
    with pytest.raises(CheckpointError, match=rf"c\.npz: {named}: "):
        train.train(data, baseline, kept)
    kept.refuse()
    assert [entry.name for entry in tmp_path.iterdir()] == ["refused-c.npz"]
    assert outcome(train.train(data, baseline, kept)) == outcome(train.train(data, baseline))


def test_a_full_disk_costs_the_checkpoint_and_not_the_run(
    data: Dataset,
    baseline: Conf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with caplog.at_level(logging.WARNING):
        trained = train.train(data, baseline, Checkpoint(tmp_path / "c.npz", "cell", 1e-9))
    assert outcome(trained) == outcome(train.train(data, baseline))
    assert "no checkpoint at step 1: [Errno 28] No space left on device" in caplog.text
    assert not list(tmp_path.iterdir())


def test_it_is_json_and_arrays_for_anybody(data: Dataset, baseline: Conf, tmp_path: Path) -> None:
    file = tmp_path / "c.npz"
    train.train(data, baseline, Checkpoint(file, "cell", 1e-9))
    with np.load(file, allow_pickle=False) as arrays:
        state = json.loads(arrays["state.json"].tobytes())
        assert state["steps"] == STEPS
        assert arrays["pieces/optimizer/gaussians/means"].shape[1] == 3
