"""The build backend: scikit-build-core, with a compiler from PyPI where the machine has none.

The kernels need a C++17 compiler. If none is found, the build requires the wheels of `ziglang`,
which contain clang and the C++ library, and CMake uses that compiler. If the variable CXX names a
compiler, no other is tried: CXX=/nonexistent installs the package without kernels. If the build of
the kernels fails for any reason, the package renders with torch (`if.failed` in pyproject.toml).

An sdist or a wheel built from a checkout has `xrgs/_commit.json`: the commit, and a hash of
uncommitted changes. A wheel built from an sdist has the sdist's file.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scikit_build_core import build as _scikit_build

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
]

#: Zig's command line changes between minor versions.
ZIGLANG = "ziglang>=0.17.1,<0.18"
#: The system and the machines on which ziglang has built the kernels.
_ZIGLANG_SYSTEM, _ZIGLANG_MACHINES = "Linux", ("x86_64", "aarch64")
#: Compilers, in the order in which CMake tries them.
_COMPILERS = ("c++", "g++", "clang++")
#: A source that a working C++17 compiler and its library must compile.
_TRIAL = """\
#include <optional>
#include <stdexcept>
int trial(std::optional<int> value) {
  if (!value) throw std::runtime_error("");
  return *value;
}
"""
#: With a target, Zig takes the C library's headers from its own wheel (machines without a compiler
#: seldom have any) and compiles for all processors of the architecture. All wheels of torch need
#: this glibc or a newer one.
_TARGET = "{machine}-linux-gnu.2.28"
#: Debian's Python.h includes a header relative to /usr/include. Without an optimization level, as
#: in CMake's trial of the compiler, Zig adds checks that need an extra library.
_CLANG_OPTIONS = ("-mcpu=baseline", "-idirafter", "/usr/include", "-fno-sanitize=undefined")

_ROOT = Path(__file__).resolve().parents[1]

get_requires_for_build_sdist = _scikit_build.get_requires_for_build_sdist


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what the build of a wheel requires: see PEP 517."""
    return [*_scikit_build.get_requires_for_build_wheel(config_settings), *_required_compiler()]


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what an editable installation requires: see PEP 660."""
    return [*_scikit_build.get_requires_for_build_editable(config_settings), *_required_compiler()]


def build_sdist(sdist_directory: str, config_settings: dict[str, Any] | None = None) -> str:
    """Build an sdist and return its name: see PEP 517."""
    with _commit_file():
        return str(_scikit_build.build_sdist(sdist_directory, config_settings))


def build_wheel(
    wheel_directory: str,
    config_settings: dict[str, Any] | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Build a wheel and return its name: see PEP 517."""
    with _compiler(), _commit_file():
        return str(_scikit_build.build_wheel(wheel_directory, config_settings, metadata_directory))


def build_editable(
    wheel_directory: str,
    config_settings: dict[str, Any] | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Build the wheel of an editable installation and return its name: see PEP 660."""
    with _compiler():
        return str(
            _scikit_build.build_editable(wheel_directory, config_settings, metadata_directory)
        )


@contextlib.contextmanager
def _commit_file() -> Iterator[None]:
    """Write the commit of a checkout into the package during a `with` block.

    Outside of a checkout nothing is written. If the checkout is read-only, the package has no
    commit.
    """
    source = _ROOT / "xrgs" / "store" / "commit.py"
    commit = runpy.run_path(str(source))  # `import xrgs` needs packages that a build lacks
    content = commit["of_checkout"](_ROOT)
    if content is None:
        yield
        return
    file = _ROOT / "xrgs" / commit["FILE"]
    try:
        file.write_text(json.dumps(content), "utf-8")
    except OSError as error:
        _say(f"{file}: {error.strerror}: the package will not know its commit")
        yield
        return
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def find_compiler() -> str | None:
    """Return the command of a C++17 compiler: CXX if that is set, else the first that works.

    Returns:
        The command, with the options in CXX; None if no compiler works.
    """
    named = os.environ.get("CXX", "").strip()
    candidates = [named] if named else [path for name in _COMPILERS if (path := shutil.which(name))]
    return next((command for command in candidates if _compiles(command)), None)


def _compiles(command: str) -> bool:
    """Return whether a compiler builds a shared library from a C++17 source."""
    with tempfile.TemporaryDirectory(prefix="xrgs-build-") as folder:
        source = Path(folder, "trial.cpp")
        source.write_text(_TRIAL, "utf-8")
        options = ["-std=c++17", "-shared", "-fPIC", str(source), "-o", str(source) + ".so"]
        try:
            arguments = [*shlex.split(command), *options]
            done = subprocess.run(arguments, capture_output=True, check=False)  # noqa: S603
        except (OSError, ValueError):
            return False
        return done.returncode == 0


def _required_compiler() -> list[str]:
    """Return the requirement of a compiler from PyPI, if the machine has none."""
    supported = platform.system() == _ZIGLANG_SYSTEM and platform.machine() in _ZIGLANG_MACHINES
    named = os.environ.get("CXX", "").strip()
    return [ZIGLANG] if supported and not named and find_compiler() is None else []


@contextlib.contextmanager
def _compiler() -> Iterator[None]:
    """Set CXX to a compiler that works, or else to clang of `ziglang`, if installed."""
    with tempfile.TemporaryDirectory(prefix="xrgs-build-") as folder:
        named = os.environ.get("CXX", "").strip()
        if (compiler := find_compiler()) is not None:
            variables = {"CXX": compiler}
        elif not named and importlib.util.find_spec("ziglang") is not None:
            _say(f"no C++17 compiler ({', '.join(_COMPILERS)}) works: ziglang compiles the kernels")
            variables = ziglang_compiler(Path(folder))
        else:
            missing = (
                f"CXX={named} is no C++17 compiler that works"
                if named
                else f"no C++17 compiler ({', '.join(_COMPILERS)}) works, and ziglang is missing"
            )
            _say(f"{missing}: the package is installed without kernels, and renders with torch")
            variables = {}
        with _environment(variables):
            yield


def ziglang_compiler(folder: Path) -> dict[str, str]:
    """Write scripts `cc`, `c++`, `ar` and `ranlib` that call `ziglang`.

    CMake looks for `ar` and `ranlib`, which may be missing too, beside the compiler.

    Args:
        folder: An empty folder for the scripts and for the libraries that Zig compiles.

    Returns:
        Environment variables with which CMake uses the scripts.
    """
    clang = ["-target", _TARGET.format(machine=platform.machine()), *_CLANG_OPTIONS]
    for name, options in {"cc": clang, "c++": clang, "ar": [], "ranlib": []}.items():
        command = shlex.join([sys.executable, "-m", "ziglang", name, *options])
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec {command} "$@"\n', "utf-8")
        script.chmod(0o755)
    caches = ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")
    variables = {name: os.environ.get(name, str(folder / "cache")) for name in caches}
    return {"CC": str(folder / "cc"), "CXX": str(folder / "c++"), **variables}


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables during a `with` block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _say(message: str) -> None:
    sys.stderr.write(f"xrgs: {message}\n")
