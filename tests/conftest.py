"""Fixtures that the tests of several packages share."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import importlib
import io
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import nullcontext, redirect_stderr, redirect_stdout, suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import cache, partial, reduce
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml

from tests import pdflatex
from xrgs import composing, config
from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.mixture import variant
from xrgs.safeio import code
from xrgs.store.store import Store
from xrgs.sweep import job

# torch is imported where it is used: the process that hands out the tests needs none.
if TYPE_CHECKING:
    from xrgs.splat.cameras import Camera
    from xrgs.training.dataset import Dataset

pytest_plugins = ["tests.variant_fixtures"]


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Look for no garbage among what is imported: that takes a quarter of the collection's time.

    It stays until the end, so that tests needn't look through it either.
    """
    if session.config.getoption("numprocesses", None):  # its workers collect
        return (yield)
    gc.disable()
    _hydra_reads_equal_text_once()
    os.environ["HYPOTHESIS_NO_PLUGINS"] = "1"  # one would import all of trio
    from hypothesis import HealthCheck, settings

    # How long an example takes tells how busy the machine is, and fails no test.
    health = [HealthCheck.too_slow]
    settings.register_profile("untimed", deadline=None, suppress_health_check=health)
    settings.load_profile("untimed")
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000)  # hypothesis notes each time that garbage is looked for
        gc.enable()


def _hydra_reads_equal_text_once() -> None:
    """Keep what Hydra parses of a word and of a file: most of the time of a config goes there."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    words: dict[tuple[str, str], Any] = {}
    files: dict[tuple[str, str], bytes] = {}
    parse, load = OverridesParser.parse_rule, yaml.load

    def parse_once(parser: Any, word: str, rule: str) -> Any:
        if (word, rule) not in words:
            words[word, rule] = parse(parser, word, rule)
        return deepcopy(words[word, rule])

    def load_once(stream: Any, Loader: Any) -> Any:
        if not isinstance(stream, io.IOBase):
            return load(stream, Loader)
        key = stream.read(), Loader.__name__
        if key not in files:
            stream.seek(0)
            files[key] = pickle.dumps(load(stream, Loader))
        return pickle.loads(files[key])  # noqa: S301 - our own, and much faster than a copy

    patch = pytest.MonkeyPatch()
    patch.setattr(OverridesParser, "parse_rule", parse_once)
    patch.setattr(yaml, "load", load_once)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark exhaustive tests as slow too, and put files with slow tests first.

    `-m "not slow"` replaces the `-m` of pyproject.toml. With `-n`, one worker runs a file: a long
    one at the end would leave the other workers idle.
    """
    for item in items:
        if item.get_closest_marker("exhaustive"):
            item.add_marker("slow")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def _source_is_read_once(patch: pytest.MonkeyPatch) -> None:
    """Keep what digests of code take from a file's text: tests edit copies of the package."""
    own_imports = code._own_imports.__wrapped__
    found: dict[bytes, frozenset[str]] = {}

    def own_imports_once(file: Path, modified_ns: int) -> frozenset[str]:
        content = file.read_bytes()
        if content not in found:
            found[content] = own_imports(file, modified_ns)
        return found[content]

    patch.setattr(code, "meaning", cache(code.meaning))
    patch.setattr(code, "_own_imports", cache(own_imports_once))


