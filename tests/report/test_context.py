"""The context of a table says how its cells were trained, and warns of few views."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

from tests.report.conftest import VIEWS
from xrgs.report.context import Context, contexts
from xrgs.report.joined import JoinedStore
from xrgs.safeio.atomic import write_json

CONFIG = {
    "train": {"steps": 3000, "validation": 0.0},
    "variant": {
        "long_side": 504,
        "factor": 5,
        "degradation": "auto",
        "tags": "flag",
        "test_every": 8,
    },
    "splat": {"densify": {"prune_scale3d": 0.1}},
}


def configured(folder: Any, **changes: Any) -> None:
    """Give a cell the config above, with changes by group, and finish it again with that file."""
    config = {name: values | changes.get(name, {}) for name, values in CONFIG.items()}
    write_json(folder.folder / "config.json", config)
    folder.finish(VIEWS, 1)


def found(made: Any) -> dict[str, Context]:
    sweep = made.read()
    return contexts(JoinedStore((made.store,)), sweep.cells, sweep.views)


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
    configured(made.add(scene="leaves"), train={"steps": 500})
    text = found(made)[""].of_scores
    assert "3,000 or 500 steps" in text
    assert "0.1 (baseline), 10 (keep_large) times the scene's scale" in text
    assert "2 test views a scene" in text


@pytest.mark.parametrize(
    ("count", "said"), [(1, "1 scored view:"), (2, "2 scored views:"), (3, "")]
)
def test_fewer_than_three_scored_views_are_cautioned(made: Any, count: int, said: str) -> None:
    cell = made.add()
    configured(cell)
    sweep = made.read()
    views = pd.DataFrame({"cell_id": [cell.id] * count, "view": [f"v{n}" for n in range(count)]})
    cautions = contexts(JoinedStore((made.store,)), sweep.cells, views)[""].cautions
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


def test_scenes_whose_lr_views_differ_are_both_said(made: Any) -> None:
    configured(made.add())
    configured(made.add(scene="leaves"), variant={"tags": "sampling_rate", "factor": 2})
    text = found(made)[""].of_scores
    assert "LR views 5 times smaller or LR by sampling_rate (nothing degraded)" in text


def test_a_sweep_without_lr_views_names_none(made: Any) -> None:
    configured(made.add(), variant={"hr_fraction": 1.0})
    text = found(made)[""].of_scores
    assert "all views HR" in text
    assert "LR" not in text


def test_a_mixture_that_was_not_made_is_said(made: Any) -> None:
    configured(made.add(), variant={"tags": "sampling_rate"})
    assert "LR by sampling_rate (nothing degraded)" in found(made)[""].of_scores


def test_values_of_a_stranger_are_shown_as_they_are(made: Any) -> None:
    configured(made.add(cpu="\x1b[31mred\n"), train={"steps": "many\n\x1b"})
    text = found(made)[""].of_all
    assert "\x1b" not in text
    assert "\n" not in text


def test_without_finished_cells_there_is_no_context(made: Any) -> None:
    made.add(state="failed")
    assert found(made) == {"": Context()}


def test_a_factor_that_is_not_known_is_not_named(made: Any) -> None:
    configured(made.add(), variant={"factor": None})
    text = found(made)[""].of_scores
    assert "times smaller" not in text
    assert "None" not in text
