"""The context of a table says how its cells were trained, and warns of few views."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs, to_builtins

from tests.mixture.manifests import one_view
from tests.report.conftest import configured, finish_again
from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, compare
from xrgs.report.context import Context, contexts, decided_by_one_view
from xrgs.report.page import build
from xrgs.safeio.atomic import write_json
from xrgs.store import inspect
from xrgs.store.inspect import SfmReport


def found(made: Any, label: str = "") -> dict[str, Context]:
    """The contexts of the cells, or of those of one label."""
    sweep = made.read()
    cells = sweep.cells
    return contexts(replace(sweep, cells=cells[cells["label"] == label]) if label else sweep)


def test_it_names_what_a_reader_has_to_know(made: Any) -> None:
    for label in ("baseline", "consistency"):
        configured(made.add(label))
    context = found(made)[""]
    assert context.of_scores == (
        "3,000 steps; HR views of at most 504 px; LR views 5 times smaller; 2 test views; "
        "Gaussians above 0.1 times the scene's scale are pruned"
    )
    assert context.of_times == "a processor; 2 threads; torch backend"
    assert context.of_all == f"{context.of_scores}; {context.of_times}"


def test_what_differs_among_cells_is_listed(made: Any) -> None:
    configured(made.add())
    other = {"densify": {"prune_scale3d": 10.0}}
    configured(made.add("keep_large"), splat=other)
    configured(made.add("mcmc"), splat={"strategy": "mcmc", "optimizer": {"length_power": 0.5}})
    configured(made.add(scene="leaves"), train={"steps": 500})
    text = found(made)[""].of_scores
    assert "3,000 or 500 steps; " in text  # rates that fit are named where all cells have them
    mcmc = found(made, "mcmc")[""].of_scores
    assert mcmc.startswith("3,000 steps, with learning rates that fit; HR")
    assert "0.1 (baseline), 10 (keep_large) times the scene's scale" in text
    assert "are pruned, and none for their size in mcmc" in text
    assert "2 test views a scene" in text


@pytest.mark.parametrize(("count", "said"), [(1, "1 scored view:"), (3, "")])
def test_fewer_than_three_scored_views_are_cautioned(made: Any, count: int, said: str) -> None:
    cell = made.add()
    configured(cell)
    sweep = made.read()
    views = pd.DataFrame({"cell_id": [cell.id] * count, "view": [f"v{n}" for n in range(count)]})
    cautions = contexts(replace(sweep, views=views))[""].cautions
    wanted = f"Caution: fern has {said} its scores say little of other views"
    assert cautions == ((wanted,) if said else ())


@pytest.mark.parametrize(
    ("changes", "cautioned"),
    [
        ({"variant": {"test_every": 0}}, True),
        ({"variant": {"test_every": 0, "test": ["IMG_001"]}}, False),
        ({"variant": {"test_every": 0}, "train": {"validation": 0.1}}, False),
        ({}, False),
    ],
)
def test_scores_of_views_that_were_trained_on_are_cautioned(
    made: Any, changes: Any, cautioned: bool
) -> None:
    configured(made.add(), **changes)
    text = " ".join(found(made)[""].cautions)
    assert ("fern has no view held out (variant.test_every=0)" in text) == cautioned


def test_views_that_are_not_placed_are_named_beside_the_scores(made: Any) -> None:
    configured(made.add(variant="v"))
    configured(made.add("chosen", condition="train.validation=0.1", variant="v", validation=0.1))
    report = SfmReport(tests=3, hr=("a",), lr=("b",), not_registered=("b", "IMG_8", "x\ny"))
    found = contexts(replace(made.read(), variants={"v": report}))
    said = "Caution: fern is scored without test views that are not placed: IMG_8, x y"
    assert said in found[""].cautions
    assert said not in found["train.validation=0.1"].cautions


@pytest.mark.parametrize(
    ("lr", "hr_fraction", "as_they_are", "said"),
    [
        ((), 0.5, False, True),
        (("b",), 0.5, False, False),
        ((), 1.0, False, False),
        ((), 0.5, True, False),  # nobody asked for LR views
    ],
)
def test_a_mixture_without_lr_views_is_cautioned(
    made: Any, lr: tuple[str, ...], hr_fraction: float, as_they_are: bool, said: bool
) -> None:
    configured(made.add(variant="v"), variant={"hr_fraction": hr_fraction})
    report = SfmReport(tests=1, hr=("a",), lr=lr, as_they_are=as_they_are)
    cautions = contexts(replace(made.read(), variants={"v": report}))[""].cautions
    assert ("Caution: fern has no LR view: nothing is mixed" in cautions) == said


@pytest.mark.parametrize(
    ("variant", "said"),
    [
        ({"degradation": "downsample", "factor": 3}, "LR views 3 times smaller;"),
        ({"degradation": "phone"}, "LR views 5 times smaller, by phone;"),
        ({"degradation": "jpeg"}, "LR views by jpeg;"),
        ({"degradation": "of another version"}, "LR views by of another version;"),
        ({"hr_fraction": 1.0}, "all views HR"),
        ({"tags": "sampling_rate", "factor": 2}, "LR by sampling_rate (nothing degraded);"),
    ],
)
def test_how_lr_views_were_made_is_said(made: Any, variant: dict[str, Any], said: str) -> None:
    configured(made.add(), variant=variant)
    assert said in found(made)[""].of_scores


def test_values_of_a_stranger_are_shown_as_they_are(made: Any) -> None:
    configured(made.add(cpu="\x1b[31mred\n"), train={"steps": "many\n\x1b"})
    text = found(made)[""].of_all
    assert "\x1b" not in text
    assert "\n" not in text


def test_what_is_not_known_is_not_named(made: Any) -> None:
    made.add(state="failed")
    configured(made.add(condition="other"), variant={"factor": None})
    contexts = found(made)
    assert contexts[""] == Context()
    assert "times smaller" not in contexts["other"].of_scores
    assert "None" not in contexts["other"].of_scores


#: `plus` on horns, without its view with a floater, and with it.
USUAL = [3.11, 3.33, 2.76, 2.64, 2.91, 2.10, 3.56]
FLOATER = -6.08


def views_of(comparison: Comparison, changes: dict[str, list[float]]) -> pd.DataFrame:
    """`Sweep.views` in which each label's views change so much, dB, from 20 dB in its base."""
    rows = []
    for pair in comparison.pairs.query("metric == 'psnr'").to_dict("records"):
        for number, change in enumerate(changes[pair["label"]]):
            name = f"view{number}"
            rows.append({"cell_id": pair["base_id"], "view": name, "psnr": 20.0})
            rows.append({"cell_id": pair["cell_id"], "view": name, "psnr": 20.0 + change})
    views = pd.DataFrame(rows, columns=["cell_id", "view", "psnr"]).astype({"psnr": float})
    return views.drop_duplicates(["cell_id", "view"])  # labels share their base