@pytest.fixture(scope="session", autouse=True)
def _process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Prepare this process for tests, and compile every `table.tex` that they make, in one go.

    This is one fixture, since each test looks at each fixture that all have.
    """
    import torch

    torch.set_num_threads(1)  # a second one costs more than it gives on small tensors
    # A shell's `&` ignores signals that tests send.
    ignored = [n for n in (signal.SIGINT, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # no power fails while tests run
        patch.setenv("TERM", "xterm")  # terminals of tests draw lines anew
        _source_is_read_once(patch)
        yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)
    if pdflatex.PDFLATEX:
        files = tmp_path_factory.getbasetemp().rglob("table.tex")
        texts = dict.fromkeys(file.read_text(encoding="utf-8") for file in sorted(files))
        if texts:
            errors = pdflatex.errors_of(texts, tmp_path_factory.mktemp("pdflatex"))
            assert not errors, errors


@pytest.fixture(scope="session", autouse=True)
def lpips_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[weights.Weights | None]:
    """Hide this machine's LPIPS weights from all tests, which then see the same and fetch none.

    The value is the weights, or None if the machine has none; tests get them as `published`.
    """
    found = weights.load_published()
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(weights.PATH_VARIABLE, raising=False)
        patch.setenv("XRGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("XRGS_LPIPS_FETCH", "false")
        yield found


@pytest.fixture
def published(lpips_weights: weights.Weights | None) -> weights.Weights:
    """Return the published LPIPS weights; the test is skipped if this machine has none."""
    if lpips_weights is None:
        pytest.skip("this machine has no LPIPS weights: `xrgs-data lpips` downloads them")
    return lpips_weights


@cache
def _random_weights() -> weights.Weights:
    rng = np.random.default_rng(0)
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    channels, kernels = (3, 8, 12, 16, 12, 12), (11, 5, 3, 3, 3)
    for i, k in enumerate(kernels):
        inputs, outputs = channels[i : i + 2]
        scale = (2 / (inputs * k * k)) ** 0.5
        arrays[f"conv{i}.weight"] = scale * rng.normal(size=(outputs, inputs, k, k))
        arrays[f"conv{i}.bias"] = 0.1 * rng.normal(size=outputs)
        arrays[f"head{i}"] = rng.random(outputs)
    return {name: array.astype(np.float32) for name, array in arrays.items()}


@pytest.fixture
def random_weights() -> weights.Weights:
    """Return random weights of a network narrower than LPIPS's, which a test may change."""
    return deepcopy(_random_weights())


#: The function itself: tests of commands put `composed_by_hydra` in its place.
_compose = composing.compose


@cache
def _composed(overrides: tuple[str, ...], _environment: tuple[tuple[str, str], ...]) -> config.Conf:
    return _compose(*overrides)


def composed_by_hydra(*overrides: str) -> config.Conf:
    """Compose a config as `composing.compose` does, but equal ones once: Hydra takes 0.1 s each.

    `preset=laptop` stands for the default preset: tests know gsplat's own learning rates.
    """
    if not any(word.startswith(("preset=", "+sweeps=")) for word in overrides):
        overrides = ("preset=laptop", *overrides)
    environment = sorted(item for item in os.environ.items() if item[0].startswith("XRGS_"))
    return deepcopy(_composed(overrides, tuple(environment)))


#: An override with a number, a flag, a name or a path, and keys from which `conf/` takes others.
_PLAIN = re.compile(r"([a-z]\w*(?:\.\w+)+|threads|checkpoint_s|store)=([-+\w./]+)")
_TAKEN_FROM = frozenset({"splat.raster.background", "splat.densify.stop"})


def composed(*overrides: str) -> config.Conf:
    """Return `composed_by_hydra`, but set plain values in the config of the other words.

    tests/test_config.py compares the two. What is not plain, and unknown keys and wrong types, are
    left to Hydra.
    """
    plain = dict(word.split("=") for word in overrides if _PLAIN.fullmatch(word))
    others = tuple(word for word in overrides if not _PLAIN.fullmatch(word))
    if not plain or _TAKEN_FROM & plain.keys():
        return composed_by_hydra(*overrides)
    if "scene.path" in plain:
        others += ("scene.path=/",)  # a folder makes no config without it
    try:
        values = asdict(composed_by_hydra(*others))
    except Exception:  # a value is missing
        return composed_by_hydra(*overrides)
    try:
        for key, text in plain.items():
            *groups, name = key.split(".")
            group = reduce(getitem, groups, values)
            group[name] = _value_like(group[name], text)
        return composing.to_conf(values)  # type: ignore[arg-type]
    except (KeyError, TypeError):  # an unknown key, a wrong type
        return composed_by_hydra(*overrides)


def _value_like(old: Any, text: str) -> Any:
    """Read the text of an override that has the type of the value in its place."""
    new = yaml.safe_load(text)
    if type(old) is float and type(new) is int:
        return float(new)
    if type(new) is not type(old):
        raise TypeError(text)
    return new


@pytest.fixture(scope="session")
def compose() -> Callable[..., config.Conf]:
    """Return the function (*overrides) -> the config that `conf/` gives with these overrides."""
    return composed


@pytest.fixture
def baseline(compose: Callable[..., config.Conf]) -> config.Conf:
    """Return the baseline's config with 40 steps on the torch backend."""
    return compose("train.steps=40", "splat.backend=torch")


