"""A web server on the loopback interface that misbehaves as it is told."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from xrgs import cli


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
def data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """`xrgs-data ARGUMENT...` in an empty folder: exit code, standard output, what is wrong."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["xrgs-data", *arguments])
        try:
            cli.data()
        except SystemExit as end:
            return 1, capsys.readouterr().out, str(end.code)
        return 0, capsys.readouterr().out, ""

    return run