def compared(made: Any, *labels: str, seeds: tuple[int, ...] = (0,)) -> Comparison:
    for seed in seeds:
        made.add(scene="horns", seed=seed, draw=seed)
        for label in labels:
            made.add(label, scene="horns", seed=seed, draw=seed, factors={"gaussians": 0.5})
    return compare(made.read().cells, METRICS)


def test_a_view_with_a_floater_is_named_with_the_change_without_it(made: Any) -> None:
    comparison = compared(made, "plus", "lean")
    views = views_of(comparison, {"plus": [*USUAL, FLOATER], "lean": USUAL})
    (sentence,) = decided_by_one_view(comparison, views).pop(("plus", ""))
    assert sentence == (
        "Caution: one view decides: on horns (replicate 0/0) PSNR changes by +1.79 dB,"
        " and without view7 by +2.92 dB"
    )
    assert decided_by_one_view(comparison, views).keys() == {("plus", "")}


def test_each_replicate_is_judged_by_itself(made: Any) -> None:
    comparison = compared(made, "plus", seeds=(0, 1, 2))
    views = views_of(comparison, {"plus": [*USUAL, FLOATER]})
    second = comparison.pairs.query("seed == 1")["cell_id"].iloc[0]
    views.loc[(views["cell_id"] == second) & (views["view"] == "view7"), "psnr"] = 23.0
    found = decided_by_one_view(comparison, views)["plus", ""]
    assert ["(replicate 0/0)" in found[0], "(replicate 2/2)" in found[1]] == [True, True]
    assert len(found) == 2


