"""Tables of the work of each training, the work that it skipped, and the cost of the skipped work.

They show why a component changes nothing or makes results worse, and where a run saves time. Counts
come from the history of a cell; the totals (`xrgs.training.recorder`) and the seconds of each stage
from its summary. The cost of skipped work is estimated from the same run's totals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from xrgs.report.collect import CELL_KEYS, DoneCell, is_component_log
from xrgs.report.markup import titled
from xrgs.runtime.text import TextTable

_LABELS = {
    "steps_HR": "Steps on HR views",
    "steps_LR": "Steps on LR views",
    "duplicated": "Gaussians duplicated",
    "split": "Gaussians split",
    "pruned_opacity": "Pruned: transparent",
    "pruned_scale": "Pruned: too large",
    "pruned_non_finite": "Pruned: not finite",
    "pruned_by_components": "Pruned: by components",
    "reset": "Opacities reset",
    "relocated": "Gaussians relocated",
    "added": "Gaussians added",
    "skipped_backward": "Steps without a backward pass",
    "skipped_shN": "Steps that did not move shN",
}
_NUMBERS = ["number", "share", "cost", "cost_share"]
#: Counts of a history with this prefix are numbers of steps that skipped something.
_PREFIX = "skipped_"
_UNKNOWN = "unknown"


class _Kind(NamedTuple):
    """A kind of work that a run can skip."""

    label: str
    """Name in the table; `{base}` is replaced by the label of the base."""
    unit: str
    """Unit of the cost: `s`, `evaluations` (of alpha), or empty if the cost is unknown."""
    estimate: str
    """How the cost is estimated, for a note below the table."""


_KINDS = {
    "steps": _Kind("Steps that {base} takes", "s", "at the run's mean time of a step"),
    "views": _Kind(
        "Views that {base} trains on", "s", "none: these steps are taken on other views"
    ),
    "skipped_backward": _Kind(
        "Backward passes and updates",
        "s",
        "at the run's mean time of a backward pass and an update",
    ),
    "pixels": _Kind(
        "Pixels of the photographs that were not rendered",
        "evaluations",
        "at the run's evaluations of a rendered pixel",
    ),
    "gaussians": _Kind(
        "Gaussians out of view or transparent, of all steps",
        "evaluations",
        "one for each pixel of the view",
    ),
    "tiles": _Kind(
        "Pixels of tiles that a visible Gaussian does not reach",
        "evaluations",
        "one for each, exact but for the tiles at the edges",
    ),
    "blocks": _Kind(
        "Pixels of such tiles in blocks that are not reached, or saturated",
        "evaluations",
        "one for each, exact; the two are not counted apart",
    ),
    "sh": _Kind(
        "Harmonics of visible Gaussians in bands that were not on",
        "",
        "not estimated: the time of a band is not measured",
    ),
}


def totals(cells: pd.DataFrame, done: Mapping[str, DoneCell]) -> pd.DataFrame:
    """Return the counts of training in each of `Comparison.cells` that is done.

    There is a row for each cell: `CELL_KEYS`, and a column for each count of its history (at the
    end of training) and each value that a component logged (its mean over training); NaN for a cell
    without it.
    """
    keys = cells.loc[cells["cell_id"].isin(done), CELL_KEYS].drop_duplicates("cell_id")
    keys = keys.reset_index(drop=True)
    return keys.join(pd.DataFrame([done[name].totals for name in keys["cell_id"]]))


def totals_table(totals: pd.DataFrame, labels: Sequence[str], condition: str) -> TextTable:
    """Return the table of `totals` of one condition, scene by scene, as means over seeds."""
    chosen = totals[totals["condition"] == condition]
    numbers = [
        name for name in totals.columns if name not in CELL_KEYS and chosen[name].notna().any()
    ]
    names = sorted(numbers, key=lambda name: (name not in _LABELS, is_component_log(name)))
    means = chosen.groupby(["scene", "label"])[names].mean().to_dict("index")
    rows = []
    for scene in sorted(chosen["scene"].unique()):
        of_scene = [means.get((scene, label), {}) for label in labels]
        for name in names:
            texts = [
                _count(values.get(name), is_component_log=is_component_log(name))
                for values in of_scene
            ]
            if any(texts):
                rows.append((scene, _LABELS.get(name, name.replace("_", " ")), *texts))
    return TextTable(
        title=titled("What training did, means over the replicates that are done", condition),
        columns=("Scene", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=("names with a dot: values that a component logged, means over training",),
    )


def _count(value: float | None, *, is_component_log: bool) -> str:
    if value is None or pd.isna(value):
        return ""
    return f"{value:.4g}" if is_component_log else f"{value:,.0f}"


def _work(cell: DoneCell) -> dict[str, float]:
    """Return the totals of a cell; older versions kept no `work` and no seconds of stages."""
    summary = cell.summary
    return {
        **summary.work,
        **{f"seconds_{stage}": value for stage, value in summary.stage_seconds.items()},
        "steps": float(summary.steps),
        "evaluations": summary.evaluations,
        "seconds": summary.training_time_s,
        **{name: value for name, value in cell.totals.items() if name.startswith(_PREFIX)},
    }


def skipped(cells: pd.DataFrame, done: Mapping[str, DoneCell]) -> pd.DataFrame:
    """Return the work that each of `Comparison.cells` skipped.

    There is a row for each cell and kind of work with known counts: `CELL_KEYS` and `kind`; the
    skipped `number`, and its `share` of the total; the estimated `cost` of the skipped work in the
    kind's `unit` (`s` or `evaluations`), and `cost_share`, the cost over that of the whole run. The
    costs are NaN if unknown.
    """
    rows = []
    finished = cells[cells["cell_id"].isin(done)].drop_duplicates(CELL_KEYS)
    for cell in finished.to_dict("records"):
        run = done[cell["cell_id"]]
        work = _work(run)
        for kind, number, whole, cost in _left_out(work, _work(done.get(cell["base_id"], run))):
            if math.isnan(number) or not whole > 0:
                continue
            unit = _kind(kind).unit
            total = work["seconds" if unit == "s" else "evaluations"]
            rows.append(
                {key: cell[key] for key in CELL_KEYS}
                | {"kind": kind, "number": number, "share": number / whole, "cost": cost}
                | {"unit": unit, "cost_share": cost / total if total else math.nan}
            )
    columns = [*CELL_KEYS, "kind", "number", "share", "cost", "unit", "cost_share"]
    return pd.DataFrame(rows, columns=columns)


def _left_out(
    work: Mapping[str, float], base: Mapping[str, float]
) -> Iterator[tuple[str, float, float, float]]:
    """Yield the kinds of work: name, skipped number, total number, and cost of the skipped."""

    def total(name: str) -> float:
        return work.get(name, math.nan)

    def of_base(name: str) -> float:
        return base.get(name, math.nan)

    steps, evaluations = total("steps"), total("evaluations")
    fewer = _above_zero(of_base("steps") - steps)
    yield "steps", fewer, of_base("steps"), _times(fewer, total("seconds"), steps)
    yield "views", _above_zero(of_base("views") - total("views")), of_base("views"), 0.0
    for name in [name for name in work if name.startswith(_PREFIX)]:
        cost = math.nan
        if name == "skipped_backward":
            seconds = total("seconds_backward") + total("seconds_optimizer")
            cost = _times(work[name], seconds, steps - work[name])
        yield name, work[name], steps, cost
    left_out, rendered = total("pixels_left_out"), total("pixels")
    yield "pixels", left_out, total("pixels_photograph"), _times(left_out, evaluations, rendered)
    yield (
        "gaussians",
        total("gaussians") - total("gaussians_visible"),
        total("gaussians"),
        total("pairs") - total("pairs_visible"),
    )
    in_tiles = total("pairs_in_tiles")
    elsewhere = _above_zero(total("pairs_visible") - in_tiles)
    yield "tiles", elsewhere, total("pairs_visible"), elsewhere
    yield "blocks", in_tiles - evaluations, in_tiles, in_tiles - evaluations
    yield "sh", total("sh_coefficients_left_out"), total("sh_coefficients"), math.nan


def _above_zero(value: float) -> float:
    """Return a number, or 0 if it is negative; NaN stays NaN."""
    return 0.0 if value < 0 else value


def _times(number: float, amount: float, count: float) -> float:
    """Return number * amount / count; NaN if `count` is 0 or NaN."""
    return number * amount / count if count > 0 else math.nan


def _kind(name: str) -> _Kind:
    words = name.removeprefix(_PREFIX).replace("_", " ")
    return _KINDS.get(name, _Kind(f"Steps without {words}", "", "not estimated"))


def skipped_table(
    skipped_work: pd.DataFrame, labels: Sequence[str], condition: str, base: str
) -> TextTable:
    """Return the table of `skipped` for one condition: means over a scene's runs, then over scenes.

    Kinds of work that no run skipped have no row.
    """
    chosen = skipped_work[skipped_work["condition"] == condition]
    by_scene = chosen.groupby(["kind", "label", "scene"], sort=False)[_NUMBERS].mean()
    means = by_scene.groupby(level=["kind", "label"], sort=False).mean()
    rows, notes = [], []
    for name in dict.fromkeys(chosen["kind"]):
        of_kind, kind = means.loc[name], _kind(name)
        if not of_kind["number"].any():
            continue
        texts = [
            _texts(of_kind.loc[label]) if label in of_kind.index else ("", "") for label in labels
        ]
        would = f"would have cost{kind.unit and f', {kind.unit}'}"
        label = kind.label.replace("{base}", base)
        rows.append((label, "number (share)", *(number for number, _ in texts)))
        rows.append(("", f"{would} (of the run's own)", *(cost for _, cost in texts)))
        notes.append(f"{label}: cost {kind.estimate}")
    return TextTable(
        title=titled("What each run left out, mean over scenes", condition),
        columns=("Left out", "", *labels),
        rows=tuple(rows),
        align="ll" + "r" * len(labels),
        notes=tuple(notes),
    )


def _texts(row: pd.Series) -> tuple[str, str]:
    """Return the skipped number and its cost as texts."""
    number = f"{_short(row['number'])} ({_share(row['share'])})"
    if math.isnan(row["cost"]):
        return number, _UNKNOWN
    return number, f"{_short(row['cost'])} ({_share(row['cost_share'])})"


def _short(value: float) -> str:
    """Write a number with an SI prefix: 17,900 as `17.9 k`."""
    if not math.isfinite(value):
        return _UNKNOWN
    size = min(4, int(math.log10(value)) // 3) if value >= 1000 else 0
    return f"{value / 1000**size:,.4g} {('', 'k', 'M', 'G', 'T')[size]}".rstrip()


def _share(value: float) -> str:
    if value < 1:
        return f"{value:.1%}"
    return f"{value:,.1f} times" if value < 100 else f"{value:,.0f} times"
