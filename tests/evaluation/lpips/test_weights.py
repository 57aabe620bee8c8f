"""Where the weights of LPIPS are searched, and what is refused in their place."""

from __future__ import annotations

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


def test_saved_weights_are_loaded_and_a_changed_value_is_refused(
    known: Weights, nowhere: Path
) -> None:
    assert provenance.collect(1, "torch").lpips_weights_sha256 is None
    file = weights.cache_file()
    weights.save(known, file)
    found = weights.load(file)
    assert found.keys() == known.keys()
    assert all(np.array_equal(found[name], known[name]) for name in found)
    assert [f.name for f in nowhere.iterdir()] == [file.name]
    assert provenance.collect(1, "torch").lpips_weights_sha256 == weights.content_digest(known)
    known["head3"][7] += np.float32(1e-6)
    weights.save(known, nowhere / "other.npz")
    (nowhere / "other.npz").replace(file)
    weights._load_cached.cache_clear()
    # A cell stops before it trains.
    with pytest.raises(WeightsError, match=r"npz: not the published weights.*xrgs-data lpips"):
        provenance.collect(1, "torch")


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
    for value in (np.float64(1), np.zeros(2).dot, range(3)):
        with pytest.raises(WeightsError, match="is refused"):
            weights.read_pickle(pickle.dumps(value), "w.ckpt")


@pytest.mark.parametrize("content", [b"", b"\x80\x03}q", b"PK\x03\x04 broken", b"<html>"])
def test_a_file_of_something_else_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "w").write_bytes(content)
    with pytest.raises(WeightsError, match=str(tmp_path / "w")):
        weights.load(tmp_path / "w")
    with pytest.raises(WeightsError, match=r"w\.ckpt: not a readable pickle"):
        weights.read_pickle(content, "w.ckpt")


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


def test_the_published_weights_are_the_published_ones(published: Weights) -> None:
    assert weights.content_digest(published) == weights.CONTENT_SHA256
    assert all((published[f"head{i}"] >= 0).all() for i in range(5))  # a head can't lower it
