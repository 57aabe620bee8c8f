"""What a cell's provenance says of sources that are not committed."""

from __future__ import annotations

import subprocess
from pathlib import Path

import msgspec
import pytest
import torch

import xrgs
from xrgs.splat import backend
from xrgs.store import provenance
from xrgs.store.schema import Provenance

FILES = ("xrgs/__init__.py", "conf/ablation/plus.yaml", "sweeps/all.yaml", "README.md")


def git(folder: Path, *arguments: str) -> str:
    names = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    command = ["git", "-C", str(folder), *names, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A commit of a file in each folder."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("a: 1\n")
    (tmp_path / ".gitignore").write_text("*.so\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "all")
    monkeypatch.setattr(xrgs, "__file__", str(tmp_path / "xrgs/__init__.py"))
    return tmp_path


def made_with() -> Provenance:
    return provenance.collect(1, "torch")


def test_a_clean_checkout_has_its_commit_and_no_difference(checkout: Path) -> None:
    for name in ("xrgs/_native.so", "README.md", "notes"):
        (checkout / name).write_text("no source")
    # The file of a build that was killed; a checkout itself is asked.
    (checkout / "xrgs" / "_commit.json").write_text('{"git": "0123", "git_diff_sha256": null}')
    (checkout / ".gitignore").write_text("*.so\n_commit.json\n")
    assert made_with().git == git(checkout, "rev-parse", "HEAD").strip()
    assert made_with().git_diff_sha256 is None


@pytest.mark.parametrize("name", ["sweeps/all.yaml", "conf/ablation/néw one.yaml"])
def test_a_source_that_is_not_committed_is_a_difference(checkout: Path, name: str) -> None:
    """Also a new file: an ablation that exists at no commit."""
    found = {made_with().git_diff_sha256}
    for text in ("a: 2\n", "a: 3\n"):
        (checkout / name).write_text(text)
        found.add(made_with().git_diff_sha256)
    git(checkout, "add", name)
    assert None in found
    assert len(found) == 3
    assert made_with().git_diff_sha256 is not None


def test_a_package_inside_the_repository_of_somebody_else_has_no_commit(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a virtual environment in the folder of a project."""
    package = checkout / ".venv" / "site-packages" / "xrgs"
    package.mkdir(parents=True)
    monkeypatch.setattr(xrgs, "__file__", str(package / "__init__.py"))
    assert (made_with().git, made_with().git_diff_sha256) == (None, None)
    (package / "_commit.json").write_text('{"git": "0123", "git_diff_sha256": null}')
    assert (made_with().git, made_with().git_diff_sha256) == ("0123", None)


def test_backends_and_gpus_are_other_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times are compared between cells of one machine only."""
    monkeypatch.setattr(backend, "_gsplat_version", lambda: ("1.6.0", 0.99))
    monkeypatch.setattr(provenance, "device", backend.DEVICES.get)
    names = []
    for gpu in ("NVIDIA H200", "NVIDIA A100"):
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda gpu=gpu: gpu)
        made = provenance.collect(2, "gsplat")
        assert (made.gpu, made.backend, made.arithmetic) == (gpu, "gsplat", "gsplat 1.6.0")
        names.append(provenance.machine(made))
    made = provenance.collect(2, "torch")
    assert made.gpu is None
    names += [provenance.machine(made)]
    assert len(set(names)) == 3
    assert names[0].endswith(", NVIDIA H200, threads 2, gsplat")
    # Cells of earlier versions have no such entry.
    before = {k: v for k, v in msgspec.to_builtins(made).items() if k != "gpu"}
    assert msgspec.convert(before, Provenance) == made
