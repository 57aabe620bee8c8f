"""Runs commands of the package in forks of a process that has imported torch and the like once.

A process of its own imports for seconds; a fork begins at once, and is as apart from other tests.
The children of a sweep, which build variants and train cells, are forks too. They differ from those
that a user has in one way: a sweep that is killed does not end them.

As a program, `forks.py SOCKET MODULE ...` is the process that imports the modules and forks.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import socketserver
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from runpy import run_path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from xrgs.config import LimitsConf
    from xrgs.sweep.job import ProcessEnd

#: The module that is the child of a sweep.
WORKER = "xrgs.sweep.job"
#: What the package imports from others, some of it late.
LIBRARIES = (
    *("hydra", "jinja2", "kornia.losses", "matplotlib.backends.backend_agg", "matplotlib.figure"),
    *("msgspec", "pandas", "psutil", "pycolmap", "scipy.spatial", "scipy.stats", "tqdm", "tyro"),
)
#: What the commands and the children of a sweep import.
MODULES = (
    *(f"xrgs.cli.{name}" for name in ("bench", "render", "report", "status", "store", "sweep")),
    *("xrgs.mixture.sfm", "xrgs.bench.run", "xrgs.store.cell", "xrgs.report", "xrgs.sweep.rerun"),
    *("xrgs.viewer.film", "xrgs.viewer.trained"),
    *LIBRARIES,
)


def ask(file: str, **request: Any) -> tuple[TextIO, int]:
    """Ask the process that listens on a socket for a fork; return its answers and its id."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(file)
        answers = connection.makefile("rw")
    answers.write(json.dumps(request) + "\n")
    answers.flush()
    return answers, int(answers.readline())


def exit_code(answers: TextIO) -> int:
    """Wait for the end of a fork; one that was killed gives no code."""
    with answers:
        return int(answers.readline() or -signal.SIGKILL)


class _Handler(socketserver.StreamRequestHandler):
    """Runs in a fork, which does what it is asked for."""

    def handle(self) -> None:
        request = json.loads(self.rfile.readline())
        self.wfile.write(b"%d\n" % os.getpid())
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update(request["environment"])
        sys.path[:0] = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
        sys.meta_path.insert(0, PathFinder)  # before that of an editable installation
        for descriptor, name in enumerate((os.devnull, *request["printed"])):
            opened = os.open(name, os.O_RDWR | os.O_APPEND | os.O_CREAT)
            os.dup2(opened, descriptor)
            os.close(opened)
        self.wfile.write(b"%d\n" % self._run(**request))

    def _run(self, main: str, arguments: Sequence[str], printed: list[str], **_: Any) -> int:
        """Run a file, or the function `main` of a module, as a program; return its exit code."""
        from xrgs.sweep import job

        def run_supervised(
            command: Sequence[str],
            limits: LimitsConf | None = None,
            on_poll: Callable[[int], None] = lambda _: None,
            environment: Mapping[str, str] = MappingProxyType({}),
        ) -> ProcessEnd:
            child_main = {"main": WORKER, "arguments": command[-3:], "printed": printed}
            place = {"folder": str(Path.cwd()), "environment": os.environ | environment}
            answers, child = ask(str(self.server.server_address), **child_main, **place)
            on_poll(child)
            return job.ProcessEnd(exit_code(answers))

        job.run_supervised = run_supervised
        sys.argv = [main.replace("xrgs.cli.", "xrgs-"), *arguments]
        try:
            if os.sep in main:
                run_path(main, run_name="__main__")
            else:
                import_module(main).main(*arguments if main == WORKER else ())
        except SystemExit as end:
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)  # noqa: T201
                return 1
            return end.code or 0
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
        return 0


class _Server(socketserver.ForkingMixIn, socketserver.UnixStreamServer):
    pass


@contextmanager
def server(*modules: str) -> Iterator[Callable[..., tuple[int, str, str]]]:
    """Give the function (name, folder, *arguments, **environment) -> exit code, stdout and stderr.

    The name is the command's without "xrgs-", or the path of a script. The modules are imported
    once; without those of the package, each fork imports the package that its PYTHONPATH has.
    """
    # Not in pytest's folder: the path of a socket may have at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="xrgs-forks-") as folder:
        file = f"{folder}/socket"
        process = subprocess.Popen(
            [sys.executable, "-P", __file__, file, *modules], stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        process.stdout.readline()  # it listens

        def run(
            name: str, where: Path, *arguments: str, **environment: str
        ) -> tuple[int, str, str]:
            printed = [f"{tempfile.mkdtemp(dir=folder)}/{name}" for name in ("stdout", "stderr")]
            what = {
                "main": name if os.sep in name else f"xrgs.cli.{name}",
                "arguments": arguments,
                "printed": printed,
            }
            place = {"folder": str(where), "environment": os.environ | environment}
            code = exit_code(ask(file, **what, **place)[0])
            out, err = (Path(path).read_bytes().decode() for path in printed)
            return code, out, err

        yield run
        process.terminate()
        process.communicate()


def _serve(file: str, *modules: str) -> None:
    for name in modules:
        import_module(name)
    with _Server(file, _Handler) as listening:
        print(flush=True)  # noqa: T201
        listening.serve_forever()


if __name__ == "__main__":
    _serve(*sys.argv[1:])
