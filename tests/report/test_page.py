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
from tests.report.conftest import VIEWS, configured, finish_again
from xrgs.errors import StoreError
from xrgs.mixture.paths import TO_TRY
from xrgs.report import build
from xrgs.report.collect import ReportError
from xrgs.report.figures import trade_off
from xrgs.safeio import files, records


@pytest.fixture
def study(made: Any) -> Any:
    """A scene with pictures, one without, and one that failed."""
    for scene, pictures in (("fern", True), ("room|_&%$ 部屋", False)):
        made.add(scene=scene, pictures=pictures)
        made.add("consistency", scene=scene, pictures=pictures, factors={"psnr": 1.02})
    made.add_error("leaves")
    made.add_error("leaves", "consistency")
    return made


def content(folder: Path) -> dict[str, bytes]:
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


@pytest.mark.slow
def test_another_process_makes_the_same_bytes_of_a_copy_and_needs_no_torch(
    study: Any, tmp_path: Path
) -> None:
    """Its hashes, which order sets, are others, and a report lies there already."""
    sweep_id = study.write()
    (study.store.cell("cell00003").path / "status.json").write_text("no JSON")
    report = build(study.store.path)
    assert report.folder == study.store.path / "reports" / sweep_id
    copy = shutil.copytree(study.store.path, tmp_path / "elsewhere")
    made = copy / "reports" / sweep_id / "table.md"
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
    assert content(made.parent) == content(report.folder)


def test_an_odd_name_has_its_picture(made: Any) -> None:
    made.add(scene="../部屋 $x$", pictures=True)
    made.add("consistency", scene="../部屋 $x$", pictures=True)
    made.write()
    report = build(made.store.path)
    pictures = [file for file in report.files if file.suffix == ".png"]
    assert len(pictures) == 2
    assert all(file.parent == report.folder / "figures" for file in pictures)


def test_a_report_of_held_out_training_views_says_so_and_shows_them(made: Any) -> None:
    for label in ("baseline", "consistency"):
        made.add(label, condition="train.validation=0.1", validation=0.1, pictures=True)
    made.write()
    report = build(made.store.path, pictures=["fern--consistency"])
    said = "Scores are of held-out training views where the tables say train.validation=0.1"
    assert said in report.text
    assert f"**{said}" in (report.folder / "table.md").read_text()
    assert (report.folder / "figures" / "fern--consistency.png").is_file()
    assert not (made.store.variants / made.rows[0]["variant_id"] / "images" / "test").exists()
    (row, _) = csv.DictReader((report.folder / "cells.csv").read_text().splitlines())
    assert row["validation"] == "0.1"


def test_a_report_of_test_views_says_nothing_of_held_out_ones(made: Any) -> None:
    made.add()
    made.add("consistency", validation=0.0)
    made.write()
    assert "held-out" not in build(made.store.path, pictures=[]).text


