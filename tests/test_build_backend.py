"""The build backend: which compiler builds the kernels, and what a build without one requires."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

FILE = Path(__file__).resolve().parents[1] / "build_backend" / "xrgs_build.py"


@dataclass
class ScikitBuild:
    """Stands in for `scikit_build_core.build`: notes the compiler that a build is given."""

    compiler: str | None = None
    beside: list[str] = field(default_factory=list)
    inside: Callable[[], None] = lambda: None

    def build_wheel(self, *_: object) -> str:
        self.compiler = os.environ.get("CXX")
        if self.compiler and Path(self.compiler).is_file():
            self.beside = sorted(path.name for path in Path(self.compiler).parent.iterdir())
        self.inside()
        return "xrgs.whl"

    build_editable = build_wheel

    def build_sdist(self, *_: object) -> str:
        self.inside()
        return "xrgs.tar.gz"

    def get_requires_for_build_wheel(self, _: object) -> list[str]:
        return ["ninja"]

    get_requires_for_build_editable = get_requires_for_build_wheel

    def get_requires_for_build_sdist(self, _: object) -> list[str]:
        return []


@pytest.fixture
def scikit_build(monkeypatch: pytest.MonkeyPatch) -> ScikitBuild:
    made = ScikitBuild()
    monkeypatch.setitem(sys.modules, "scikit_build_core", SimpleNamespace(build=made))
    return made


@pytest.fixture
def backend(scikit_build: ScikitBuild, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The backend on Linux on x86-64, with no program in PATH, no CXX, and no `ziglang`."""
    spec = importlib.util.spec_from_file_location("xrgs_build", FILE)
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", "")
    return module


@pytest.mark.parametrize(
    ("programs", "cxx", "compiler", "said"),
    [
        ({"c++": 0}, "", "{bin}/c++", ""),
        ({"c++": 1, "g++": 1, "clang++": 0}, "", "{bin}/clang++", ""),
        ({"c++": 1, "mine": 0}, "{bin}/mine -pipe", "{bin}/mine -pipe", ""),
        ({"c++": 0}, "/nonexistent", "/nonexistent", "CXX=/nonexistent is no .*without kernels"),
        ({"c++": 0}, "'", "'", "CXX=' is no C.* compiler that works"),
        ({"c++": 1}, "", None, r"c\+\+, g\+\+, clang\+\+.* ziglang is missing: "),
    ],
)
def test_the_compiler_is_that_of_cxx_or_else_the_first_that_works(
    backend: Any,
    scikit_build: ScikitBuild,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    programs: dict[str, int],
    cxx: str,
    compiler: str | None,
    said: str,
) -> None:
    """Nothing replaces CXX's. A build without a compiler requires `ziglang`, and goes on."""
    for name, code in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\nexit {code}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    if cxx:
        monkeypatch.setenv("CXX", cxx.format(bin=tmp_path))
        installed = importlib.machinery.ModuleSpec("ziglang", None)
        monkeypatch.setattr(importlib.util, "find_spec", lambda _: installed)
    before = os.environ.get("CXX")
    required = ["ninja", *([] if compiler else [backend.ZIGLANG])]
    assert backend.get_requires_for_build_wheel({}) == required
    assert backend.get_requires_for_build_editable({}) == required
    assert backend.get_requires_for_build_sdist({}) == []
    for build in (backend.build_wheel, backend.build_editable):
        assert build("dist") == "xrgs.whl"
        assert scikit_build.compiler == (compiler and compiler.format(bin=tmp_path))
        assert os.environ.get("CXX") == before
    assert re.search(said, err := capsys.readouterr().err)
    assert bool(err) == bool(said)


@pytest.mark.parametrize(("system", "machine"), [("Darwin", "arm64"), ("Linux", "riscv64")])
def test_other_machines_get_no_ziglang(
    backend: Any, monkeypatch: pytest.MonkeyPatch, system: str, machine: str
) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert backend.get_requires_for_build_wheel({}) == ["ninja"]


