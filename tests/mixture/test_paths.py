"""Names of the folders of variants, and reports of failed scenes."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

from xrgs.config import Conf
from xrgs.mixture.paths import TO_TRY, failed_scenes, id_of, is_variant

PAGE = Path(__file__).parents[2] / "docs" / "your_photographs.md"


def test_reports_are_listed_by_key_and_damaged_ones_say_what_is_wrong(tmp_path: Path) -> None:
    for key, report in {
        "b": {"scene": "leaves", "reason": "too few views"},
        "a": {"scene": "flat", "reason": "no points"},
        "c": {"scene": "no reason"},
        "f": {"scene": ["a"], "reason": "b"},
        "d": [],
    }.items():
        (tmp_path / f"failed-{key}").mkdir()
        (tmp_path / f"failed-{key}" / "report.json").write_text(json.dumps(report))
    (tmp_path / "failed-e").mkdir()
    (tmp_path / "frozen").mkdir()
    listed = failed_scenes(tmp_path)
    assert list(listed) == ["a", "b", "c", "d", "e", "f"]
    assert (listed["a"], listed["b"]) == (("flat", "no points"), ("leaves", "too few views"))
    for key in "cdef":
        scene, reason = listed[key]
        assert scene == "?"
        assert f"{tmp_path}/failed-{key}/report.json: " in reason


def test_names_tell_variants_from_other_folders() -> None:
    variants = ["key-hash", "trimmed-key-hash"]
    others = ["failed-key", ".key.building", ".key-hash.aside-1", "notes"]
    assert [name for name in variants + others if is_variant(name)] == variants
    assert [id_of(name) for name in variants] == ["key-hash"] * 2


def test_what_to_try_has_keys_of_the_config_and_the_section_that_explains_them(
    compose: Callable[..., Conf],
) -> None:
    page = PAGE.read_text()
    heading, *steps = TO_TRY
    (title,) = re.findall(r'"(.+)"', heading)
    section = page.partition(f"## {title}\n")[2].partition("\n## ")[0]
    keys = re.findall(r"variant[\w.]*\w", " ".join(steps))
    assert len(keys) == 6
    for key in keys:
        attrgetter(key)(compose())  # an unknown key raises
        assert f"`{key}=" in section
    assert len(re.findall(r"^\d\. ", section, re.M)) == len(steps)