@pytest.mark.slow
def test_several_ablations_have_a_picture_of_what_they_trade(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []

    def drawing(*arguments: Any) -> bytes:
        drawn.append(arguments)
        return trade_off(*arguments)

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


@pytest.mark.parametrize("names", [(), ("fern--consistency",)])
def test_the_pictures_that_are_named_are_drawn_and_no_other(study: Any, names: Any) -> None:
    study.write()
    report = build(study.store.path, pictures=names)
    assert [file.stem for file in report.files if file.suffix == ".png"] == list(names)
    assert {file.stem for file in (report.folder / "figures").iterdir()} == set(names)
    page = (report.folder / "table.md").read_text()
    assert page.count("![") == len(names)


def test_a_picture_that_is_not_there_is_named_beside_those_that_are(study: Any) -> None:
    study.write()
    with pytest.raises(
        ReportError, match=r"pictures=fern: .*choose from: fern--consistency, fern--"
    ):
        build(study.store.path, pictures=["fern--consistency", "fern"])


def test_every_file_is_there_and_named(study: Any) -> None:
    study.write()
    report = build(study.store.path)
    assert {file.relative_to(report.folder).as_posix() for file in report.files} == set(
        content(report.folder)
    )
    names = {file.name for file in report.files}
    assert {"table.md", "table.tex", "table.csv", "cells.csv", "views.csv"} <= names
    assert {"fern--consistency.png", "fern--consistency--training.png"} <= names
    page = (report.folder / "table.md").read_text()
    assert "figures/fern--consistency.png" in page
    assert "room\\|\\_&amp;%\\$ 部屋" in page


def test_the_terminal_has_table_failures_and_folder(study: Any) -> None:
    study.write()
    report = build(study.store.path, pictures=[])
    assert "consistency against baseline: 2 of 3 scenes, seed 0" in report.text
    assert "+0.40 ↑" in report.text
    assert "leaves: 3 of 24 views registered" in report.text
    assert report.text.endswith(f"Page: {report.folder / 'report.html'}")


def test_scores_are_kept_view_by_view(study: Any) -> None:
    study.write()
    with (build(study.store.path, pictures=[]).folder / "views.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4 * 2
    assert rows[0]["view"] == "IMG_001"
    assert float(rows[0]["psnr"]) == 20.05


def test_provenance_is_gathered_without_its_moment(study: Any) -> None:
    study.write()
    folder = build(study.store.path, pictures=[]).folder
    found = json.loads((folder / "provenance.json").read_text())
    assert found["cpu"] == ["a processor"]
    assert found["threads"] == ["2"]
    assert "started" not in found


def test_times_of_different_machines_are_warned_of(made: Any) -> None:
    made.add()
    made.add("consistency", cpu="another processor")
    made.write()
    report = build(made.store.path, pictures=[])
    warning = (
        "The cells were trained on different machines (a processor, threads 2, torch; another"
        " processor, threads 2, torch): times are compared only between cells of one machine."
    )
    assert warning in report.text
    assert warning in (report.folder / "table.md").read_text()


def test_times_with_different_numbers_of_threads_are_warned_of(made: Any) -> None:
    made.add()
    made.add("consistency", provenance={"threads": 1})
    made.write()
    text = build(made.store.path, pictures=[]).text
    assert "trained with different numbers of threads (a processor, threads 1, torch; a" in text
    assert "machine" not in text


def test_a_corrupt_cell_is_not_trusted(study: Any) -> None:
    study.write()
    scores = study.store.cell("cell00001").path / "scores.csv"
    scores.write_text(scores.read_text().replace("20.", "90."))
    text = build(study.store.path, pictures=[]).text
    assert "corrupt" in text
    assert "consistency against baseline: 1 of 3 scenes" in text


def test_a_missing_render_costs_its_picture_alone(study: Any) -> None:
    study.write()
    shutil.rmtree(study.store.path / "variants")
    report = build(study.store.path, pictures=["fern--consistency"])
    page = (report.folder / "table.md").read_text()
    assert "No picture of fern, consistency, seed 0" in page
    assert "fern--consistency.png" not in page
    assert "+0.40 ↑" in page


def test_baselines_alone_have_their_values(made: Any) -> None:
    made.add()
    made.write(("scene=fern",))
    assert " 100 s" in build(made.store.path, pictures=[]).text


def test_a_failed_scene_gives_its_reason_first_and_no_rows_of_missing(made: Any) -> None:
    made.add()
    made.add_error("leaves")
    made.write(("scene=[fern,leaves]",))
    report = build(made.store.path, pictures=[])
    assert report.text.startswith("1 of 2 cells gave no number")
    assert "missing" not in report.text
    page = (report.folder / "table.md").read_text()
    assert page.index("1 of 2 cells") < page.index("### Values")
    assert "missing" not in page


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


def test_another_folder_can_be_asked_for(study: Any, tmp_path: Path) -> None:
    study.write()
    report = build(study.store.path, out=tmp_path / "out", pictures=[])
    assert (tmp_path / "out" / "table.md").exists()
    assert report.folder == tmp_path / "out"
    assert not study.store.reports.exists()


def test_a_folder_that_cannot_be_written_is_named(made: Any, tmp_path: Path) -> None:
    made.add()
    made.write()
    (tmp_path / "file").write_text("")
    with pytest.raises(ReportError, match="file/out"):
        build(made.store.path, out=tmp_path / "file" / "out")


@pytest.mark.slow
def test_another_base_has_a_report_of_its_own_that_names_it(made: Any) -> None:
    for label, psnr in (("baseline", 1.0), ("a/b {x}", 1.25), ("c", 1.5)):
        factors = {"psnr": psnr}
        curve = "step,seconds,evaluations,gaussians,psnr\n9,1,1,1,30\n"
        summary = {"steps": 500 - int(100 * psnr), "work": {"views": 10 / psnr}}
        made.add(label, factors=factors, pictures=True, quality=curve, summary=summary)
    sweep_id = made.write()
    plain = build(made.store.path, pictures=[])
    names = ["trade-off", "time-to-quality", "fern--baseline", "fern--c"]
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
    with (report.folder / "table.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["metric"] == "psnr"]
    changes = {(row["label"], row["against"]): float(row["change"]) for row in rows}
    assert changes == pytest.approx({("baseline", "a/b {x}"): -5.0, ("c", "a/b {x}"): 5.0})


def test_without_a_baseline_the_first_label_is_the_base(made: Any) -> None:
    for label, psnr in (("plus", 1.0), ("lean", 1.25)):
        made.add(label, factors={"psnr": psnr})
    for row in made.rows:
        row["baseline_id"] = None
    sweep_id = made.write()
    report = build(made.store.path, pictures=[])
    assert report.folder == made.store.path / "reports" / sweep_id
    assert "lean against plus" in report.text
    with (report.folder / "table.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["metric"] == "psnr"]
    changes = {(row["label"], row["against"]): float(row["change"]) for row in rows}
    assert changes == pytest.approx({("lean", "plus"): 5.0})


def test_an_unknown_base_is_named_with_those_there_are(study: Any) -> None:
    study.write()
    with pytest.raises(ReportError, match=r"against=plus: .*: baseline, consistency"):
        build(study.store.path, against="plus")


def test_an_unknown_sweep_is_named(made: Any) -> None:
    with pytest.raises(StoreError, match="nosuch"):
        build(made.store.path, "nosuch")


def test_a_record_that_contradicts_its_cell_is_refused(made: Any) -> None:
    made.add()
    made.rows[0]["seed"] = 3
    made.write()
    with pytest.raises(ReportError, match=r"seed 3 of cell cell00000.*says 0"):
        build(made.store.path)


@pytest.mark.parametrize("ablation", ["fma", "no-fma"])
def test_cells_of_different_arithmetic_are_warned_of(made: Any, ablation: str) -> None:
    made.add(provenance={"arithmetic": "fma"})
    made.add("consistency", provenance={"arithmetic": ablation})
    made.write()
    report = build(made.store.path, pictures=[])
    page = (report.folder / "table.md").read_text()
    assert ("different arithmetic (fma, no-fma)" in report.text) == (ablation == "no-fma")
    assert ("trained with different arithmetic" in page) == (ablation == "no-fma")
    assert "| arithmetic " in page


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
    assert len([file for file in report.files if file.suffix == ".png"]) == 5


def test_long_labels_are_shortened_and_stay_apart(made: Any) -> None:
    made.add()
    for end in "ab":
        made.add("x" * 1_990 + end)
    made.write()
    report = build(made.store.path, pictures=[])
    shown = {
        row["label"]
        for row in csv.DictReader((report.folder / "cells.csv").read_text().splitlines())
    }
    assert len(shown) == 3


def test_stale_scores_are_said_once_with_what_computes_them(made: Any) -> None:
    made.add(scored_by={"lpips": "old", "ssim": "old"})
    made.add("consistency", scored_by={"lpips": "older"}, values={"lpips": None})
    made.add(scene="room")
    made.write()
    report = build(made.store.path, pictures=[])
    warning = (
        "Scores of 2 cells are missing, or other code than the installed has computed them"
        " (LPIPS, SSIM): xrgs-store rescore computes them."
    )
    assert report.text.count(warning) == 1
    assert (report.folder / "table.md").read_text().count(warning) == 1
    cells = csv.DictReader((report.folder / "cells.csv").read_text().splitlines())
    assert [row["stale"] for row in cells] == ["lpips ssim", "lpips", ""]
    (score,) = [line for line in report.text.splitlines() if line.startswith("LPIPS")][:1]
    assert "n/a: not measured" in score


def test_a_new_protocol_makes_every_score_stale(made: Any) -> None:
    made.add(scored_by={"protocol": "old"})
    made.write()
    said = "or other code than the installed has computed them (LPIPS, SSIM, PSNR)"
    assert said in build(made.store.path, pictures=[]).text


def test_a_stale_score_that_is_taken_on_request_is_named(made: Any) -> None:
    made.add(scored_by={"lpips_vgg": "old"})
    made.write()
    assert "computed them (LPIPS (VGG)):" in build(made.store.path, pictures=[]).text


def test_cells_csv_has_steps_size_and_factor(made: Any) -> None:
    configured(made.add(summary={"steps": 700}), variant={"long_side": 250, "factor": 3})
    made.add("consistency")  # of another version of xrgs, as its config can't be read
    made.write()
    file = build(made.store.path, pictures=[]).folder / "cells.csv"
    rows = [
        (row["steps"], row["long_side"], row["factor"])
        for row in csv.DictReader(file.read_text().splitlines())
    ]
    assert rows == [("700", "250", "3"), ("500", "", "")]


@pytest.mark.slow
@pytest.mark.parametrize("value", ["inf", "nan", "1e30", "1e-320", "0"])
def test_extreme_numbers_are_reported_without_a_warning(made: Any, value: str) -> None:
    for label in ("baseline", "consistency"):
        rows = f"0,{value},1,{value}\n1,{value},2,{value}\n"
        cell = made.add(label, history=f"step,loss,gaussians,mip.value\n{rows}")
        scores = ",".join([value] * 3)
        lines = ["view,psnr,ssim,lpips", *(f"{view},{scores}" for view in VIEWS)]
        (cell.path / "scores.csv").write_text("\n".join(lines) + "\n")
        finish_again(cell)
    made.write()
    report = build(made.store.path, pictures=["fern--consistency--training"])
    assert "of 2 cells" not in report.text, "both are done"


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