def _camera(width: int, height: int) -> Camera:
    import torch

    from xrgs.splat.cameras import Camera

    focal = 1.2 * width
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), K, width, height)


def ramps() -> Dataset:
    """Return four views of a smooth ramp, two HR and two LR, and 60 points in front of them."""
    import torch

    from xrgs.training.dataset import Dataset, LoadedView

    generator = torch.Generator().manual_seed(3)
    points = torch.rand(60, 3, generator=generator) - 0.5 + torch.tensor([0.0, 0.0, 2.0])
    views = []
    for number, (tag, width, height) in enumerate(
        [("HR", 60, 60), ("LR", 12, 12), ("HR", 60, 60), ("LR", 12, 12)]
    ):
        ramp = torch.linspace(0, 1, width).expand(height, width)
        image = torch.stack([ramp, ramp.flip(1), torch.full_like(ramp, 0.5)], dim=-1)
        camera, rho = _camera(width, height), width / 60
        views.append(LoadedView(f"v{number}", tag, camera, image, rho, supersampling=1 / rho))
    colors = torch.rand(60, 3, generator=generator)
    return Dataset(tuple(views), tuple(views[:1]), points, colors, scene_scale=1.0, factor=5)


@pytest.fixture
def data() -> Dataset:
    """Return `ramps`."""
    return ramps()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """(name, function of a folder) -> the folder, which the function has made for all workers."""
    home = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        home = home.parent

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder = home / f"once-{name}"
        with (home / f"once-{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / "made").exists():
                folder.mkdir()  # an error where another worker has failed to make it
                make(folder)
                (folder / "made").touch()
        return folder

    return made


@pytest.fixture(scope="session")
def smoke_variants(made_once: Callable[..., Path]) -> Path:
    """The folder `variants` of a store, with the variant of `scene=motorcycle preset=smoke`."""

    def build(folder: Path) -> None:
        store, conf = Store(folder / "s"), composed("scene=motorcycle", "preset=smoke")
        store.prepare()
        variant.build(conf.scene, conf.variant, store.variants, store.scenes)

    return made_once("smoke", build) / "s" / "variants"


def work_here(work: str, request: Mapping[str, Any], *_: object) -> dict[str, Any]:
    """Do what `job.run_in_child` does in this process, which has imported torch already."""
    from xrgs.runtime.signals import StopRequest
    from xrgs.store import cell, trimming
    from xrgs.store.cell_folder import CellFolder

    request = json.loads(json.dumps(request))
    try:
        if work == "cell":
            folder = CellFolder(Path(request["cell"]))
            built = variant.load(Path(request["variant"]))
            cell.run_cell(folder.config(), built, folder, StopRequest())
            return {"found": folder.summary().found}
        conf, store = composing.from_dict(request["conf"]), Store(Path(request["store"]))
        if (trimmed := request.get("variant")) is None:
            made = variant.build(conf.scene, conf.variant, store.variants, store.scenes)
            return {"variant": made.id}
        trimming.restore_variant(store.variants, trimmed, conf.scene, conf.variant, store.scenes)
        return {}
    except XrgsError as error:
        raise job.WorkError(str(error)) from error


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let sweeps build variants and train cells in this process."""
    monkeypatch.setattr(job, "run_in_child", work_here)


SMOKE = ("scene=motorcycle", "preset=smoke", "train.steps=8")
#: The command line of `swept`.
SWEEP = ("+ablation=consistency", *SMOKE, "track=csv", "threads=1", "store=s")


@pytest.fixture(scope="session")
def swept(made_once: Callable[..., Path], smoke_variants: Path) -> tuple[Path, str]:
    """A folder with a finished smoke sweep in its store `s`, and what was printed.

    The store's folder `cells` is a link.
    """

    def sweep_once(folder: Path) -> None:
        shutil.copytree(smoke_variants, folder / "s" / "variants")
        (folder / "disk").mkdir()
        (folder / "s" / "cells").symlink_to(folder / "disk")
        with (
            pytest.MonkeyPatch.context() as patch,
            redirect_stdout(io.StringIO()) as out,
            redirect_stderr(io.StringIO()) as err,
        ):
            patch.setattr(job, "run_in_child", work_here)
            _prepared(patch, folder, "sweep", *SWEEP)()
        assert err.getvalue().count("training cell") == 2
        (folder / "printed").write_text(out.getvalue(), encoding="utf-8")

    folder = made_once("swept", sweep_once)
    return folder, (folder / "printed").read_text(encoding="utf-8")


@dataclass(frozen=True)
class Sweep:
    """A running process of `xrgs-sweep`."""

    process: subprocess.Popen[bytes]
    printed: Path
    """Folder with the files `out` and `err`, which hold stdout and stderr."""

    def end(self) -> tuple[int, str, str]:
        """Wait for the end; return the exit code, stdout and stderr."""
        code = self.process.wait(300)
        return code, (self.printed / "out").read_text(), (self.printed / "err").read_text()


#: The command line of `xrgs-sweep` of the package under test.
COMMAND = (sys.executable, "-P", "-c", "from xrgs.cli.sweep import main; main()")


@dataclass(frozen=True)
class Sweeps:
    """Starts sweeps as real processes in a folder of its own, with the store `s` in it."""

    folder: Path
    faults: str = ""
    """Python code that every process of the sweep runs at its start, the cells' included."""
    started: list[Sweep] = field(default_factory=list)

    def start(self, *arguments: str, faults: bool = True) -> Sweep:
        """Start a sweep with these arguments and return at once."""
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
                [*COMMAND, "store=s", "threads=1", *arguments],
                cwd=self.folder,
                env=os.environ | changes,
                stdout=out,
                stderr=err,
            )
        # Kept: a process that is forgotten while it runs is a warning in whichever test is next.
        self.started.append(Sweep(process, printed))
        return self.started[-1]

    def run(self, *arguments: str, faults: bool = True) -> tuple[int, str, str]:
        """Run a sweep to its end; return the exit code, stdout and stderr."""
        ended = self.start(*arguments, faults=faults).end()
        self.leave_nothing_running()
        return ended

    def leave_nothing_running(self) -> None:
        """Assert that all processes of these sweeps end within 20 s."""
        end = time.monotonic() + 20
        while running := self.processes():
            assert time.monotonic() < end, running
            time.sleep(0.01)

    def processes(self) -> dict[int, str]:
        """Return the command line of each running process of these sweeps, by its process id."""
        mark = f"SWEEPS_OF={self.folder}".encode()
        command_lines = {}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # the process may have ended meanwhile
                if mark in (process / "environ").read_bytes().split(b"\0"):
                    line = (process / "cmdline").read_bytes().replace(b"\0", b" ")
                    command_lines[int(process.name)] = line.decode()
        return command_lines

    def cells(self) -> dict[int, Path]:
        """Return the folder of each cell that has begun by its seed."""
        logs = (self.folder / "s" / "cells").glob("*/log.txt")
        folders = [file.parent for file in logs if "." not in file.parent.name]
        return {json.loads((of / "identity.json").read_text())["seed"]: of for of in folders}


