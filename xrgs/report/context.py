"""What a table of one condition has to be read with: how its cells were trained and scored.

Text, Markdown, LaTeX and the page all have it from here. It is read from the files of the cells,
which anybody may have written: values are shown as they are, and a file that can't be read leaves
out what it would have told.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError
from xrgs.experiment.results import cell_columns
from xrgs.safeio.sanitize import counted, for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import pandas as pd

    from xrgs.report.joined import JoinedStore

#: Keys of a cell's config that the context names.
_KEYS = (
    *("train.steps", "train.validation", "variant.long_side", "variant.factor"),
    *("variant.hr_fraction", "variant.degradation", "variant.tags"),
    *("variant.test_every", "variant.test"),
    "splat.densify.prune_scale3d",
)
#: Scores of fewer views than these say little: one more view may turn their order.
_ENOUGH_VIEWS = 3
#: The longest value of a config, a processor's name or a list that is shown, in characters.
_MAX_SHOWN = 120


@dataclass(frozen=True)
class Context:
    """How the finished cells of one condition were trained and scored."""

    training: tuple[str, ...] = ()
    """Steps, size, factor, test views and the rule against large Gaussians, as phrases."""
    machine: tuple[str, ...] = ()
    """Processor, threads and backend, as phrases: what times depend on."""
    cautions: tuple[str, ...] = ()
    """Sentences on scores that say less than they seem to."""

    @property
    def of_scores(self) -> str:
        """The context of a table without times; empty where nothing is known."""
        return "; ".join(self.training)

    @property
    def of_times(self) -> str:
        """What times depend on beside the training; empty where nothing is known."""
        return "; ".join(self.machine)

    @property
    def of_all(self) -> str:
        """The context of a table that has times as well."""
        return "; ".join((*self.training, *self.machine))


def context_of(contexts: Mapping[str, Context], condition: str) -> Context:
    """Return the context of a condition; an empty one where none is known.

    Args:
        contexts: What `contexts` returns.
        condition: The condition.
    """
    return contexts.get(condition, Context())


def contexts(store: JoinedStore, cells: pd.DataFrame, views: pd.DataFrame) -> dict[str, Context]:
    """Read the context of each condition of a sweep.

    Args:
        store: The stores that have the cells.
        cells: `Sweep.cells`.
        views: `Sweep.views`.

    Returns:
        The context by the condition; empty for a condition without finished cells.
    """
    done = cells[(cells["state"] == "done") & ~cells["cell_id"].isin(store.external)]
    counts = views.groupby("cell_id")["view"].nunique()
    of_cells = {cell_id: _settings(store, cell_id) for cell_id in done["cell_id"].unique()}
    found = {}
    for condition, rows in done.groupby("condition", sort=False):
        settings = [of_cells[cell_id] for cell_id in rows["cell_id"]]
        tests = {
            str(scene): int(counts.reindex(ids).fillna(0).min())
            for scene, ids in rows.groupby("scene")["cell_id"]
        }
        found[str(condition)] = Context(
            (*_training(settings, tests), *_prune_rule(rows["label"], settings)),
            _machine(settings),
            _cautions(rows["scene"], settings, tests),
        )
    return {name: found.get(name, Context()) for name in cells["condition"].unique()}


def _settings(store: JoinedStore, cell_id: str) -> dict[str, Any]:
    """Return what the context needs of one cell's config and provenance."""
    cell = store.cell(cell_id)
    columns = cell_columns(cell, None)
    settings = {key: columns[key] for key in _KEYS if columns.get(key) is not None}
    try:
        provenance = cell.provenance()
    except StoreError:
        return settings
    return settings | {key: getattr(provenance, key) for key in ("cpu", "threads", "backend")}


def _distinct(settings: Iterable[Mapping[str, Any]], key: str) -> list[str]:
    """Return the distinct values of a key as text, in the order in which they are found."""
    values = (one[key] for one in settings if one.get(key) is not None)
    return list(dict.fromkeys(map(_shown, values)))


def _shown(value: object) -> str:
    """Return a value of a config as a text of one line, whatever it is."""
    text = f"{value:,g}" if type(value) in {int, float} else str(value)
    return for_line(text, _MAX_SHOWN)


def _training(settings: Sequence[Mapping[str, Any]], tests: Mapping[str, int]) -> list[str]:
    """Return phrases on steps, size, mixture and test views."""
    phrases = []
    for key, phrase in (
        ("train.steps", "{} steps"),
        ("variant.long_side", "HR views of at most {} px"),
    ):
        if values := _distinct(settings, key):
            phrases.append(phrase.format(" or ".join(values)))
    phrases = [text.replace("of at most 0 px", "at the photographs' size") for text in phrases]
    mixtures = dict.fromkeys(filter(None, map(_mixture, settings)))
    phrases += [" or ".join(mixtures)] if mixtures else []
    least, most = min(tests.values()), max(tests.values())
    count = f"{least}" if least == most else f"{least} to {most}"
    held_out = any(one.get("train.validation") for one in settings)
    kind = "held-out training view" if held_out else "test view"
    phrases.append(f"{count} {kind}{'s' * (most != 1)}{' a scene' * (len(tests) > 1)}")
    return phrases


def _mixture(one: Mapping[str, Any]) -> str:
    """Return a phrase on what was done to the LR views of a cell; empty where that is not known."""
    tags, kind = one.get("variant.tags"), one.get("variant.degradation")
    made = tags == "flag"
    if made and one.get("variant.hr_fraction") == 1:
        return "all views HR"
    if kind == "downsample" or (made and kind == "auto"):
        factor = one.get("variant.factor")
        return f"LR views {_shown(factor)} times smaller" if factor is not None else ""
    if kind in ("auto", "none"):
        return f"LR by {_shown(tags)} (nothing degraded)"
    return f"LR views by {_shown(kind)}" if kind is not None else ""


def _prune_rule(labels: Iterable[str], settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a phrase on the rule against large Gaussians, with the labels where they differ."""
    key = "splat.densify.prune_scale3d"
    by_value: dict[str, dict[str, None]] = {}  # with the labels in order
    for label, one in zip(labels, settings, strict=True):
        for value in _distinct([one], key):
            by_value.setdefault(value, {})[label] = None
    if not by_value:
        return []
    several = len(by_value) > 1
    each = (f"{v} ({', '.join(found)})" if several else v for v, found in by_value.items())
    phrase = f"Gaussians above {', '.join(each)} times the scene's scale are pruned"
    return [for_line(phrase, 2 * _MAX_SHOWN)]


def _machine(settings: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return phrases on what times depend on."""
    phrases = [" or ".join(_distinct(settings, "cpu"))]
    if threads := _distinct(settings, "threads"):
        several = "s" * (threads != ["1"])
        phrases.append(f"{' or '.join(threads)} thread{several}")
    phrases.append(" or ".join(f"{name} backend" for name in _distinct(settings, "backend")))
    return tuple(phrase for phrase in phrases if phrase)


def _cautions(
    scenes: Iterable[str], settings: Sequence[Mapping[str, Any]], tests: Mapping[str, int]
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
        for scene, one in zip(scenes, settings, strict=True)
        if not _holds_out(one)
    ]
    return tuple(
        for_line(f"Caution: {text}", 2 * _MAX_SHOWN) for text in dict.fromkeys((*few, *trained_on))
    )


def _holds_out(settings: Mapping[str, Any]) -> bool:
    """Return whether a cell is scored on views that it was not trained on, as far as is known."""
    return bool(
        settings.get("variant.test_every", 1)
        or settings.get("variant.test")
        or settings.get("train.validation")
    )