@pytest.mark.slow
@settings(max_examples=40)
@given(st.lists(st.integers(-2000, 2000), min_size=3, max_size=9, unique=True))
def test_it_is_what_leaving_out_each_view_in_turn_says(hundredths: list[int]) -> None:
    scores = 20.0 + np.array(hundredths) / 100
    pair = {"label": "a", "condition": "", "scene": "s", "variant_seed": 0, "seed": 0}
    pairs = pd.DataFrame([pair | {"metric": "psnr", "cell_id": "c", "base_id": "b", "why": ""}])
    views = pd.DataFrame(
        [
            {"cell_id": cell_id, "view": f"{number:02d}", "psnr": score}
            for cell_id, row in (("c", scores), ("b", np.full(len(scores), 20.0)))
            for number, score in enumerate(row)
        ]
    )
    comparison: Any = SimpleNamespace(pairs=pairs)
    found = decided_by_one_view(comparison, views).get(("a", ""), [])
    change = scores - 20.0
    expected = []
    for number, one in enumerate(change):
        others = np.delete(change, number)
        center = np.median(others)
        moved = abs(others.mean() - change.mean())
        far = abs(one - center) > 3 * np.abs(others - center).max()
        if far and moved > max(0.3, 0.5 * abs(change.mean())):
            expected.append((f"{number:02d}", others.mean()))
    told = [re.search(r"without (\d+) by (\S+) dB", text) for text in found]
    assert len(told) == len(expected) <= 1
    for match, (view, without) in zip(told, expected, strict=True):
        assert match is not None
        assert match[1] == view
        assert float(match[2]) == pytest.approx(without, abs=0.0051)


def test_a_report_says_it(made: Any) -> None:
    for label, last in (("baseline", 20.0), ("plus", 20.0 + FLOATER)):
        cell = made.add(label, scene="horns", values={"psnr": 20.0})
        rows = [f"view{n},{20 + (label == 'plus') * c},0.5,0.5" for n, c in enumerate(USUAL)]
        text = "\n".join(["view,psnr,ssim,lpips", *rows, f"view7,{last},0.5,0.5"])
        (cell.path / "scores.csv").write_text(text + "\n")
        finish_again(cell, tuple(f"view{n}" for n in range(8)))
    made.add("lean", scene="horns")
    made.write()
    report = build(made.store.path, pictures=[])
    assert report.text.count("one view decides") == 1, "under the table of its label"
    for name in ("table.md", "table.tex", "report.html"):
        assert "without view7 by +2.92 dB" in (report.folder / name).read_text()


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
        write_json(
            cell.path / "summary.json", to_builtins(structs.replace(cell.summary(), found=(line,)))
        )
        finish_again(cell)
    made.write()
    report = build(made.store.path, pictures=[])
    page = (report.folder / "report.html").read_text()
    for seed in (0, 1):
        found = f"formation, replicate 0/{seed}: formation: LR views: 0.8{seed} px of blur across"
        assert f"<li>{found}, 0.79 &lt;b&gt;down&lt;/b&gt;</li>" in page
        assert found in (report.folder / "table.md").read_text()
