"""Renders of the test views that another program made, as one more label of a sweep's report.

They are scored by the metrics of the frozen protocol against the photographs of the variant, and
compared by the same statistics. They are 8-bit PNGs, and our own cells are scored as float32
images: the rounding costs PSNR 0.005 dB at 30 dB and 0.05 dB at 40 dB, and SSIM 0.0004 on the
embedded scene. Time, Gaussians and memory are known where a file beside the renders has them
(`Figures`), else n/a.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import pandas as pd
from msgspec import Meta

from xrgs.evaluation.files import score_file
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.mixture import variant
from xrgs.photos.images import ImageError
from xrgs.report.collect import ReportError, Sweep
from xrgs.runtime.progress import progress
from xrgs.safeio.files import is_inside
from xrgs.safeio.paths import user_path
from xrgs.safeio.records import read_struct
from xrgs.safeio.sanitize import for_file_name
from xrgs.store.results import over_views
from xrgs.store.scoring import scoring_code

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence
    from pathlib import Path

    from xrgs.mixture.views import View
    from xrgs.report.joined import ReportStore

#: Another program's renders become one row for each combination of these.
_VARIANT = ["scene", "condition", "variant_seed"]
#: What the row has in common with the cells that it is compared with.
_SHARED = [*("variant_id", "baseline_id", "seed"), "validation", "long_side", "factor"]

FIGURES = "figures.json"
_Measured = Annotated[float, Meta(gt=0, le=1e30)] | None


class Figures(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`figures.json`, beside the renders of a scene: what the other program's training took."""

    training_time_s: _Measured = None
    """Seconds of training, on the machine of the cells that it is compared with."""
    gaussians: _Measured = None
    memory_bytes: _Measured = None
    peak_rss_bytes: _Measured = None


@dataclass(frozen=True)
class External:
    """Where another program's renders are, and what the tables call them."""

    label: str
    folder: Path


def parse(words: Sequence[str]) -> tuple[External, ...]:
    """Read the words of `xrgs-report --external LABEL:FOLDER LABEL:FOLDER`.

    Args:
        words: Folders, each with a label before it or named by the folder's own name.

    Raises:
        ReportError: A label or a folder is empty, or two labels are the same.
    """
    found = []
    for part in words:
        label, colon, folder = part.partition(":")
        if not colon or "/" in label:  # a path may have a colon
            label, folder = "", part
        path = user_path(folder)
        found.append(External(label or path.name, path))
        if not folder or not found[-1].label:
            raise ReportError(f"external={part}: must be FOLDER or LABEL:FOLDER")
    labels = [one.label for one in found]
    if len(set(labels)) < len(labels):
        raise ReportError(
            f"external={' '.join(words)}: two folders have the same label; use LABEL:FOLDER"
        )
    return tuple(found)


def with_external(sweep: Sweep, store: ReportStore, externals: Sequence[External]) -> Sweep:
    """Return a sweep with a row for each variant that another program has rendered.

    A program has one set of renders for a variant. They are paired with the cells of the lowest
    seed, in each condition.

    Args:
        sweep: The sweep.
        store: The stores that have the sweep's variants.
        externals: The programs' renders: `<view>.png` for each scored view, in the folder
            `<scene>/<variant.seed>/`. Where a scene has one draw of HR views, `<scene>/` will do;
            where the sweep also has one scene, the folder itself. `figures.json` beside them may
            have numbers of the training.

    Returns:
        The sweep with these rows in `cells` and `views`, and their folders in `renders`.

    Raises:
        ReportError: Cells have a label of the renders, a folder or a render is missing, or a render
            is not an 8-bit RGB PNG of its view's size. The message names the file and the format.
        StoreError: A `figures.json` has another key or a value that is no number above 0.
        CorruptVariant: A variant is damaged.
    """
    for one in externals:
        if one.label in set(sweep.cells["label"]):
            raise ReportError(f"external={one.label}: cells of the sweep have that label")
        sweep = _with_one(sweep, store, one)
    return sweep


def _with_one(sweep: Sweep, store: ReportStore, one: External) -> Sweep:
    done = sweep.cells[sweep.cells["state"] == "done"].sort_values("seed", kind="stable")
    done = done[~done["cell_id"].isin(sweep.renders)]
    rows: list[dict[str, Any]] = []
    scores: list[dict[str, Any]] = []
    renders = dict(sweep.renders)
    groups = done.drop_duplicates(_VARIANT).to_dict("records")
    for number, cell in enumerate(groups):
        views = sweep.views.loc[sweep.views["cell_id"] == cell["cell_id"], "view"]
        folder = _folder(one, cell, done)
        cell_id = f"{for_file_name(one.label)}.{number}"  # no cell's id has a dot
        split = "train" if cell["validation"] > 0 else "test"
        expected = _expected(store, str(cell["variant_id"]), split)
        bar = progress(list(views), f"scoring {one.label}", "view")
        masked = any(expected[name].mask for name in views)
        scores += [{"cell_id": cell_id} | _score(folder, expected[name], masked) for name in bar]
        renders[cell_id] = folder
        rows.append(
            {key: cell[key] for key in (*_VARIANT, *_SHARED, "protocol")}
            | {f"{name}_code": scoring_code()[name] for name in VIEW_METRICS}
            | {"cell_id": cell_id, "label": one.label, "state": "done"}
            | _figures(folder)
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


def _folder(one: External, cell: Mapping[Hashable, Any], done: pd.DataFrame) -> Path:
    """Return the folder with the renders of a cell's variant: the first of these that is there."""
    scene, draw = str(cell["scene"]), int(cell["variant_seed"])
    draws = done.loc[done["scene"] == scene, "variant_seed"].nunique()
    root, inside = one.folder, []
    if is_inside(scene):
        inside = [root / scene / str(draw)] + [root / scene] * (draws == 1)
    if draws == 1 and set(done["scene"]) == {scene}:
        inside.append(root)
    try:
        found = [folder for folder in inside if folder.is_dir()]
    except OSError as error:
        raise ReportError(f"external={one.label}: {one.folder}: {error.strerror}") from error
    if not found:
        wanted = (
            " or ".join(map(str, inside))
            or "a folder of the scene, though its name can't be a folder's name,"
        )
        raise ReportError(
            f"external={one.label}: there are no renders of {scene} with variant.seed={draw}: "
            f"{wanted} is expected, with <view>.png for each view that is scored"
        )
    return found[0]


def _figures(folder: Path) -> dict[str, float | None]:
    """Return what is known of the training, by metric."""
    file = folder / FIGURES
    return msgspec.structs.asdict(read_struct(file, Figures) if file.exists() else Figures())


def _expected(store: ReportStore, variant_id: str, split: str) -> dict[str, View]:
    """Return the views of a variant that cells are scored on, by name."""
    frozen = variant.load(store.variant(variant_id))
    return {view.name: view for view in frozen.views if view.split == split}


def _score(folder: Path, view: View, masked: bool) -> dict[str, Any]:
    """Score the render of a view against its photograph."""
    file = folder / f"{view.name}.png"
    wanted = f"expected is an 8-bit RGB PNG of {view.width} x {view.height} px, the render of the"
    try:
        return {"view": view.name} | score_file(file, view, masked=masked)
    except ImageError as error:
        raise ReportError(f"{error}; {wanted} view {view.name}") from error
