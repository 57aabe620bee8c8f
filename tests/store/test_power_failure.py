"""Tests that a power failure at any moment leaves a store that goes on.

The calls of the file system that a real run makes are recorded in their order. Each prefix of them
is replayed under a model of a disk that promises no more than POSIX does: a file has the content of
its last fsync, and a folder has the names of its last fsync. Each later call may or may not have
happened: a name may be there or not, and a file may be empty, cut off, or full of zeros. A rename
is one step. The sampled states are written to a folder, where the real code looks and begins again.
"""

from __future__ import annotations

import builtins
import io
import json
import os
import random
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.store.cells import begun, identity, row
from xrgs.config import Conf
from xrgs.mixture import mixing, variant
from xrgs.mixture.views import Variant, View
from xrgs.photos import images, scenes
from xrgs.safeio.files import list_names
from xrgs.splat.backend import resolve_backend
from xrgs.store import cell
from xrgs.store.cell_folder import CellFolder
from xrgs.store.identity import cell_id
from xrgs.store.store import Store
from xrgs.training import dataset
from xrgs.training.checkpoint import Checkpoint, CheckpointError
from xrgs.training.dataset import Dataset

pytestmark = pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="it reads /proc")

#: Sampled states of each prefix beside those in which nothing or all of what may be lost is, or all
#: of it is zeros.
SAMPLES, ZEROED = 4, 2.0
#: Calls of `os` that are recorded, beside `open`. A name that another call makes is found out.
CALLS = ("open", "mkdir", "rename", "replace", "unlink", "remove", "rmdir", "fsync")
#: A tree of files: their contents by their path, None for a folder.
Tree = dict[str, bytes | None]


@dataclass(frozen=True)
class Link:
    """A name that is given to a file or folder: its first, or, by a rename, another."""

    node: int
    folder: int
    name: str
    before: tuple[int, str] | None = None
    """The folder and the name that it had."""


@dataclass(frozen=True)
class Unlink:
    """A name that is removed."""

    node: int
    folder: int
    name: str


@dataclass(frozen=True)
class Write:
    """A file's new content."""

    node: int
    content: bytes


@dataclass(frozen=True)
class Sync:
    """The content of a file, or the names in a folder, are on the disk."""

    node: int


Event = Link | Unlink | Write | Sync


@dataclass
class Disk:
    """What is on the disk for certain, and what may be."""

    folders: set[int] = field(default_factory=lambda: {0})
    contents: dict[int, bytes] = field(default_factory=dict)
    synced: dict[int, bytes] = field(default_factory=dict)
    names: list[Link | Unlink] = field(default_factory=list)
    durable: set[int] = field(default_factory=set)
    """Which of `names` are on the disk for certain."""

    def replay(self, event: Event) -> None:
        """Apply one event."""
        if isinstance(event, Write):
            self.contents[event.node] = event.content
        elif not isinstance(event, Sync):
            self.names.append(event)
        elif event.node in self.contents:
            self.synced[event.node] = self.contents[event.node]
        else:
            self.durable |= {i for i, n in enumerate(self.names) if n.folder == event.node}

    def after_failure(self, chance: random.Random, kept: float) -> Tree:
        """Return a tree that may be found.

        `kept` is how likely each step is that may be lost; at `ZEROED`, all names are there and
        all content that was not synced is zeros.
        """
        steps = [n for i, n in enumerate(self.names) if i in self.durable or chance.random() < kept]
        entries: dict[int, dict[str, int]] = {}
        for step in steps:
            inside = entries.setdefault(step.folder, {})
            if isinstance(step, Unlink):
                if inside.get(step.name) == step.node:
                    del inside[step.name]
                continue
            inside[step.name] = step.node
            if step.before is not None:
                folder, name = step.before
                if entries.get(folder, {}).get(name) == step.node:
                    del entries[folder][name]
        contents = {node: self._content(node, chance, kept) for node in self.contents}
        return dict(_paths(0, "", entries, contents))

    def _content(self, node: int, chance: random.Random, kept: float) -> bytes:
        now, safe = self.contents[node], self.synced.get(node)
        if now == safe or kept == 1:
            return now
        if kept == ZEROED:
            return bytes(len(now))
        torn = [b"", now[: chance.randrange(len(now) + 1)], bytes(len(now)), now]
        return (safe or b"") if kept == 0 else chance.choice([*torn, *([safe] if safe else [])])


