"""A report of a store: whole, the same each time, and made without torch."""

import csv
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cmarkgfm
import pytest

import xrgs
from tests.report.conftest import VIEWS, MadeStore, configured, finish_again
from xrgs.errors import StoreError
from xrgs.mixture.paths import TO_TRY
from xrgs.report import Report, build
from xrgs.report.collect import ReportError
from xrgs.safeio import files, records


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """The report of a scene with pictures, one with a changed cell, and a failed one."""
    made = MadeStore(tmp_path_factory.mktemp("reported") / "store")
    for scene, pictures in (("fern", True), ("room|_&%$ 部屋", False)):
        first = made.add(scene=scene, pictures=pictures, summary={"steps": 700})
        last = made.add("consistency", scene=scene, pictures=pictures, factors={"psnr": 1.02})
        configured(first, variant={"long_side": 250, "factor": 3})
    made.add_error("leaves")
    made.add_error("leaves", "consistency")
    scores = last.path / "scores.csv"
    scores.write_text(scores.read_text().replace("20.", "90."))
    sweep_id = made.write()
    report = build(made.store.path)
    assert report.folder == made.store.path / "reports" / sweep_id
    return report


def content(folder: Path) -> dict[str, bytes]:
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def rows_of(report: Report, name: str) -> list[dict[str, str]]:
    return [*csv.DictReader((report.folder / name).read_text().splitlines())]


