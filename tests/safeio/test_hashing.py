"""Hashes of values and files."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest

from xrgs.config import Conf
from xrgs.safeio.hashing import canonical_json, digest, file_digest, to_plain


def test_equal_values_have_one_text_and_one_hash() -> None:
    assert canonical_json({"b": [1, 2.5], "a": "é"}) == '{"a":"é","b":[1,2.5]}'
    expected = hashlib.sha256('{"a":"é","b":[1,2.5]}'.encode()).hexdigest()[:16]
    assert digest({"a": "é", "b": [1, 2.5]}) == digest({"b": [1, 2.5], "a": "é"}) == expected
    assert digest({"a": 1}) != digest({"a": "1"})


def test_a_config_becomes_the_dicts_of_asdict(compose: Callable[..., Conf]) -> None:
    conf = compose("+ablation=xrgs", "scene=llff/fern")
    assert to_plain(conf) == asdict(conf)
    assert list(to_plain(conf)) == list(asdict(conf))


@pytest.mark.parametrize("size", [0, 1 << 16, (1 << 17) + 1])
def test_a_file_is_hashed_to_its_end(tmp_path: Path, size: int) -> None:
    content = b"ab" * (size // 2) + b"c" * (size % 2)
    (tmp_path / "file").write_bytes(content)
    assert file_digest(tmp_path / "file") == hashlib.sha256(content).hexdigest()