def _paths(
    folder: int, prefix: str, entries: dict[int, dict[str, int]], contents: dict[int, bytes]
) -> Iterator[tuple[str, bytes | None]]:
    for name, node in sorted(entries.get(folder, {}).items()):
        yield prefix + name, contents.get(node)
        if node not in contents:
            yield from _paths(node, f"{prefix}{name}/", entries, contents)


class Recorder:
    """Records what is asked of the file system below a folder while a `with` block runs.

    It sees `open` and the calls of `os`, which `pathlib` and `shutil` use. Before each call, and at
    the end, the folder must be as the recorded events make it: other ways to write are found out.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.events: list[Event] = []
        self.marks: dict[str, int] = {}
        self._nodes: dict[str, int] = {"": 0}
        self._contents: dict[str, bytes] = {}
        self._count = 0
        self._adopt()
        self.start = len(self.events)

    def _adopt(self) -> None:
        """Take what is there already for what is on the disk."""
        for path, content in tree(self.root).items():
            self._link(path, content)
        self.events += [Sync(node) for node in self._nodes.values()]

    def mark(self, what: str) -> None:
        """Remember which events had happened when something was so."""
        self._look()
        self.marks[what] = len(self.events)

    def disks(self) -> Iterator[tuple[int, Disk]]:
        """Yield the disk after each prefix of the recorded events, and the prefix's length."""
        disk = Disk()
        for count, event in enumerate(self.events, 1):
            disk.replay(event)
            if count >= self.start:
                yield count, disk

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record all that happens in the block, and compare the end with the real folder."""
        with pytest.MonkeyPatch.context() as patch:
            for name in CALLS:
                recorded = self._recorded(getattr(os, name), getattr(self, f"_{name}"))
                patch.setattr(os, name, recorded)
            read, write = open, self._recorded(open, self._open, paths=1)

            def opened(file: Any, mode: str = "r", *options: Any, **named: Any) -> Any:
                return (read if "r" in mode else write)(file, mode, *options, **named)

            for module in (io, builtins):  # for `Path.open` and `open`
                patch.setattr(module, "open", opened)
            yield
        self._look()
        disk = Disk()
        for event in self.events:
            disk.replay(event)
        assert disk.after_failure(random.Random(0), 1) == tree(self.root)

    def _recorded(
        self, call: Callable[..., Any], record: Callable[..., None], paths: int = 2
    ) -> Callable[..., Any]:
        """Return a call that is recorded; so many of its first arguments may be paths."""

        def recorded(*arguments: Any, **named: Any) -> Any:
            found = list(self._below_root(arguments[:paths], named))
            if not found:
                return call(*arguments, **named)
            self._look()
            existed = all(os.path.lexists(self.root / path) for path in found)
            result = call(*arguments, **named)
            record(*found, flags=arguments[1:2], existed=existed)
            return result

        return recorded

    def _below_root(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> Iterator[str]:
        """Yield the arguments of a call that are paths below the root, from there."""
        keys = ("src_dir_fd", "dst_dir_fd") if "src_dir_fd" in named else ("dir_fd", "none")
        for argument, key in zip(arguments, keys, strict=False):
            if isinstance(argument, int) and key == "none":
                return
            if isinstance(argument, int):
                path = opened(argument)
            else:
                folder = named.get(key)
                path = (Path.cwd() if folder is None else opened(folder)) / os.fspath(argument)
            if path.is_relative_to(self.root):
                below = path.relative_to(self.root).as_posix()
                yield "" if below == "." else below

    def _look(self) -> None:
        """Record what was written since, and find out who wrote past this recorder."""
        now = tree(self.root)
        assert now.keys() == self._nodes.keys() - {""}, "something was written past the recorder"
        for path, content in now.items():
            if content is not None:
                self._observe(path, content)

    def _observe(self, path: str, content: bytes) -> None:
        if self._contents.get(path) != content:
            self._contents[path] = content
            self.events.append(Write(self._nodes[path], content))

    def _link(self, path: str, content: bytes | None) -> None:
        self._count += 1
        self._nodes[path] = self._count
        if content is not None:
            self._observe(path, content)
        above, _, name = path.rpartition("/")
        self.events.append(Link(self._count, self._nodes[above], name))

    def _open(self, path: str, flags: tuple[int | str], existed: bool) -> None:
        # `os.open` has flags, `open` a mode.
        creates = flags[0] & os.O_CREAT if isinstance(flags[0], int) else True
        if creates and not existed:
            self._link(path, b"")

    def _mkdir(self, path: str, **_: object) -> None:
        self._link(path, None)

    def _rename(self, path: str, target: str, **_: object) -> None:
        node, ends = self._nodes[path], [path.rpartition("/"), target.rpartition("/")]
        folders = [self._nodes[end[0]] for end in ends]
        self.events.append(Link(node, folders[1], ends[1][2], (folders[0], ends[0][2])))
        for known in (self._nodes, self._contents):
            values = cast("dict[str, Any]", known)
            for old in [o for o in values if o == path or o.startswith(f"{path}/")]:
                values[target + old[len(path) :]] = values.pop(old)

    _replace = _rename

    def _unlink(self, path: str, **_: object) -> None:
        node, (above, _slash, name) = self._nodes.pop(path), path.rpartition("/")
        self._contents.pop(path, None)
        self.events.append(Unlink(node, self._nodes[above], name))

    _remove = _rmdir = _unlink

    def _fsync(self, path: str, **_: object) -> None:
        if path in self._nodes:  # and not a file that was removed while it is open
            self.events.append(Sync(self._nodes[path]))


def opened(descriptor: int) -> Path:
    """Return the path that an open file or folder has now."""
    return Path(f"/proc/self/fd/{descriptor}").readlink()


def tree(root: Path) -> Tree:
    """Return all that is below a folder."""
    return {
        path.relative_to(root).as_posix(): None if path.is_dir() else path.read_bytes()
        for path in sorted(root.rglob("*"))
    }


def states(recorder: Recorder, tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """Yield folders as a power failure may leave them, and the length of the prefix before it."""
    chance, folder = random.Random(0), tmp_path / "after"
    seen: dict[int, set[int]] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # what is done then is not to fail again
        for count, disk in recorder.disks():
            stage = sum(count >= mark for mark in recorder.marks.values())
            for kept in (0.0, 1.0, ZEROED, *[0.5] * SAMPLES):
                found = disk.after_failure(chance, kept)
                key = hash(tuple(found.items()))
                if key in seen.setdefault(stage, set()):
                    continue
                seen[stage].add(key)
                folder.mkdir()
                for name, content in found.items():
                    (folder / name).mkdir() if content is None else (folder / name).write_bytes(
                        content
                    )
                yield count, folder
                shutil.rmtree(folder)


# Cells

CELL = "cells"


class Attempts:
    """Attempts at one cell, which is really trained, recorded; and what must hold afterwards."""

    def __init__(self, conf: Conf, tmp_path: Path) -> None:
        self.conf, self.tmp_path = conf, tmp_path
        self.identity = identity(conf.seed)
        self.id = cell_id(self.identity)
        (tmp_path / "s").mkdir()
        self.store = Store(tmp_path / "s")

    def begin(self, store: Store) -> CellFolder:
        return begun(store.cell(self.id), self.conf, self.identity)

    def run(self) -> None:
        cell.run_cell(self.conf, cast(Variant, SimpleNamespace(id="v")), self.begin(self.store))

    def stop_after(self, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
        """Leave what a process leaves that is killed after a step's checkpoint."""

        class Killed(BaseException):
            pass

        save = Checkpoint.save_if_due

        def saved(checkpoint: Checkpoint, step: int) -> float:
            seconds = save(checkpoint, step)
            if step + 1 == steps:
                raise Killed
            return seconds

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoint, "save_if_due", saved)
            with pytest.raises(Killed):
                self.run()

    def faults(self, recorder: Recorder, steps: int = 0) -> Iterator[str]:
        """Yield what is wrong in each state.

        Args:
            recorder: What was recorded of an attempt that was finished.
            steps: The steps that a checkpoint had done when the recording began.
        """
        written = {event.content for event in recorder.events if isinstance(event, Write)} - {b""}
        finished = tree(self.store.path / CELL / self.id)
        for count, folder in states(recorder, self.tmp_path):
            home, state = folder / CELL / self.id, Store(folder).cell(self.id).state().name
            if (home / "status.json").exists():
                for name in ("status.json", "identity.json", "config.json"):
                    if (home / name).read_bytes() not in written:
                        yield f"half of {name}"
            if state == "done":
                files, now = json.loads((home / "status.json").read_text())["files"], tree(home)
                yield from (f"another {name}" for name in files if now.get(name) != finished[name])
                continue
            if count >= recorder.marks["done"]:
                yield "a done cell was lost"
            yield from self._faults_of_next(Store(folder), steps)

    def _faults_of_next(self, store: Store, steps: int) -> Iterator[str]:
        """Begin the next attempt, which should be alone and go on from the last checkpoint."""
        attempt = self.begin(store)
        assert attempt.state().name == "unfinished"
        assert (attempt.identity(), attempt.config()) == (self.identity, self.conf)
        if list_names(store.cells_folder) != [self.id]:
            yield "a stopped attempt was kept"
        try:
            done = Checkpoint(attempt.checkpoint, self.id, 1).load() or 0
        except CheckpointError:
            yield "half of a checkpoint"
        else:
            yield from ["the checkpoint was lost"] if done < steps else []