@pytest.fixture(scope="session")
def sweeps_in() -> Iterator[Callable[..., Sweeps]]:
    """Return the function (folder, faults) -> `Sweeps` in that folder."""
    made: list[Sweeps] = []

    def sweeps_in(*arguments: Any) -> Sweeps:
        made.append(Sweeps(*arguments))
        return made[-1]

    yield sweeps_in
    # What a failed test has left running.
    for sweep in (sweep for sweeps in made for sweep in sweeps.started):
        sweep.process.kill()
        sweep.process.wait()
    for process_id in (process_id for sweeps in made for process_id in sweeps.processes()):
        os.kill(process_id, signal.SIGKILL)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Return the folder of real photographs; the test is skipped if it is absent."""
    folder = Path(os.environ.get("XRGS_TEST_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"there is no folder {folder}: set XRGS_TEST_DATA to one with photographs")
    return folder


@dataclass
class Server:
    """The state of the test web server: what it serves, its faults, and the requests so far."""

    content: bytes = b""
    etag: str = '"first"'
    """The version of the content; a range of another version is answered by all of it."""
    ranges: bool = True
    """Whether requests for a range are answered by that range."""
    cuts: list[int] = field(default_factory=list)
    """Number of bytes after which the body of each of the first answers breaks off."""
    answers: list[bytes] = field(default_factory=list)
    """Whole answers, headers included, to the first requests, in place of the content."""
    asked: list[str | None] = field(default_factory=list)
    """The Range header of each request so far, None if there was none."""
    url: str = ""


class _Handler(BaseHTTPRequestHandler):
    state: Server

    def do_GET(self) -> None:
        state, byte_range = self.state, self.headers.get("Range")
        state.asked.append(byte_range)
        with contextlib.suppress(ConnectionError):  # the client may close the connection first
            if state.answers:
                self.wfile.write(state.answers.pop(0))
            else:
                self._send_content(byte_range)

    def _send_content(self, byte_range: str | None) -> None:
        state, start, size = self.state, 0, len(self.state.content)
        if byte_range and state.ranges and self.headers.get("If-Range") == state.etag:
            start = int(byte_range.removeprefix("bytes=").removesuffix("-"))
            if start >= size:
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
        else:
            self.send_response(200)
        body = state.content[start:]
        self.send_header("ETag", state.etag)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: state.cuts.pop(0)] if state.cuts else body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        pass


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let downloads try again at once; return the seconds that they would have waited."""
    from xrgs.photos.download import http

    waited: list[float] = []
    monkeypatch.setattr(http, "sleep", waited.append)
    return waited


