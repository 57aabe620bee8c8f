"""The files of cells as pandas tables and Python objects: what `Store` and `CellFolder` hand out.

The files are read as untrusted: nothing in them is run, and no name in them leads out of the store.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd

from xrgs.errors import StoreError
from xrgs.evaluation.metrics import METRICS
from xrgs.safeio.confined import ConfinedPath
from xrgs.safeio.records import MAX_BYTES, as_number, read_object
from xrgs.safeio.untrusted import is_name
from xrgs.safeio.words import for_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from xrgs.capture.dataset import Dataset
    from xrgs.capture.views import Variant

#: What a sweep's record names a cell by.
CELL_NAMES = ("scene", "label", "condition")
#: Groups of a cell's config that become columns; the others do not change a number.
_CONFIG_GROUPS = ("scene", "variant", "splat", "train", "components")
#: The largest config that becomes columns, in bytes: ten times what ours has.
_MAX_CONFIG_BYTES = 1 << 16


def cells_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of `Store.cells`.

    Args:
        rows: One mapping a cell: the values of `cell_columns`, with `state` and `reason`.

    Returns:
        The cells sorted by scene, label, condition, seed and id, with the config's columns last.
    """
    rows = list(rows)
    metrics = [metric.name for metric in METRICS]
    leading = ["cell_id", *CELL_NAMES, "seed", "variant", "state", "reason", *metrics]
    config = dict.fromkeys(key for row in rows for key in row if key not in leading)
    table = pd.DataFrame(rows, columns=[*leading, *config])
    table[metrics] = table[metrics].astype("float64")
    table["seed"] = table["seed"].astype("Int64")
    return table.sort_values([*CELL_NAMES, "seed", "cell_id"], ignore_index=True)


def cell_columns(folder: ConfinedPath, names: Mapping[str, str]) -> dict[str, Any]:
    """Return what a cell's `identity.json` and `config.json` say of it, as columns of a table.

    Args:
        folder: The cell's folder; a file that is missing in it gives no columns.
        names: Scene, label and condition in the record of a sweep; empty where there is none.
    """
    identity = _object(folder / "identity.json")
    config = _object(folder / "config.json", _MAX_CONFIG_BYTES)
    seed, variant = identity.get("seed"), identity.get("variant")
    settings = dict(_flat({name: config.get(name) for name in _CONFIG_GROUPS}))
    scene = settings.get("scene.name")
    return {
        **{key: value for key, value in settings.items() if "." in key},
        "cell_id": folder.name,
        "scene": names.get("scene") or (scene if isinstance(scene, str) else None),
        "label": names.get("label"),
        "condition": names.get("condition"),
        "seed": seed if type(seed) is int and abs(seed) < 1 << 63 else None,
        "variant": variant if is_name(variant) else None,
    }


def _object(file: ConfinedPath, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Read a JSON file of values under names; empty where it can't be read."""
    try:
        return read_object(file, max_bytes)
    except StoreError:
        return {}


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield nested values under dotted names, as `train.steps`."""
    for name, value in values.items():
        key = for_line(f"{prefix}{name}")
        if isinstance(value, dict):
            yield from _flat(value, f"{key}.")
        else:
            yield key, for_line(value) if isinstance(value, str) else value


def cell_metrics(summary: Mapping[str, Any], scores: pd.DataFrame) -> dict[str, float]:
    """Return the metrics of a finished cell, by name.

    Args:
        summary: The numbers of the whole cell, as `CellFolder.summary` returns them.
        scores: The scores of its test views, as `CellFolder.scores` returns them.

    Returns:
        Numbers of the whole cell, and the means of scores over the test views; a score that one
        view lacks has no mean (NaN).

    Raises:
        ValueError: A value of the summary is not a number.
    """
    means = scores.mean(skipna=False)
    whole = {m.name: as_number(summary[m.name]) for m in METRICS if m.name in summary}
    return whole | {m.name: float(means[m.name]) for m in METRICS if m.name in means}


def load_dataset(folder: ConfinedPath) -> Dataset:
    """Load what a cell was trained and scored on; see `CellFolder.dataset`.

    Args:
        folder: The cell's folder, `<store>/cells/<id>`.

    Raises:
        StoreError: `identity.json` can't be read, or has no variant, views or seed.
        XrgsError: The variant is not in the store, or is damaged.
    """
    from xrgs.capture import dataset

    identity = read_object(folder / "identity.json")
    train = identity.get("train")
    views = train.get("views") if isinstance(train, dict) else None
    if not isinstance(views, str):
        raise StoreError(f"{folder / 'identity.json'}: it names no train.views")
    validation, seed = validation_share(identity), identity.get("seed")
    if validation is None or type(seed) is not int or seed < 0:
        raise StoreError(f"{folder / 'identity.json'}: train.validation or seed is not a number")
    return dataset.load(load_variant(folder), views, validation=validation, seed=seed)


def load_variant(folder: ConfinedPath) -> Variant:
    """Load the variant that a cell was trained on.

    Args:
        folder: The cell's folder, `<store>/cells/<id>`.

    Raises:
        StoreError: `identity.json` can't be read, or names no variant.
        XrgsError: The variant is not in the store, or is damaged.
    """
    from xrgs.capture import variant
    from xrgs.experiment.trimming import check_images

    variant_id = read_object(folder / "identity.json").get("variant")
    if not isinstance(variant_id, str) or not is_name(variant_id):
        raise StoreError(f"{folder / 'identity.json'}: it names no variant")
    variants = ConfinedPath(folder.path.parents[1]) / "variants"
    check_images(variants, variant_id)
    return variant.load(variants / variant_id)


def validation_share(identity: Mapping[str, Any]) -> float | None:
    """Return the `train.validation` of a cell, which decides which views its scores are of.

    Args:
        identity: What the cell's `identity.json` holds.

    Returns:
        The share of the HR training views that were held out and scored, in [0, 1). 0 stands for
        the test views: cells from before the key have no other. None where it is no such number.
    """
    train = identity.get("train")
    share = train.get("validation", 0.0) if isinstance(train, dict) else 0.0
    number = type(share) in {int, float} and 0 <= share < 1
    return float(share) if number else None
