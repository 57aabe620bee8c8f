"""What several rooms' tests share."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from xrgs import config
from xrgs.capture.dataset import Dataset, LoadedView
from xrgs.evaluation.lpips import weights
from xrgs.splat.cameras import Camera


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Tensors of a test are small: two threads wait for each other longer than they work."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heard() -> Iterator[None]:
    """A child ignores what its parent does, as after a shell's `&`; tests send signals."""
    ignored = [n for n in (signal.SIGINT, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(scope="session", autouse=True)
def lpips_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[weights.Weights | None]:
    """This machine's weights of LPIPS; hidden from all that don't ask, so that CI sees the same."""
    found = weights.load_published()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(weights.PATH_VARIABLE, raising=False)
        patch.setenv("XRGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield found


@pytest.fixture
def published(lpips_weights: weights.Weights | None) -> weights.Weights:
    """The published weights of LPIPS."""
    if lpips_weights is None:
        pytest.skip("no weights of LPIPS on this machine: xrgs-data lpips")
    return lpips_weights


@pytest.fixture
def random_weights() -> weights.Weights:
    """Weights of the network's shapes, and of no use."""
    rng = np.random.default_rng(0)
    made: dict[str, np.ndarray] = {}
    channels, kernels = (3, 64, 192, 384, 256, 256), (11, 5, 3, 3, 3)
    for i, k in enumerate(kernels):
        inputs, outputs = channels[i : i + 2]
        scale = (2 / (inputs * k * k)) ** 0.5
        made[f"conv{i}.weight"] = scale * rng.normal(size=(outputs, inputs, k, k))
        made[f"conv{i}.bias"] = 0.1 * rng.normal(size=outputs)
        made[f"head{i}"] = rng.random(outputs)
    return {name: array.astype(np.float32) for name, array in made.items()}


@pytest.fixture(scope="session")
def compose() -> Callable[..., config.Conf]:
    """(*overrides) -> the config that `conf/` gives with them."""
    return config.compose


@pytest.fixture
def baseline(compose: Callable[..., config.Conf]) -> config.Conf:
    """The baseline's config as `conf/` gives it, 40 steps on the torch backend."""
    return compose("train.steps=40", "splat.backend=torch")


def _camera(width: int, height: int) -> Camera:
    focal = 1.2 * width
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), K, width, height)


@pytest.fixture
def data() -> Dataset:
    """Four views, two of them LR, of one smooth picture; 60 points in front."""
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(60, 3, generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    views = []
    for number, (tag, width, height) in enumerate(
        [("HR", 60, 60), ("LR", 12, 12), ("HR", 60, 60), ("LR", 12, 12)]
    ):
        ramp = torch.linspace(0, 1, width).expand(height, width)
        image = torch.stack([ramp, ramp.flip(1), torch.full_like(ramp, 0.5)], dim=-1)
        views.append(LoadedView(f"v{number}", tag, _camera(width, height), image, rho=width / 60))
    colors = torch.rand(60, 3, generator=generator)
    return Dataset(tuple(views), tuple(views[:1]), points, colors, scene_scale=1.0, factor=5)


def _command(name: str) -> list[str]:
    """`xrgs-<name>`, of the package that is tested."""
    return [sys.executable, "-P", "-c", f"from xrgs.cli.{name} import main; main()"]


@pytest.fixture(scope="session")
def run_command() -> Callable[..., tuple[int, str, str]]:
    """(name, folder, *arguments, **environment) -> exit code, stdout and stderr of `xrgs-<name>`.

    It runs in the folder, from its start to its end; `sweeps_in` is for those that are interfered
    with, or have to end with all that they started.
    """

    def run(name: str, folder: Path, *arguments: str, **environment: str) -> tuple[int, str, str]:
        done = subprocess.run(
            [*_command(name), *arguments],
            cwd=folder,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stdout, done.stderr

    return run


@dataclass(frozen=True)
class Sweep:
    """One call of `xrgs-sweep`."""

    process: subprocess.Popen[bytes]
    printed: Path
    """Folder of the files `out` and `err`."""

    def end(self) -> tuple[int, str, str]:
        """Wait for it; exit code, stdout and stderr."""
        code = self.process.wait(300)
        return code, *((self.printed / name).read_text() for name in ("out", "err"))


@dataclass(frozen=True)
class Sweeps:
    """Sweeps of real processes in a folder of their own, which holds their store `s`."""

    folder: Path
    faults: str = ""
    """Python that every process runs at its start, the cells' too."""

    def start(self, *arguments: str, faults: bool = True) -> Sweep:
        """Start one."""
        printed = Path(tempfile.mkdtemp(prefix="printed-", dir=self.folder))
        (self.folder / "tmp").mkdir(exist_ok=True)
        changes = {"TMPDIR": str(self.folder / "tmp"), "SWEEPS_OF": str(self.folder)}
        if faults and self.faults:
            (self.folder / "site").mkdir(exist_ok=True)
            (self.folder / "site" / "sitecustomize.py").write_text(self.faults)
            path = [str(self.folder / "site"), os.environ.get("PYTHONPATH", "")]
            changes["PYTHONPATH"] = os.pathsep.join(filter(None, path))
        with (printed / "out").open("wb") as out, (printed / "err").open("wb") as err:
            process = subprocess.Popen(
                [*_command("sweep"), "store=s", "threads=1", *arguments],
                cwd=self.folder,
                env=os.environ | changes,
                stdout=out,
                stderr=err,
            )
        return Sweep(process, printed)

    def run(self, *arguments: str, faults: bool = True) -> tuple[int, str, str]:
        """One from its start to its end: exit code, stdout and stderr."""
        ended = self.start(*arguments, faults=faults).end()
        self.leave_nothing_running()
        return ended

    def leave_nothing_running(self) -> None:
        """Assert that these sweeps, and all that they started, come to an end now."""
        end = time.monotonic() + 20
        while left := self.processes():
            assert time.monotonic() < end, left
            time.sleep(0.01)

    def processes(self) -> dict[int, str]:
        """Number and command line of each process that these sweeps have started and that runs."""
        mark = f"SWEEPS_OF={self.folder}".encode()
        found = {}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it may end while it is looked at
                if mark in (process / "environ").read_bytes().split(b"\0"):
                    line = (process / "cmdline").read_bytes().replace(b"\0", b" ")
                    found[int(process.name)] = line.decode()
        return found

    def cells(self) -> dict[int, Path]:
        """The folder of every cell by its seed."""
        found = (self.folder / "s" / "cells").glob("*/identity.json")
        return {
            json.loads(f.read_text())["seed"]: f.parent for f in found if "." not in f.parent.name
        }


@pytest.fixture(scope="session")
def sweeps_in() -> Callable[..., Sweeps]:
    """(folder, faults) -> sweeps in that folder."""
    return Sweeps


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real photographs; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("XRGS_TEST_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no photographs in {folder}: set XRGS_TEST_DATA")
    return folder


@dataclass
class Server:
    """What is served, how badly, and what was asked for."""

    content: bytes = b""
    ranges: bool = True
    cuts: list[int] = field(default_factory=list)
    """Bytes after which each of the first answers breaks off."""
    status: int | None = None
    content_type: str = "application/zip"
    shift: int = 0
    """Added to where a range is said to start."""
    length: bool = True
    """Whether it is said how long the file is."""
    stall: float = 0
    """Seconds before the content."""
    asked: list[str | None] = field(default_factory=list)
    """The Range header of every request."""
    url: str = ""


class _Handler(BaseHTTPRequestHandler):
    state: Server

    def do_GET(self) -> None:
        state, wanted = self.state, self.headers.get("Range")
        state.asked.append(wanted)
        if state.status is not None:
            self.send_error(state.status)
            return
        start, size = 0, len(state.content)
        if wanted and state.ranges:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= size:
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{size}")
                self.end_headers()
                return
            self.send_response(206)
            whole = size if state.length else "*"
            self.send_header("Content-Range", f"bytes {start + state.shift}-{size - 1}/{whole}")
        else:
            self.send_response(200)
        body = state.content[start:]
        self.send_header("Content-Type", state.content_type)
        if state.length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        time.sleep(state.stall)
        with contextlib.suppress(ConnectionError):  # the client may have heard enough
            self.wfile.write(body[: state.cuts.pop(0)] if state.cuts else body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    """A web server on the loopback interface that misbehaves as it is told."""
    state = Server()
    handler = type("Handler", (_Handler,), {"state": state})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as listening:
        state.url = f"http://127.0.0.1:{listening.server_port}/scenes.zip"
        thread = threading.Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield state
        listening.shutdown()
        thread.join()


@pytest.fixture
def xrgs_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """`xrgs-data ARGUMENT...` in an empty folder: exit code, standard output, what is wrong."""

    from xrgs.cli import data

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["xrgs-data", *arguments])
        try:
            data.main()
        except SystemExit as end:
            return 1, capsys.readouterr().out, str(end.code)
        return 0, capsys.readouterr().out, ""

    return run
