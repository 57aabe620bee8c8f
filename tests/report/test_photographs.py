"""What a report says of the photographs of each scene."""

from __future__ import annotations

import html
from typing import Any

import pytest
from msgspec import to_builtins
from msgspec.structs import replace

from tests.mixture.manifests import one_view
from tests.report.conftest import finish_again
from xrgs.report.page import build
from xrgs.safeio.atomic import write_json
from xrgs.store import inspect


@pytest.mark.parametrize("folder", ["v", "trimmed-v"])
def test_a_report_has_all_notes_of_a_scene_s_variants(
    made: Any, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspect, "read_manifest", lambda _: one_view())
    names = [f"IMG_{number:04d}" for number in range(40)]
    content = {"tests": 40, "hr": ["a"], "lr": ["b"], "not_registered": names}
    home = made.store.variants / folder
    home.mkdir()
    write_json(home / "report.json", content | {"notes": ["<b>icon</b>.png left out"]})
    for label, factor in (("baseline", 1.0), ("consistency", 1.1)):
        made.add(label, variant="v", factors={"psnr": factor})
    made.write()
    report = build(made.store.path, pictures=[])
    page = html.unescape((report.folder / "report.html").read_text())
    text = (report.folder / "table.md").read_text().replace("\\", "")
    for name in names:
        assert name in page
        assert name in text
    assert page.count("<li><b>icon</b>.png left out</li>") == 1
    assert "<b>icon</b>" not in (report.folder / "report.html").read_text()
    assert "fern is scored without test views that are not placed: IMG_0000" in report.text


@pytest.mark.parametrize("content", [None, '{"notes": 3}'])
def test_a_variant_without_a_report_leaves_a_report_that_says_so(
    made: Any, content: str | None
) -> None:
    if content is not None:
        (made.store.variants / "v").mkdir()
        (made.store.variants / "v" / "report.json").write_text(content)
    for label in ("baseline", "consistency"):
        made.add(label, variant="v")
    made.write()
    report = build(made.store.path, pictures=[])
    said = "unknown what was done with them: "
    assert said in (report.folder / "report.html").read_text()
    assert said in (text := (report.folder / "table.md").read_text())
    assert str(made.store.path) not in text


def test_a_report_says_what_each_training_found(made: Any) -> None:
    for seed in (0, 1):
        made.add("baseline", seed=seed)
        cell = made.add("formation", seed=seed)
        line = f"formation: LR views: 0.8{seed} px of blur across, 0.79 <b>down</b>"
        write_json(cell.path / "summary.json", to_builtins(replace(cell.summary(), found=(line,))))
        finish_again(cell)
    made.write()
    report = build(made.store.path, pictures=[])
    page = (report.folder / "report.html").read_text()
    for seed in (0, 1):
        found = f"formation, replicate 0/{seed}: formation: LR views: 0.8{seed} px of blur across"
        assert f"<li>{found}, 0.79 &lt;b&gt;down&lt;/b&gt;</li>" in page
        assert found in (report.folder / "table.md").read_text()