@pytest.fixture
def attempts(
    data: Dataset, baseline: Conf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Attempts:
    """Attempts at a cell of three steps on `data`, with a checkpoint after each."""
    monkeypatch.setattr(dataset, "load", lambda *_, **__: data)
    baseline.checkpoint_s, baseline.threads = 1e-9, 1
    baseline.train.steps, baseline.splat.backend = 3, resolve_backend("auto")
    return Attempts(baseline, tmp_path)


def recorded_run(attempts: Attempts) -> Recorder:
    """Record the preparation of the store, an attempt, and when the cell was declared done."""
    recorder = Recorder(attempts.store.path)
    drop = CellFolder.drop_checkpoint

    def declared(folder: CellFolder) -> None:
        recorder.mark("done")
        drop(folder)

    with recorder.recording(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(CellFolder, "drop_checkpoint", declared)
        attempts.store.prepare()
        attempts.run()
    return recorder


@pytest.mark.slow
def test_a_cell_is_done_with_all_its_files_or_begins_again(attempts: Attempts) -> None:
    recorder = recorded_run(attempts)
    assert len(recorder.events) > 80
    assert not set(attempts.faults(recorder))


@pytest.mark.slow
def test_a_stopped_cell_loses_no_checkpoint_while_it_is_resumed(
    attempts: Attempts, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts.store.prepare()
    attempts.stop_after(2, monkeypatch)
    assert not set(attempts.faults(recorded_run(attempts), steps=2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("without", "found"),
    [
        ("files", {"half of status.json", "half of config.json", "half of a checkpoint"}),
        ("folders", {"a done cell was lost"}),
        ("splats.ply", {"another splats.ply"}),
    ],
)
def test_what_is_not_synced_is_found(
    attempts: Attempts, monkeypatch: pytest.MonkeyPatch, without: str, found: set[str]
) -> None:
    """The simulation would not pass if a cell's files, or its folders, were not synced."""
    sync = Recorder._fsync

    def forgotten(recorder: Recorder, path: str, **named: Any) -> None:
        kind = "folders" if (recorder.root / path).is_dir() else "files"
        if without not in {kind, path.rpartition("/")[2]}:
            sync(recorder, path, **named)

    monkeypatch.setattr(Recorder, "_fsync", forgotten)
    for fault in attempts.faults(recorded_run(attempts)):
        found = found - {fault}
        if not found:
            return
    pytest.fail(f"not found: {found}")


def test_a_write_past_the_recorder_is_found(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    with pytest.raises(AssertionError, match="past the recorder"), recorder.recording():
        subprocess.run(["/usr/bin/touch", str(tmp_path / "file")], check=True)


def results(folder: Path) -> Tree:
    """All of a cell but what the plan of the next attempt writes."""
    return {
        name: content
        for name, content in tree(folder).items()
        if not name.startswith((".", "config.json", "identity.json"))
    }


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True])
def test_what_a_cell_had_is_kept_when_it_is_set_aside(attempts: Attempts, damaged: bool) -> None:
    attempts.store.prepare()
    attempts.run()
    folder = attempts.store.cell(attempts.id)
    if damaged:
        (folder.path / "scores.csv").write_text("view\n")
    before = results(folder.path)
    recorder = Recorder(attempts.store.path)
    with recorder.recording():
        attempts.begin(attempts.store)
        recorder.mark("begun")
    for _, after in states(recorder, attempts.tmp_path):
        attempts.begin(Store(after))
        kept = [path for path in (after / CELL).iterdir() if ".aside-" in path.name]
        assert before in [results(path) for path in kept]


def test_a_cell_that_failed_has_its_reason(attempts: Attempts) -> None:
    attempts.store.prepare()
    folder = attempts.begin(attempts.store)
    recorder = Recorder(attempts.store.path)
    with recorder.recording():
        folder.fail("out of luck")
        recorder.mark("failed")
    for count, after in states(recorder, attempts.tmp_path):
        state = Store(after).cell(attempts.id).state()
        assert state.name == "failed" or count < recorder.marks["failed"]
        if state.name == "failed":
            assert state.reason == "out of luck"
            assert (after / CELL / attempts.id / "error.txt").read_text() == "out of luck\n"
        attempts.begin(Store(after))


# Records and variants


def test_a_record_of_a_sweep_is_whole_or_missing(tmp_path: Path) -> None:
    store = Store(tmp_path / "s")
    store.prepare()
    recorder, ids = Recorder(store.path), []
    with recorder.recording():
        for seed, command in ((0, ["a"]), (1, ["b"]), (1, ["c"])):
            ids.append(store.write_sweep(command, [row("c", seed=seed)]))
            recorder.mark(command[0])
    for count, after in states(recorder, tmp_path):
        records, damaged = Store(after).records()
        assert not damaged
        commands = {sweep: list(record.command) for sweep, record in records.items()}
        assert commands.get(ids[0], ["a"]) == ["a"]
        assert commands.get(ids[1], ["b"]) in (["b"], ["c"])
        assert ids[0] in commands or count < recorder.marks["a"]
        assert commands.get(ids[1]) == ["c"] or count < recorder.marks["c"]


@pytest.fixture
def freeze(baseline: Conf, monkeypatch: pytest.MonkeyPatch) -> Callable[[Store], Variant]:
    """(store) -> a small variant that is built in it, without photographs and without SfM."""

    def mix(_: object, __: object, ___: object, folder: Path) -> Variant:
        views = []
        for split in ("test", "train"):
            file = folder / f"images/{split}/a.png"
            images.save(file, np.full((3, 4, 3), 0.5, np.float32))
            views.append(View("a", file, split, "HR", 4, 3, np.eye(3), np.eye(4), 1.0))
        colors = np.zeros((4, 3), np.uint8)
        return Variant("", folder, "scene", 5, True, tuple(views), np.ones((4, 3)), colors, {})

    monkeypatch.setattr(mixing, "mix_resolutions", mix)
    monkeypatch.setattr(scenes, "resolve", lambda *_: None)
    monkeypatch.setattr(scenes, "fingerprint", lambda *_: "photographs")
    return lambda store: variant.build(
        baseline.scene, baseline.variant, store.variants, store.scenes
    )


def test_a_variant_is_whole_or_missing(tmp_path: Path, freeze: Callable[[Store], Variant]) -> None:
    store = Store(tmp_path / "s")
    store.prepare()
    recorder = Recorder(store.path)
    with recorder.recording():
        made = freeze(store)
        recorder.mark("frozen")
    whole, key = tree(made.folder), made.id.partition("-")[0]
    for count, after in states(recorder, tmp_path):
        found = variant.find(Store(after).variants, key)
        assert found is not None or count < recorder.marks["frozen"]
        assert found is None or tree(found.folder) == whole
        for lease in Store(after).variants.glob(".*.lock.*"):
            lease.unlink()  # its owner ended when the power failed; here, it is this very process
        assert freeze(Store(after)).id == made.id
        assert tree(Store(after).variants / made.id) == whole