def test_ziglang_builds_where_nothing_else_does(
    backend: Any,
    scikit_build: ScikitBuild,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The commands that CMake gets call `ziglang` for any processor, and are gone afterwards."""
    (tmp_path / "ziglang.py").write_text("import sys; print(*sys.argv[1:])")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = importlib.machinery.ModuleSpec("ziglang", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: found)
    called: dict[str, str] = {}

    def call() -> None:
        for variable in ("CC", "CXX"):
            command = [os.environ[variable], "-c", "a file.cpp"]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            called[variable] = done.stdout.strip()

    scikit_build.inside = call
    backend.build_wheel("dist")
    assert "ziglang compiles the kernels" in capsys.readouterr().err
    assert scikit_build.beside == ["ar", "c++", "cc", "ranlib"]
    for variable, name in (("CC", "cc"), ("CXX", "c++")):
        assert called[variable].startswith(f"{name} -target x86_64-linux-gnu.")
        assert "-mcpu=baseline" in called[variable]
        assert called[variable].endswith("-c a file.cpp")
    assert scikit_build.compiler is not None
    assert not Path(scikit_build.compiler).exists()
    assert not {"CC", "CXX", "ZIG_GLOBAL_CACHE_DIR"} & os.environ.keys()


# The commit


@pytest.fixture
def checkout(backend: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout of the file that reads commits, which the backend takes for its own."""
    monkeypatch.setenv("PATH", os.defpath)
    package = tmp_path / "checkout" / "xrgs"
    (package / "store").mkdir(parents=True)
    shutil.copy(FILE.parents[1] / "xrgs/store/commit.py", package / "store")
    (package.parent / ".gitignore").write_text("/xrgs/_commit.json\n__pycache__/\n")
    monkeypatch.setattr(backend, "_ROOT", package.parent)
    git(package.parent, "init", "--quiet")
    git(package.parent, "add", ".")
    git(package.parent, "commit", "--quiet", "-m", "all")
    return package.parent


def git(folder: Path, *arguments: str) -> str:
    names = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    command = ["git", "-C", str(folder), *names, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.slow
def test_a_build_carries_the_commit_where_it_can_and_leaves_no_file(
    backend: Any, scikit_build: ScikitBuild, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    built: list[dict[str, Any]] = []
    file = checkout / "xrgs" / "_commit.json"
    scikit_build.inside = lambda: built.append(json.loads(file.read_text()))
    backend.build_wheel("dist")
    assert git(checkout, "status", "--porcelain", "--ignored") == ""
    (checkout / "xrgs" / "new.py").write_text("1")
    backend.build_sdist("dist")
    commit = git(checkout, "rev-parse", "HEAD")
    clean, changed = built
    assert clean == {"git": commit, "git_diff_sha256": None}
    assert changed["git"] == commit
    assert len(changed["git_diff_sha256"]) == 64
    assert not file.exists()

    def fail() -> None:
        raise RuntimeError(f"CMake failed, written: {file.is_file()}")

    scikit_build.inside = fail
    for build in (backend.build_sdist, backend.build_wheel):
        with pytest.raises(RuntimeError, match="CMake failed, written: True"):
            build("dist")
        assert not file.exists()
        assert "CXX" not in os.environ
    file.mkdir()  # can't be written; the owner of a read-only folder may be root
    scikit_build.inside = lambda: built.append({})
    backend.build_wheel("dist")
    assert len(built) == 3
    assert "the package will not know its commit" in capsys.readouterr().err


@pytest.mark.slow
def test_a_wheel_of_an_sdist_has_the_commit_of_the_sdist(
    backend: Any, scikit_build: ScikitBuild, checkout: Path
) -> None:
    """An unpacked sdist has the file and is no checkout, even inside one."""
    shutil.rmtree(checkout / ".git")
    git(checkout.parent, "init", "--quiet")
    file = checkout / "xrgs" / "_commit.json"
    file.write_text('{"git": "0123", "git_diff_sha256": null}')
    built: list[str] = []
    scikit_build.inside = lambda: built.append(file.read_text())
    backend.build_wheel("dist")
    assert built == [file.read_text()] == ['{"git": "0123", "git_diff_sha256": null}']


@pytest.mark.skipif(shutil.which("c++") is None, reason="this machine has no compiler")
def test_a_real_compiler_is_found_and_a_c_compiler_is_not_enough(
    backend: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    monkeypatch.setenv("CXX", "c++")
    assert backend.find_compiler() == "c++"
    monkeypatch.setenv("CXX", "c++ -x c")
    assert backend.find_compiler() is None
