"""Pairs whose change in PSNR one view decides."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xrgs.evaluation.metrics import METRICS
from xrgs.report.compare import Comparison, compare
from xrgs.report.page import build
from xrgs.report.single_views import decided_by_one_view
from xrgs.report.tables import Tables

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


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param([1.0, -9.0], id="two views"),
        pytest.param([0.02, 0.01, 0.0, 0.01, -0.5], id="less than 0.3 dB of the mean"),
        pytest.param([10.0, 10.1, 9.9, 10.0, 3.0], id="a small share of a large change"),
        pytest.param([4.0, 0.9, 0.4, -0.1, -3.5], id="others as far"),
        pytest.param([1.0, 1.0, 1.0], id="no scatter"),
        pytest.param([1.0, 1.1, float("inf"), float("nan")], id="too few finite ones"),
        pytest.param([], id="no views"),
    ],
)
def test_what_no_view_decides_has_no_caution(made: Any, changes: list[float]) -> None:
    comparison = compared(made, "plus")
    assert decided_by_one_view(comparison, views_of(comparison, {"plus": [*changes]})) == {}


@given(st.lists(st.integers(-2000, 2000), min_size=3, max_size=9, unique=True))
@settings(deadline=None)
def test_it_is_what_leaving_out_each_view_in_turn_says(hundredths: list[int]) -> None:
    scores = 20.0 + np.array(hundredths) / 100
    pair = {"label": "a", "condition": "", "scene": "s", "variant_seed": 0, "seed": 0}
    pairs = pd.DataFrame([pair | {"metric": "psnr", "cell_id": "c", "base_id": "b"}])
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


def test_the_caution_stands_under_the_table_of_its_label_alone(made: Any) -> None:
    comparison = compared(made, "plus", "lean")
    tables = Tables(comparison, notes={("plus", ""): ["Caution: one view decides"]})
    assert "Caution: one view decides" in tables.mean("plus", "").notes
    assert "Caution: one view decides" not in tables.mean("lean", "").notes


def test_a_report_says_it(made: Any) -> None:
    for label, last in (("baseline", 20.0), ("plus", 20.0 + FLOATER)):
        cell = made.add(label, scene="horns", values={"psnr": 20.0})
        rows = [f"view{n},{20 + (label == 'plus') * c},0.5,0.5" for n, c in enumerate(USUAL)]
        text = "\n".join(["view,psnr,ssim,lpips", *rows, f"view7,{last},0.5,0.5"])
        (cell.path / "scores.csv").write_text(text + "\n")
        cell.finish([f"view{n}" for n in range(8)], 1)
    made.write()
    report = build(made.store.path, pictures=[])
    assert "one view decides" in report.text
    for name in ("table.md", "table.tex", "report.html"):
        assert "without view7 by +2.92 dB" in (report.folder / name).read_text()