@pytest.mark.slow
def test_another_process_makes_the_same_bytes_of_a_copy_and_needs_no_torch(
    reported: Report, tmp_path: Path
) -> None:
    """Its hashes, which order sets, are others, and a report lies there already."""
    copy = shutil.copytree(reported.folder.parents[1], tmp_path / "elsewhere")
    made = copy / "reports" / reported.folder.name / "table.md"
    made.write_text("")
    code = (
        "import sys; from pathlib import Path; from xrgs.report import build; "
        "build(Path(sys.argv[1])); assert 'torch' not in sys.modules; "
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run(
        [sys.executable, "-P", "-W", "error", "-c", code, str(copy)],
        check=True,
        env={"PYTHONPATH": str(Path(xrgs.__file__).parents[1])},
    )
    assert content(made.parent) == content(reported.folder)


def test_every_file_is_there_and_has_what_is_known(reported: Report) -> None:
    folder = reported.folder
    assert {file.relative_to(folder).as_posix() for file in reported.files} == set(content(folder))
    names = {file.name for file in reported.files}
    assert {"table.md", "table.tex", "table.csv", "cells.csv", "views.csv"} <= names
    assert {"fern--consistency.png", "fern--consistency--training.png"} <= names
    page = (folder / "table.md").read_text()
    assert "figures/fern--consistency.png" in page
    assert "room\\|\\_&amp;%\\$ 部屋" in page
    views = rows_of(reported, "views.csv")
    assert len(views) == 3 * 2
    assert (views[0]["view"], float(views[0]["psnr"])) == ("IMG_001", 20.05)
    first, second, *_ = rows_of(reported, "cells.csv")
    assert (first["steps"], first["long_side"], first["factor"]) == ("700", "250", "3")
    assert second["steps"] == "500"
    assert second["long_side"] == second["factor"] == "", "its config can't be read"
    provenance = json.loads((folder / "provenance.json").read_text())
    assert (provenance["cpu"], provenance["threads"]) == (["a processor"], ["2"])
    assert "started" not in provenance


def test_the_terminal_has_table_failures_and_folder(reported: Report) -> None:
    assert "consistency against baseline: 1 of 3 scenes, seed 0" in reported.text
    assert "+0.40 ↑" in reported.text
    assert "leaves: 3 of 24 views registered" in reported.text
    assert "corrupt" in reported.text, "a changed cell is not trusted"
    assert "held-out" not in reported.text
    assert reported.text.endswith(f"Page: {reported.folder / 'report.html'}")


@pytest.mark.slow
def test_a_report_of_held_out_training_views_says_so_and_shows_them(made: Any) -> None:
    for label in ("baseline", "consistency"):
        made.add(label, condition="train.validation=0.1", validation=0.1, pictures=True)
    made.write()
    report = build(made.store.path, pictures=["fern--consistency"])
    said = "Scores are of held-out training views where the tables say train.validation=0.1"
    assert said in report.text
    page = (report.folder / "table.md").read_text()
    assert f"**{said}" in page
    assert page.count("![") == 1
    assert [file.stem for file in (report.folder / "figures").iterdir()] == ["fern--consistency"]
    assert not (made.store.variants / made.rows[0]["variant_id"] / "images" / "test").exists()
    assert rows_of(report, "cells.csv")[0]["validation"] == "0.1"


@pytest.mark.slow
def test_several_ablations_have_a_picture_of_what_they_trade(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []

    def drawing(*arguments: Any) -> bytes:
        drawn.append(arguments)
        return b""

    monkeypatch.setattr("xrgs.report.pictures.trade_off", drawing)
    for condition in ("", "factor=8/x"):
        made.add(condition=condition, values={"lpips": None})
        made.add("densify", condition=condition, factors={"gaussians": 2}, values={"lpips": None})
        made.add("mip", condition=condition, factors={"psnr": 1.1}, values={"lpips": None})
    made.write()
    report = build(made.store.path)
    names = [file.name for file in report.files if file.name.startswith("trade-off")]
    assert len(names) == 2
    assert "trade-off.png" in names
    for _, means, scenes, axes in drawn:
        assert [axis.name for axis in axes] == ["psnr", "ssim"]  # LPIPS was not measured
        assert list(means.index) == ["baseline", "densify", "mip"]
        assert means.loc["densify", "gaussians"] == scenes.loc["densify", "gaussians"] == 10_000
        assert means.loc["mip", "psnr"] == pytest.approx(22.0)
        assert means.loc["densify", "psnr"] == pytest.approx(20.0)
    page = (report.folder / "table.md").read_text()
    assert all(f"figures/{name}" in page for name in names)


def test_times_of_different_machines_and_other_arithmetic_are_warned_of(made: Any) -> None:
    made.add(provenance={"arithmetic": "fma"})
    made.add("consistency", cpu="another processor", provenance={"arithmetic": "no-fma"})
    made.write()
    report = build(made.store.path, pictures=[])
    for warning in (
        "The cells were trained on different machines (a processor, threads 2, torch; another"
        " processor, threads 2, torch): times are compared only between cells of one machine.",
        "The cells were trained with different arithmetic (fma, no-fma)",
    ):
        assert warning in report.text
        assert warning in (report.folder / "table.md").read_text()
    assert "| arithmetic " in (report.folder / "table.md").read_text()


def test_times_with_different_numbers_of_threads_are_warned_of(made: Any) -> None:
    made.add(provenance={"arithmetic": "fma"})
    made.add("consistency", provenance={"arithmetic": "fma", "threads": 1})
    made.write()
    text = build(made.store.path, pictures=[]).text
    assert "trained with different numbers of threads (a processor, threads 1, torch; a" in text
    assert "machine" not in text
    assert "different arithmetic" not in text


def test_a_missing_render_costs_its_picture_alone(made: Any) -> None:
    made.add()
    made.add("consistency", factors={"psnr": 1.02})
    made.write()
    report = build(made.store.path, pictures=["fern--consistency"])
    page = (report.folder / "table.md").read_text()
    assert "No picture of fern, consistency, seed 0" in page
    assert "fern--consistency.png" not in page
    assert "+0.40 dB ↑" in page


def test_baselines_alone_have_values_and_a_failed_scene_its_reason_first(made: Any) -> None:
    made.add()
    made.add_error("leaves")
    made.write(("scene=[fern,leaves]",))
    report = build(made.store.path, pictures=[])
    assert report.text.startswith("1 of 2 cells gave no number")
    assert " 100 s" in report.text
    assert "missing" not in report.text
    page = (report.folder / "table.md").read_text()
    assert page.index("1 of 2 cells") < page.index("### Values")
    assert "missing" not in page


def test_the_values_of_a_baseline_are_printed_before_its_ablation_is_trained(made: Any) -> None:
    made.add()
    made.add("plus", state="failed")
    made.write()
    report = build(made.store.path, pictures=[])
    assert " 100 s" in report.text
    assert "How to read" not in report.text


def test_a_sweep_of_which_everything_failed(made: Any) -> None:
    made.add_error("leaves")
    made.add_error("leaves", "consistency")
    made.write()
    report = build(made.store.path)
    assert report.text.startswith("2 of 2 cells gave no number")
    assert "leaves: 3 of 24 views registered" in report.text
    for text in (report.text, (report.folder / "table.md").read_text()):
        assert "missing" not in text
    assert report.text.count(TO_TRY[1]) == 1


@pytest.mark.slow
def test_another_base_has_a_report_of_its_own_that_names_it(made: Any) -> None:
    for label, psnr in (("baseline", 1.0), ("a/b {x}", 1.25), ("c", 1.5)):
        factors = {"psnr": psnr}
        curve = "step,seconds,evaluations,gaussians,psnr\n9,1,1,1,30\n"
        summary = {"steps": 500 - int(100 * psnr), "work": {"views": 10 / psnr}}
        made.add(label, factors=factors, pictures=True, quality=curve, summary=summary)
    sweep_id = made.write()
    plain = build(made.store.path, pictures=[])
    names = ["trade-off", "time-to-quality", "fern--baseline"]
    report = build(made.store.path, pictures=names, against="a/b {x}")
    assert plain.folder == made.store.path / "reports" / sweep_id
    assert report.folder.name.startswith(f"{sweep_id}.against-a-b-x-")
    assert {file.name for file in plain.files} < {file.name for file in report.files}
    page = (report.folder / "table.md").read_text()
    assert page.startswith("# Change from a/b \\{x\\}\n")
    for name in (plain.folder, report.folder):
        text = (name / "table.md").read_text()
        assert ("baseline against a/b" in text, "c against baseline" in text) == (
            (name == report.folder), (name == plain.folder)
        )  # fmt: skip
    for title in ("at which a/b \\{x\\} ends", "% of a/b \\{x\\}'s own", "| c "):
        assert title in page
    assert "Steps that a/b \\{x\\} takes" in page
    assert {file.stem for file in report.files if file.suffix == ".png"} == {*names}
    rows = [row for row in rows_of(report, "table.csv") if row["metric"] == "psnr"]
    changes = {(row["label"], row["against"]): float(row["change"]) for row in rows}
    assert changes == pytest.approx({("baseline", "a/b {x}"): -5.0, ("c", "a/b {x}"): 5.0})


@pytest.mark.slow
def test_without_a_baseline_the_first_label_is_the_base(made: Any, tmp_path: Path) -> None:
    for label, psnr in (("plus", 1.0), ("lean", 1.25)):
        made.add(label, factors={"psnr": psnr})
    for row in made.rows:
        row["baseline_id"] = None
    made.write()
    report = build(made.store.path, out=tmp_path / "out", pictures=[])
    assert report.folder == tmp_path / "out"
    assert not made.store.reports.exists()
    assert "lean against plus" in report.text
    rows = [row for row in rows_of(report, "table.csv") if row["metric"] == "psnr"]
    changes = {(row["label"], row["against"]): float(row["change"]) for row in rows}
    assert changes == pytest.approx({("lean", "plus"): 5.0})


def test_what_cannot_be_reported_is_named(made: Any, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nosuch"):
        build(made.store.path, "nosuch")
    made.add()
    made.write()
    (tmp_path / "file").write_text("")
    with pytest.raises(ReportError, match="file/out"):
        build(made.store.path, out=tmp_path / "file" / "out")
    made.rows[0]["seed"] = 3
    made.write()
    with pytest.raises(ReportError, match=r"seed 3 of cell cell00000.*says 0"):
        build(made.store.path)


#: Codes of a terminal, formulas, markup, mathematics, a line break and a script that no font has.
EVIL = (
    "=cmd|'/C calc'!A1 <script>\x1b[2J\x1b]0;t\x07\n\n# H | a | [x](javascript:a) $\\frac{$ "
    "\\input{/etc/passwd} \u202e\x9b2J कमरा https://evil.example"
)


@pytest.mark.slow
def test_words_of_a_foreign_store_are_not_obeyed(made: Any) -> None:
    for label in ("baseline", EVIL, f"-{EVIL}"):
        made.add(label, scene=EVIL, condition=EVIL, variant="v", pictures=True, cpu=EVIL)
    made.add_error(f"@{EVIL}", EVIL)
    made.write((EVIL, "seed=0"))
    report = build(made.store.path)
    texts = {file.name: file.read_text() for file in report.files if file.suffix != ".png"}
    for name, text in (texts | {"": report.text}).items():
        assert text.replace("\n", "").isprintable(), name
        assert text.count("\n") < 250 or name == "report.html", name  # tests/report/html has it
    for name in ("table.csv", "cells.csv", "views.csv", "training.csv"):
        for row in csv.reader(texts[name].splitlines(), strict=True):
            assert not [cell for cell in row if cell.startswith(("=", "@", "-=", "-cmd"))]
    page = cmarkgfm.github_flavored_markdown_to_html(texts["table.md"])
    assert not re.search(r"<(a|script)\b|src=\"(?!figures/)", page)
    assert r"\input" not in texts["table.tex"]
    pictures = [file for file in report.files if file.suffix == ".png"]
    assert len(pictures) == 5
    assert all(file.parent == report.folder / "figures" for file in pictures)


def test_stale_scores_are_said_once_with_what_computes_them(made: Any) -> None:
    made.add(scored_by={"lpips": "old", "ssim": "old"})
    for end in "ab":  # long labels are shortened and stay apart
        made.add("x" * 1_990 + end, scored_by={"lpips": "older"}, values={"lpips": None})
    made.add(scene="room")
    made.write()
    report = build(made.store.path, pictures=[])
    warning = (
        "Scores of 3 cells are missing, or other code than the installed has computed them"
        " (LPIPS, SSIM): xrgs-store rescore computes them."
    )
    assert report.text.count(warning) == 1
    assert (report.folder / "table.md").read_text().count(warning) == 1
    cells = rows_of(report, "cells.csv")
    assert [row["stale"] for row in cells] == ["lpips ssim", "lpips", "lpips", ""]
    assert len({row["label"] for row in cells}) == 3
    (score,) = [line for line in report.text.splitlines() if line.startswith("LPIPS")][:1]
    assert "n/a: not measured" in score


def test_a_new_protocol_makes_every_score_stale(made: Any) -> None:
    made.add(scored_by={"protocol": "old", "lpips_vgg": "old"})
    made.write()
    text = build(made.store.path, pictures=[]).text
    (said,) = re.findall(r"other code than the installed has computed them \((.*)\): xrgs", text)
    assert sorted(said.split(", ")) == ["LPIPS", "LPIPS (VGG)", "PSNR", "SSIM"]


@pytest.mark.slow
def test_extreme_numbers_are_reported_without_a_warning(made: Any) -> None:
    values = ("inf", "nan", "1e30", "1e-320", "0")
    for value in values:
        for label in ("baseline", "consistency"):
            rows = f"0,{value},1,{value}\n1,{value},2,{value}\n"
            cell = made.add(label, scene=value, history=f"step,loss,gaussians,mip.value\n{rows}")
            scores = ",".join([value] * 3)
            lines = ["view,psnr,ssim,lpips", *(f"{view},{scores}" for view in VIEWS)]
            (cell.path / "scores.csv").write_text("\n".join(lines) + "\n")
            finish_again(cell)
    made.write()
    pictures = [f"{value}--consistency--training" for value in values]
    report = build(made.store.path, pictures=pictures)
    assert "gave no number" not in report.text, "all are done"


def test_a_cell_that_cannot_be_read_now_is_a_row_with_the_reason(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made.add()
    cell = made.add("consistency")
    real = files.read_bytes

    def failing(path: Path, max_bytes: int) -> bytes:
        if path == cell.path / "summary.json":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path, max_bytes)

    monkeypatch.setattr(records, "read_bytes", failing)
    made.write()
    report = build(made.store.path, pictures=[])
    (row,) = [line for line in report.text.splitlines() if "summary.json" in line]
    assert "failed" in row
    assert "summary.json: " in row
    assert os.strerror(errno.EIO) in row