@pytest.fixture
def server(pauses: list[float]) -> Iterator[Server]:
    """Start a web server on the loopback interface; return its state, whose faults can be set."""
    state = Server()
    handler = type("Handler", (_Handler,), {"state": state})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as listening:
        state.url = f"http://127.0.0.1:{listening.server_port}/scenes.zip"
        thread = threading.Thread(target=listening.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield state
        listening.shutdown()
        thread.join()


def _prepared(
    patch: pytest.MonkeyPatch, folder: Path, name: str, *arguments: str
) -> Callable[[], object]:
    """Return the `main` of a command, for which this process is prepared until the patch ends."""
    main: Callable[[], object] = importlib.import_module(f"xrgs.cli.{name}").main
    for module in ("options", "sweep"):  # pytest keeps its own handlers of signals
        patch.setattr(f"xrgs.cli.{module}.exit_on_signal", nullcontext)
    patch.chdir(folder)
    patch.setenv("OMP_WAIT_POLICY", os.environ.get("OMP_WAIT_POLICY", "passive"))
    patch.setattr(sys, "argv", [f"xrgs-{name}", *arguments])
    return main


@pytest.fixture
def call_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs a command in this process, in the folder `tmp_path`.

    Its arguments are (name, *arguments), the name without "xrgs-"; it returns the exit code, stdout
    and stderr.
    """

    def call(name: str, *arguments: str) -> tuple[int, str, str]:
        main = _prepared(monkeypatch, tmp_path, name, *arguments)
        code, message = 0, ""
        try:
            main()
        except SystemExit as end:
            message = end.code if isinstance(end.code, str) else ""
            code = 1 if message else int(end.code or 0)
        out, err = capsys.readouterr()
        return code, out, err + message

    return call


@pytest.fixture
def sweep_here(
    call_command: Callable[..., tuple[int, str, str]],
) -> Callable[..., tuple[int, str, str]]:
    """Return `call_command` for `xrgs-sweep`."""
    return partial(call_command, "sweep")


@pytest.fixture
def xrgs_data(
    call_command: Callable[..., tuple[int, str, str]],
) -> Callable[..., tuple[int, str, str]]:
    """Return `call_command` for `xrgs-data`."""
    return partial(call_command, "data")


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Debian's chromium without a screen, that reaches this machine alone; skipped without it."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    found = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
    if missing := [name for name, path in found.items() if path is None]:
        pytest.skip(f"there is no {' and no '.join(missing)}: apt-get install chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = found["chromium"]
    for flag in (
        *("headless=new", "no-sandbox", "disable-quic", "no-first-run", "disable-sync"),
        *("disable-background-networking", "disable-component-update"),
        *("use-angle=swiftshader", "enable-unsafe-swiftshader"),  # WebGL without a GPU
        "force-prefers-reduced-motion",  # a click waits for no scrolling
        "host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
        f"user-data-dir={tmp_path_factory.mktemp('chromium')}",
        "window-size=1200,900",
    ):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(found["chromedriver"])
    driver = webdriver.Chrome(options=options, service=service)
    yield driver
    driver.quit()


@pytest.fixture
def browser(chromium: Any) -> Iterator[Any]:
    """`chromium`, which shows nothing after the test: pages that draw take a core."""
    yield chromium
    chromium.get("about:blank")
