"""Untrusted files, JSON, names and paths: nothing outside is touched, nothing grows or blocks."""

from __future__ import annotations

import json

import pytest

from xrgs.safeio import untrusted


@pytest.mark.parametrize(
    "name", ["a", "a b", "..a", "-x", "部屋", "é", "🙂👨‍👩‍👧", "%41", "x" * 251, "a=b,c'\""]
)
def test_a_name_may_be_in_any_script(name: str) -> None:
    assert untrusted.is_name(name)
    assert untrusted.is_inside(f"{name}/{name}")


@pytest.mark.parametrize(
    "name",
    ["", ".", "..", "a/b", "/a", "a\\b", "a\nb", "a\0", "\x1b[2J", "\ud800", "x" * 252, 1, None],
)
def test_a_name_that_leads_elsewhere_is_refused(name: object) -> None:
    assert not untrusted.is_name(name)


@pytest.mark.parametrize("path", ["", "/", "a/", "/a", "../a", "a/../b", "a/./b", "a//b", None])
def test_a_path_that_leads_outside_is_refused(path: object) -> None:
    assert not untrusted.is_inside(path)


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 100_000,
        b"[" * 60 + b"]" * 60,
        b'{"a":' * 60 + b"1" + b"}" * 60,
        b'"\\ud800"',
        b"\xff",
        b"1" * 5000,
    ],
)
def test_json_that_can_not_be_processed_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - json's own messages
        untrusted.parse_json(content)


def test_json_is_read() -> None:
    value = {"a": [{"b": 1.5}] * 99, "c": "🙂", "d": None}
    for ascii_only in (False, True):
        assert untrusted.parse_json(json.dumps(value, ensure_ascii=ascii_only).encode()) == value


def test_json_of_too_many_lists_is_refused_before_it_is_parsed() -> None:
    assert len(untrusted.parse_json(b"[" + b"[]," * 999_998 + b"[]]")) == 999_999
    with pytest.raises(ValueError, match="1000000 lists"):
        untrusted.parse_json(b"[" + b"[]," * 1_000_000 + b"[]]")


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ('{"":', "}")])
def test_json_may_have_50_levels_and_no_more(opening: str, closing: str) -> None:
    fifty = opening * 49 + opening[0] + closing * 50
    untrusted.parse_json(fifty.encode())
    with pytest.raises(ValueError, match="nested too deeply"):
        untrusted.parse_json((opening + fifty + closing).encode())
