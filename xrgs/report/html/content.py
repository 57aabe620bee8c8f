"""What the page is made of, and how values from a store become values of its JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pandas as pd

from xrgs.safeio.sanitize import MAX_CELL, for_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.report.compare import Comparison
    from xrgs.report.joined import JoinedStore

#: What the cells of one row of pictures have in common.
RUN = ["scene", "condition", "variant_seed", "seed"]
LOG_SCALES = (-9.0, 3.0)
"""Natural logarithms of a model's scales that 8 bits cover, in the normalised world. A step is 5%,
and what is smaller is far below a pixel."""


@dataclass
class Content:
    """The parts of the page that its script shows: each list is of plain JSON values."""

    images: list[str] = field(default_factory=list)
    """Data URLs; the other parts name an image by its place here."""
    views: list[dict[str, Any]] = field(default_factory=list)
    """Test views with their scores, and the images where there are any."""
    training: list[dict[str, Any]] = field(default_factory=list)
    """Training views beside renders of them."""
    curves: list[dict[str, Any]] = field(default_factory=list)
    """Quality during training of each cell."""
    history: list[dict[str, Any]] = field(default_factory=list)
    """Gaussians during training of each cell, and what each rule grew and pruned."""
    trade_offs: list[dict[str, Any]] = field(default_factory=list)
    """Gaussians and scores of each label and scene."""
    models: list[dict[str, Any]] = field(default_factory=list)
    """Gaussians to look at in 3D."""
    cameras: list[dict[str, Any]] = field(default_factory=list)
    """The cameras of the models."""
    notes: list[str] = field(default_factory=list)
    """What was left out, and why."""


def shown(text: object) -> str:
    """Return a text from a store as one printable line of bounded length."""
    return for_line(str(text), MAX_CELL)


def why(error: Exception, store: JoinedStore) -> str:
    """Return what an error says, without the paths of the stores.

    Args:
        error: The error.
        store: The stores; the page is the same wherever they are.
    """
    text = str(error)
    for one in store.stores:
        text = text.replace(f"{one.path}/", "")
    return shown(text)


def finite(value: float) -> float | None:
    """Return a number for JSON, rounded to 7 digits; None for NaN and infinity."""
    number = float(value)
    return float(f"{number:.7g}") if math.isfinite(number) else None


def run_names(row: Mapping[str, Any] | pd.Series) -> dict[str, str]:
    """Return the names of a run for the page: scene, condition and replicate.

    Args:
        row: A row with the keys `RUN`.
    """
    return {
        "scene": shown(row["scene"]),
        "condition": shown(row["condition"]),
        "replicate": f"{row['variant_seed']}/{row['seed']}",
    }


def runs(comparison: Comparison) -> Iterator[pd.DataFrame]:
    """Yield the finished cells of each scene, condition and replicate, the base first.

    The first replicates of all scenes and conditions come before the second ones.

    Args:
        comparison: The comparison.

    Yields:
        Rows of `Comparison.cells`, one for each label.
    """
    cells = comparison.cells
    done = cells[cells["state"] == "done"].drop_duplicates([*RUN, "label"])
    order = done["label"] != comparison.base
    done = done.assign(order=order).sort_values("order", kind="stable")
    found = [rows for _, rows in done.groupby(RUN, sort=True)]
    seen: dict[tuple[str, str], int] = {}
    ranks = []
    for rows in found:
        key = (rows["scene"].iloc[0], rows["condition"].iloc[0])
        seen[key] = seen.get(key, -1) + 1
        ranks.append(seen[key])
    for at in sorted(range(len(found)), key=lambda place: (ranks[place], place)):
        yield found[at]
