"""`xrgs-sweep help=KEY` shows the comments of conf/config.yaml."""

import re

import pytest

from xrgs.cli.sweep import explain
from xrgs.config import Conf, known_keys
from xrgs.errors import XrgsError


def test_a_comment_above_and_one_behind_a_value_are_shown() -> None:
    above, behind = explain("train.steps"), explain("variant.hr_fraction")
    assert above.startswith("train.steps=30000\n  Number of steps, one view a step")
    assert behind.startswith("variant.hr_fraction=0.3\n  share of the training views that are HR")
    assert "train.views" not in above
    assert "--cfg job" in above


def test_a_group_shows_its_keys() -> None:
    found = explain("limits")
    assert found.index("limits.minutes=0.0") < found.index("limits.memory_gb=0.0")


def test_an_unknown_key_is_named_with_one_like_it() -> None:
    with pytest.raises(
        XrgsError, match=r"help=stesp: there is no such key; did you mean train\.steps"
    ):
        explain("stesp")


def test_every_key_of_the_schema_is_explained() -> None:
    """By a comment of its own, or as a group by those of its keys."""
    for key in known_keys():
        if key.partition(".")[0] not in Conf.__dataclass_fields__:
            continue  # a group of files
        first, *others = explain(key).splitlines()
        assert re.fullmatch(rf"{re.escape(key)}(=\S.*)?", first)
        is_group = first == key
        assert is_group or re.match(r"  \S.{9}", others[0]), key
