"""Tests of reports of several stores and sweeps, of chosen rows, and of sweeps that still run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from xrgs.report import Choice, build
from xrgs.report.collect import ReportError, report_name
from xrgs.safeio.records import read_table
from xrgs.store.attempts import remove_cell
from xrgs.store.store import Store


def table(folder: Path) -> dict[str, float]:
    """Return the change of PSNR of each scene and of the mean, in dB."""
    header, rows = read_table(folder / "table.csv")
    found = [dict(zip(header, row, strict=True)) for row in rows]
    return {
        f"{row['label']} {row['level']} {row['scene']}".rstrip(): float(row["change"])
        for row in found
        if row["metric"] == "psnr"
    }


@pytest.fixture
def two(made: Any) -> tuple[Path, str, str]:
    """A store with two sweeps of one scene each: PSNR changes by 2 dB and by 4 dB."""
    ids = []
    for name, scene, factor in (("a", "fern", 1.1), ("b", "room", 1.2)):
        made.rows.clear()
        first = len(list(made.store.cells_folder.iterdir()))
        made.add(scene=scene)
        made.add("plus", scene=scene, factors={"psnr": factor})
        for number, row in enumerate(made.rows):  # ids of their own, as other scenes have
            new = f"cell{first + number}{name}"
            made.store.cell(row["cell_id"]).path.rename(made.store.cells_folder / new)
            row["cell_id"] = new
        for row in made.rows:
            row["baseline_id"] = made.rows[0]["cell_id"]
        ids.append(made.write())
    return made.store.path, ids[0], ids[1]


def test_two_sweeps_are_joined(two: tuple[Path, str, str]) -> None:
    ids = [f"{number:016x}" for number in range(40)]
    assert len(report_name(ids)) < 150
    assert report_name(ids) != report_name(ids[:-1])
    path, first, second = two
    report = build(path, [first, second], pictures=[])
    assert report.folder == path / "reports" / f"{first}+{second}"
    changes = table(report.folder)
    assert changes["plus scene fern"] == pytest.approx(2)
    assert changes["plus scene room"] == pytest.approx(4)
    assert changes["plus mean"] == pytest.approx(3)
    text = (report.folder / "table.md").read_text()
    assert f"Sweep {first}: " in text
    assert f"Sweep {second}: " in text


def test_rows_are_chosen_and_the_folder_says_so(two: tuple[Path, str, str]) -> None:
    b, first, second = two
    report = build(b, [first, second], None, [], choice=Choice(("room",), ("plus",)))
    assert report.folder.name == f"{first}+{second}.scenes-room.ablations-plus"
    assert set(table(report.folder)) == {"plus mean", "plus scene room"}
    for choice, message in (
        (Choice(scenes=("rom",)), "scenes=rom: .* choose from: fern, room"),
        (Choice(ablations=("x",)), "ablations=x: .* choose from: baseline, plus"),
    ):
        with pytest.raises(ReportError, match=message):
            build(b, [first, second], None, [], choice=choice)


def test_two_different_cells_in_one_place_are_refused(
    two: tuple[Path, str, str],
) -> None:
    b, first, second = two
    store = Store(b)
    rows = [msgspec.structs.replace(row, scene="fern") for row in store.sweep_record(second).cells]
    other = store.write_sweep([], rows)
    message = rf"fern / baseline / seed 0 is cell .*{first} and.* both as an axis"
    with pytest.raises(ReportError, match=message):
        build(b, [first, other], pictures=[])


def test_rows_that_contradict_each_other_can_be_left_out(two: tuple[Path, str, str]) -> None:
    b, first, second = two
    store = Store(b)
    found = store.sweep_record(second).cells
    rows = [*found, *(msgspec.structs.replace(row, scene="fern") for row in found)]
    both = [first, store.write_sweep([], rows)]
    report = build(b, both, pictures=[], choice=Choice(scenes=("room",)))
    assert set(table(report.folder)) == {"plus mean", "plus scene room"}
    with pytest.raises(ReportError, match="fern / baseline / seed 0 is cell"):
        build(b, both, pictures=[], choice=Choice(scenes=("fern",)))


@pytest.mark.slow
def test_a_sweep_that_runs_is_reported_with_what_is_done(made: Any) -> None:
    for seed in range(2):
        made.add(seed=seed)
        made.add("plus", seed=seed, factors={"psnr": 1.1})
    begun = made.rows[2]["cell_id"]
    (made.store.cell(begun).path / "status.json").unlink()
    remove_cell(made.store.cell(made.rows[3]["cell_id"]))
    made.rows.append(made.rows[1] | {"cell_id": None, "label": "count_matched"})
    report = build(made.store.path, made.write(), pictures=[])
    assert table(report.folder)["plus mean"] == pytest.approx(2)
    assert "3 of 5 cells are not done yet" in report.text
    assert "3 of 5 cells gave no number" in report.text
    for reason in (
        "pending  begun and not done yet",
        "pending  not trained yet\n",
        "pending  not trained yet: it waits for another cell's count",
    ):
        assert reason in report.text


@pytest.mark.slow
def test_a_picture_of_a_trimmed_cell_says_that_its_images_were_removed(made: Any) -> None:
    made.add(pictures=True)
    cell = made.add("plus", pictures=True)
    before = build(made.store.path, made.write(), pictures=["fern--plus"])
    tables = (before.folder / "table.csv").read_bytes()
    cell.trim()
    after = build(made.store.path, pictures=["fern--plus"])
    text = (after.folder / "table.md").read_text()
    assert "No picture of fern, plus, seed 0" in text
    assert f"cells/{cell.id}/renders/IMG\\_001.png was removed by xrgs-store trim" in text
    assert (after.folder / "table.csv").read_bytes() == tables
