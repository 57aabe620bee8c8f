"""Adds another program's renders of the test views to a sweep's report, as one more label.

They are scored by the metrics of the frozen protocol against the photographs of the variant, and
compared by the same statistics. They are 8-bit PNGs, while our own cells are scored as float32
images; docs/report.md says what rounding costs. `figures.json` beside them may have time, Gaussians
and memory (`Figures`).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pandas as pd
from msgspec import Meta

from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.evaluation.protocol import score_file
from xrgs.mixture import variant
from xrgs.photos.images import ImageError, header
from xrgs.report.collect import ReportError, ReportStore, Sweep
from xrgs.runtime.progress import progress
from xrgs.safeio.files import is_inside
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.results import over_views
from xrgs.store.scoring import scoring_code

#: Another program's renders become one row for each combination of these columns.
_VARIANT = ["scene", "condition", "variant_seed"]
#: Columns that the row takes from the cells that it is compared with.
_SHARED = [*("variant_id", "baseline_id", "seed"), "validation", "long_side", "factor"]

FIGURES = "figures.json"
_Measured = Annotated[float, Meta(gt=0, le=1e30)] | None


class Figures(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`figures.json` beside the renders of a scene: time and size of that program's training."""

    training_time_s: _Measured = None
    """Seconds of training, on the machine that trained the sweep's cells."""
    gaussians: _Measured = None
    memory_bytes: _Measured = None
    peak_rss_bytes: _Measured = None


@dataclass(frozen=True)
class External:
    """Another program's renders: their label in the tables, and their folder."""

    label: str
    folder: Path


def parse(words: Sequence[str]) -> tuple[External, ...]:
    """Read the words of `xrgs-report --external`: LABEL:FOLDER, or a folder that is its own label.

    Raises:
        ReportError: A label or a folder is empty, or two labels are the same.
    """
    externals = []
    for part in words:
        label, colon, folder = part.partition(":")
        if not colon or "/" in label:  # a path may have a colon
            label, folder = "", part
        path = user_path(folder)
        externals.append(External(label or path.name, path))
        if not folder or not externals[-1].label:
            raise ReportError(f"external={part}: must be FOLDER or LABEL:FOLDER")
    labels = [one.label for one in externals]
    if len(set(labels)) < len(labels):
        raise ReportError(
            f"external={' '.join(words)}: two folders have the same label; use LABEL:FOLDER"
        )
    return tuple(externals)


def with_external(sweep: Sweep, store: ReportStore, externals: Sequence[External]) -> Sweep:
    """Return a sweep with one more row for each variant that another program has rendered.

    A program has one set of renders for a variant: `<view>.png` for each scored view, in the folder
    `<scene>/<variant.seed>/`. If a scene has one draw of HR views, `<scene>/` will do, and if the
    sweep also has only one scene, the folder itself. In each condition they are compared with the
    cells of the lowest seed.

    Raises:
        ReportError: No cell is done, cells already have the label, a folder or a render is missing,
            or a render is not an 8-bit RGB PNG of its view's size. The message names the file and
            the format.
        StoreError: A `figures.json` has an unknown key, or a value that is no number above 0.
        CorruptVariant: A variant is damaged.
    """
    for program in externals:
        if program.label in set(sweep.cells["label"]):
            raise ReportError(f"external={program.label}: cells of the sweep have that label")
        sweep = _with_program(sweep, store, program)
    return sweep


def _with_program(sweep: Sweep, store: ReportStore, program: External) -> Sweep:
    done = sweep.cells[sweep.cells["state"] == "done"].sort_values("seed", kind="stable")
    done = done[~done["cell_id"].isin(sweep.renders)]
    if done.empty:
        raise ReportError(
            f"external={program.label}: no cell of the sweep is done, whose views its renders would"
            " show"
        )
    rows: list[dict[str, Any]] = []
    scores: list[dict[str, Any]] = []
    renders = dict(sweep.renders)
    groups = done.drop_duplicates(_VARIANT).to_dict("records")
    for number, cell in enumerate(groups):
        views = sweep.views.loc[sweep.views["cell_id"] == cell["cell_id"], "view"]
        folder = _folder(program, cell, done)
        cell_id = f"{for_file_name(program.label)}.{number}"  # no cell's id has a dot
        split = "train" if cell["validation"] > 0 else "test"
        variant_views = variant.load(store.variant(str(cell["variant_id"]))).views
        expected = {view.name: view for view in variant_views if view.split == split}
        bar = progress(list(views), f"scoring {program.label}", "view")
        masked = any(expected[name].mask for name in views)
        for name in bar:
            view, file = expected[name], folder / f"{name}.png"
            try:
                # PIL would cut 16 bits to 8, which makes a render darker by half a step.
                if (bits := header(file).bits) > 8:
                    raise ImageError(f"{file}: it has {bits} bits a channel")
                scored = score_file(file, view, masked=masked)
            except ImageError as error:
                wanted = f"an 8-bit RGB PNG of {view.width} x {view.height} px"
                raise ReportError(
                    f"{error}; expected is {wanted}, the render of the view {name}"
                ) from error
            scores.append({"cell_id": cell_id, "view": name} | scored)
        renders[cell_id] = folder
        file = folder / FIGURES
        figures = read_struct(file, Figures) if file.exists() else Figures()
        rows.append(
            {key: cell[key] for key in (*_VARIANT, *_SHARED, "protocol")}
            | {f"{name}_code": scoring_code()[name] for name in VIEW_METRICS}
            | {"cell_id": cell_id, "label": program.label, "state": "done"}
            | msgspec.structs.asdict(figures)
            | dict.fromkeys(("reason", "stale", "machine"), "")
        )
    views = pd.DataFrame(scores, columns=list(sweep.views.columns)).astype(sweep.views.dtypes)
    means = over_views(views.drop(columns="view"))
    added = pd.DataFrame(rows, columns=list(sweep.cells.columns))
    for name in means.columns:
        added[name] = added["cell_id"].map(means[name])
    cells = pd.concat([sweep.cells, added.astype(sweep.cells.dtypes)], ignore_index=True)
    both = pd.concat([sweep.views, views], ignore_index=True)
    return replace(sweep, cells=cells, views=both, renders=renders)


def _folder(program: External, cell: Mapping[Hashable, Any], done: pd.DataFrame) -> Path:
    """Return the first existing folder for renders of a cell's variant, see `with_external`."""
    scene, draw = str(cell["scene"]), int(cell["variant_seed"])
    draws = done.loc[done["scene"] == scene, "variant_seed"].nunique()
    root, candidates = program.folder, []
    if is_inside(scene):
        candidates = [root / scene / str(draw)] + [root / scene] * (draws == 1)
    candidates += [root] * (draws == 1 and set(done["scene"]) == {scene})
    try:
        for folder in candidates:
            if folder.is_dir():
                return folder
    except OSError as error:
        raise ReportError(f"external={program.label}: {root}: {error.strerror}") from error
    no_name = "a folder of the scene, though its name can't be a folder's name,"
    raise ReportError(
        f"external={program.label}: there are no renders of {scene} with variant.seed={draw}: "
        f"{' or '.join(map(str, candidates)) or no_name} is expected, with <view>.png for each"
        " view that is scored"
    )
