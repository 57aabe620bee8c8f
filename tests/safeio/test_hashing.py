"""Hashes of values and of files."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from xrgs.config import Conf
from xrgs.safeio.hashing import file_digest, plain


def test_a_config_is_what_asdict_makes_of_it(compose: Callable[..., Conf]) -> None:
    conf = compose("+ablation=xrgs", "scene=llff/fern")
    assert plain(conf) == asdict(conf)
    assert list(plain(conf)) == list(asdict(conf))


@pytest.mark.parametrize("size", [0, 1, (1 << 16) - 1, 1 << 16, (1 << 17) + 1])
def test_a_file_is_hashed_to_its_end(tmp_path: Path, size: int) -> None:
    content = b"ab" * (size // 2) + b"c" * (size % 2)
    (tmp_path / "file").write_bytes(content)
    assert file_digest(tmp_path / "file") == hashlib.sha256(content).hexdigest()
