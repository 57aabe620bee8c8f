"""The context of a table: how its cells were trained and scored, cautions, and photographs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from xrgs.config import Conf, VariantConf
from xrgs.errors import StoreError
from xrgs.mixture.degradations import DEGRADATIONS, resolve_degradation
from xrgs.report.collect import ReportStore, Sweep
from xrgs.report.compare import Comparison
from xrgs.report.inference import OTHER_CODE
from xrgs.report.writing import signed
from xrgs.runtime.text import listed
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store.inspect import SfmReport, read_report
from xrgs.store.schema import Provenance
from xrgs.store.trimming import home_of

#: Scores of fewer views than this say little: one more view may reverse their order.
_ENOUGH_VIEWS = 3
#: The longest shown value (of a config, or a processor's name) and sentence, in characters.
_MAX_SHOWN = 120
_MAX_SENTENCE = 240
_ALL_HR = "all views HR"


@dataclass(frozen=True)
class Context:
    """How the finished cells of one condition were trained and scored."""

    training: tuple[str, ...] = ()
    """Steps, size, factor, test views and the rule against large Gaussians, as phrases."""
    machine: tuple[str, ...] = ()
    """Processor, threads and backend, on which times depend, as phrases."""
    cautions: tuple[str, ...] = ()
    """Sentences on scores that are easily misread."""

    @property
    def of_scores(self) -> str:
        """The context of a table without times; empty if nothing is known."""
        return "; ".join(self.training)

    @property
    def of_times(self) -> str:
        """Processor, threads and backend, for a table of times; empty if nothing is known."""
        return "; ".join(self.machine)

    @property
    def of_all(self) -> str:
        """The context of a table that has times as well."""
        return "; ".join((*self.training, *self.machine))


def contexts(sweep: Sweep) -> dict[str, Context]:
    """Return the context of each condition; an empty one without finished cells."""
    cells = sweep.cells
    done = cells[cells["cell_id"].isin(sweep.done)]
    counts = sweep.views.groupby("cell_id")["view"].nunique()
    by_condition = {}
    for condition, rows in done.groupby("condition", sort=False):
        tests = {
            str(scene): int(counts.reindex(ids).fillna(0).min())
            for scene, ids in rows.groupby("scene")["cell_id"]
        }
        trained = [sweep.done[cell_id] for cell_id in rows["cell_id"]]
        configs = [cell.config for cell in trained]
        reports = [sweep.variants.get(name) for name in rows["variant_id"]]
        tagged = not all(report and report.alike for report in reports)
        least, most = min(tests.values()), max(tests.values())
        count = f"{least}" if least == most else f"{least} to {most}"
        kind = "held-out training view" if (rows["validation"] > 0).any() else "test view"
        by_condition[str(condition)] = Context(
            (
                *_sizes([config for config in configs if config], tagged=tagged),
                f"{count} {kind}{'s' * (most != 1)}{' a scene' * (len(tests) > 1)}",
                *_prune_rule(zip(rows["label"], configs, strict=True)),
            ),
            _machine([cell.provenance for cell in trained]),
            (
                *_cautions(zip(rows["scene"], configs, strict=True), tests),
                *_cautions_of_photographs(rows, sweep),
            ),
        )
    return {name: by_condition.get(name, Context()) for name in cells["condition"].unique()}


def _distinct(values: Iterable[float | str | None]) -> str:
    """Join the distinct values in their order, without None: `3,000 or 500`."""
    return " or ".join(dict.fromkeys(_shown(value) for value in values if value is not None))


def _shown(value: float | str) -> str:
    return for_line(value if isinstance(value, str) else f"{value:,g}", _MAX_SHOWN)


def _sizes(configs: Sequence[Conf], *, tagged: bool) -> list[str]:
    """Return phrases on steps and size and, if views are `tagged` HR and LR, on the mixture."""
    if not configs:
        return []
    sizes = _distinct(config.variant.long_side for config in configs)
    steps = f"{_distinct(config.train.steps for config in configs)} steps"
    if all(config.splat.optimizer.length_power for config in configs):
        steps += ", with learning rates that fit"
    if not tagged:
        size = "at their own size" if sizes == "0" else f"of at most {sizes} px"
        return [steps, f"photographs {size}"]
    return [
        steps,
        "HR views at the photographs' size" if sizes == "0" else f"HR views of at most {sizes} px",
        " or ".join(dict.fromkeys(_mixture(config.variant) for config in configs)),
    ]


def _mixture(variant: VariantConf) -> str:
    """Return a phrase on how the LR views of a cell were made."""
    chosen = variant.tags == "flag"  # by `hr_fraction`, not by the photographs' sampling rates
    if chosen and variant.hr_fraction == 1:
        return _ALL_HR
    degradation = resolve_degradation(variant)
    if degradation == "none":
        return f"LR by {_shown(variant.tags)} (nothing degraded)"
    way = f"by {_shown(degradation)}"
    if degradation not in DEGRADATIONS or not DEGRADATIONS[degradation].smaller:
        return f"LR views {way}"
    smaller = f"LR views {_shown(variant.factor)} times smaller"
    return smaller if degradation == "downsample" else f"{smaller}, {way}"


def _prune_rule(configs: Iterable[tuple[str, Conf | None]]) -> list[str]:
    """Return a phrase on the pruning of large Gaussians; it names labels if they differ."""
    by_value: dict[str, dict[str, None]] = {}  # with the labels in order
    without_rule: dict[str, None] = {}
    for label, config in configs:
        if config and config.splat.strategy == "default":
            value = _shown(config.splat.densify.prune_scale3d)
            by_value.setdefault(value, {})[label] = None
        elif config:
            without_rule[label] = None
    if not by_value:
        return []
    several = len(by_value) > 1
    each = (f"{v} ({', '.join(labels)})" if several else v for v, labels in by_value.items())
    phrase = f"Gaussians above {', '.join(each)} times the scene's scale are pruned"
    if without_rule:
        phrase += f", and none for their size in {', '.join(without_rule)}"
    return [for_line(phrase, _MAX_SENTENCE)]


def _machine(trained: Sequence[Provenance]) -> tuple[str, ...]:
    """Return `Context.machine` of trainings."""
    threads = _distinct(one.threads for one in trained)
    phrases = (
        _distinct(one.cpu for one in trained),
        _distinct(one.gpu for one in trained),
        f"{threads} thread{'s' * (threads != '1')}",
        _distinct(f"{one.backend} backend" for one in trained),
    )
    return tuple(filter(None, phrases))


def _cautions(
    configs: Iterable[tuple[str, Conf | None]], tests: Mapping[str, int]
) -> tuple[str, ...]:
    """Return sentences on scores of too few views, and of views that were trained on."""
    few = [
        f"{scene} has {counted(count, 'scored view')}: its scores say little of other views"
        for scene, count in tests.items()
        if count < _ENOUGH_VIEWS
    ]
    trained_on = [
        f"{scene} has no view held out (variant.test_every=0): its scores are of views that were"
        " trained on"
        for scene, config in configs
        if config
        and not (config.variant.test_every or config.variant.test or config.train.validation)
    ]
    return tuple(
        for_line(f"Caution: {text}", _MAX_SENTENCE) for text in dict.fromkeys((*few, *trained_on))
    )


def _cautions_of_photographs(rows: pd.DataFrame, sweep: Sweep) -> list[str]:
    """Return sentences on test views that have no score, and on mixtures without an LR view."""
    texts = []
    for scene, scene_rows in rows.groupby("scene", sort=False):
        unscored: dict[str, None] = {}
        unmixed = False
        for row in scene_rows.to_dict("records"):
            if (report := sweep.variants.get(row["variant_id"])) is None:
                continue
            config = sweep.done[row["cell_id"]].config
            wants_lr = config is None or _mixture(config.variant) != _ALL_HR
            unmixed |= wants_lr and not report.as_they_are and bool(report.hr) and not report.lr
            if row["validation"] == 0:
                unscored |= dict.fromkeys(report.not_scored)
        if unscored:
            names = listed([*unscored])
            texts.append(f"{scene} is scored without test views that are not placed: {names}")
        if unmixed:
            texts.append(f"{scene} has no LR view: nothing is mixed")
    return [for_line(f"Caution: {text}", _MAX_SENTENCE) for text in texts]


_PAIR = ["label", "condition", "scene", "variant_seed", "seed"]
#: A view decides a mean change of PSNR if all three hold: without it the mean differs by more than
#: _MIN_SHARE of the mean, and by more than _MIN_DB; and its distance from the median of the other
#: views is more than _MIN_DISTANCE times that of the farthest other view. Our choice.
_MIN_SHARE = 0.5
_MIN_DB = 0.3
_MIN_DISTANCE = 3.0


def decided_by_one_view(
    comparison: Comparison, views: pd.DataFrame
) -> dict[tuple[str, str], list[str]]:
    """Warn of pairs where one view decides the change in PSNR, by label and condition.

    A scene has few test views, and PSNR has no bound: a floater in front of one test camera can
    cost its view 10 dB, which is more than all other views gain together. A sentence names the
    view, and the change with and without it.
    """
    changes = _changes_of_views(comparison, views)
    pairs = _with_and_without(changes)
    difference = (pairs["without"] - pairs["with_all"]).abs()
    decided = pairs[
        (pairs["n_views"] >= _ENOUGH_VIEWS)
        & (difference > _MIN_SHARE * pairs["with_all"].abs())
        & (difference > _MIN_DB)
        & (pairs["distance"] > _MIN_DISTANCE * pairs["spread"])
    ]
    notes: dict[tuple[str, str], list[str]] = {}
    for row in decided.to_dict("records"):
        text = (
            f"Caution: one view decides: on {row['scene']} (replicate"
            f" {row['variant_seed']}/{row['seed']}) PSNR changes by {signed(row['with_all'])} dB,"
            f" and without {row['view']} by {signed(row['without'])} dB"
        )
        notes.setdefault((row["label"], row["condition"]), []).append(for_line(text, _MAX_SENTENCE))
    return notes


def _changes_of_views(comparison: Comparison, views: pd.DataFrame) -> pd.DataFrame:
    """Return the finite changes in PSNR of each view of each pair, dB."""
    pairs = comparison.pairs[comparison.pairs["metric"] == "psnr"]
    # A record may have a row twice.
    pairs = pairs.loc[pairs["why"] != OTHER_CODE, [*_PAIR, "cell_id", "base_id"]].drop_duplicates()
    scores = views[["cell_id", "view", "psnr"]]
    base_scores = scores.rename(columns={"cell_id": "base_id", "psnr": "base_psnr"})
    rows = pairs.merge(scores, on="cell_id").merge(base_scores, on=["base_id", "view"])
    with np.errstate(invalid="ignore"):  # inf - inf gives NaN, as it should
        rows["change"] = rows["psnr"] - rows["base_psnr"]
    finite: pd.DataFrame = rows[np.isfinite(rows["change"])].reset_index(drop=True)
    return finite


def _with_and_without(changes: pd.DataFrame) -> pd.DataFrame:
    """Return the mean change of each pair with and without its most distant view.

    One row for each pair: `view`, the one farthest from the median of all; `n_views`; `with_all`,
    the mean over all; `without`, the mean over the others; `distance`, from the view to the median
    of the others; `spread`, the largest distance of the others from their median. All in dB.
    """
    groups = changes.groupby(_PAIR, sort=False)["change"]
    far = (changes["change"] - groups.transform("median")).abs()
    farthest = far.groupby([changes[key] for key in _PAIR], sort=False).idxmax()
    others = changes.drop(index=list(farthest))
    rest = others.groupby(_PAIR, sort=False)["change"]
    spread = (others["change"] - rest.transform("median")).abs()
    pairs = changes.loc[farthest].set_index(_PAIR)
    pairs = pairs.assign(
        n_views=groups.size(),
        with_all=groups.mean(),
        without=rest.mean(),
        distance=(pairs["change"] - rest.median()).abs(),
        spread=spread.groupby([others[key] for key in _PAIR], sort=False).max(),
    )
    return pairs.reset_index()


#: The most names in a sentence on views that are not placed.
_MAX_NAMES = 200


def with_variants(sweep: Sweep, store: ReportStore) -> Sweep:
    """Return a sweep with the SfM reports of its finished cells' variants.

    If a report can't be read, its note says so.
    """
    done = sweep.cells[sweep.cells["cell_id"].isin(sweep.done)]
    reports = {}
    for variant_id in done["variant_id"].unique():
        try:
            reports[variant_id] = read_report(home_of(store.variants, variant_id))
        except StoreError as error:
            why = store.without_paths(str(error))
            reports[variant_id] = SfmReport(notes=(f"unknown what was done with them: {why}",))
    return replace(sweep, variants=reports)


def photographs(sweep: Sweep) -> list[tuple[str, tuple[str, ...]]]:
    """Return (scene, sentences on its photographs) for the scenes with finished cells.

    They come from all variants of the scene, and from its cells' trainings (blur, exposure).
    """
    done = sweep.cells[sweep.cells["variant_id"].isin(sweep.variants)]
    by_scene = []
    for scene, rows in done.groupby("scene", sort=False):
        variants = [sweep.variants[name] for name in rows["variant_id"].unique()]
        notes = [note for variant in variants for note in variant.all_notes(_MAX_NAMES)]
        several = len(rows[["variant_seed", "seed"]].drop_duplicates()) > 1
        for row in rows[rows["cell_id"].isin(sweep.done)].to_dict("records"):
            replicate = f"replicate {row['variant_seed']}/{row['seed']}" * several
            name = ", ".join(filter(None, (row["label"], row["condition"], replicate)))
            notes += [f"{name}: {line}" for line in sweep.done[row["cell_id"]].summary.found]
        by_scene.append((str(scene), tuple(dict.fromkeys(notes))))
    return [(scene, notes) for scene, notes in by_scene if notes]


def placement(sweep: Sweep, scene: str) -> str:
    """Say how the photographs of a scene were placed, from the report of its first variant."""
    rows = sweep.cells[(sweep.cells["scene"] == scene)]
    reports = [sweep.variants[name] for name in rows["variant_id"] if name in sweep.variants]
    if not reports or not reports[0].images:
        return "it is unknown how the photographs were placed"
    report = reports[0]
    by = "structure from motion" if report.poses is None else "the cameras that were given"
    error = report.reprojection_error_px
    parts = [f"{report.registered} of {report.images} photographs are placed by {by}"]
    parts += [f"{report.points:,} points"] if report.points else []
    parts += [] if error is None else [f"mean reprojection error {error:.2f} px"]
    return ", ".join(parts)
