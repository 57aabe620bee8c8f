"""What the cost of a cell goes by: its settings, its variant, and sizes that multiply the cost.

They are read from the files of a store, which anybody may have written, or from the config of a
cell that is planned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from statistics import fmean
from typing import TYPE_CHECKING, Any

from xrgs.capture import frozen
from xrgs.capture.degrade import resolve_degradation
from xrgs.errors import StoreError
from xrgs.safeio.records import as_number, read_object
from xrgs.safeio.untrusted import is_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from xrgs.config import Conf
    from xrgs.experiment.store import Store

#: Sizes that a cost is proportional to a power of, each in the unit of what it is for a scene of
#: LLFF at `preset=laptop`: pixels of the mean training view, steps, SfM points, training views,
#: threads, test views times their evaluations, and Gaussians at the end.
UNITS = {
    "pixels": 6e4,
    "steps": 3e3,
    "points": 3e3,
    "views": 24.0,
    "threads": 1.0,
    "scored": 3.0,
    "gaussians": 1e5,
}
#: Sizes from this on are none.
_MAX_SIZE = 1e12
#: Width times height of photographs over the square of their longer side: 4 to 3.
_ASPECT = 0.75


@dataclass(frozen=True)
class Features:
    """What the cost of one cell goes by."""

    names: frozenset[str]
    """Names of effects: each setting with its value, all of them together, and the variant."""
    sizes: Mapping[str, float]
    """Logarithms of the sizes over their `UNITS`; what is not known is missing."""
    torch: bool
    """Whether the torch backend renders."""
    most: float = math.inf
    """The most Gaussians that the settings leave at the end."""
    processor: str = ""
    """What trains it, and its instruction set; empty where that is not known."""


def of_identity(
    identity: Mapping[str, Any], threads: object, store: Store, gaussians: object = None
) -> Features:
    """Return the features of a cell whose variant is built.

    Args:
        identity: The cell's identity, of this process or of a store.
        threads: Number of threads that train it.
        store: The store that has its variant.
        gaussians: Number of Gaussians that it has, where it is done.

    Raises:
        KeyError: The identity lacks a value.
        TypeError: A value of it is of another type.
    """
    train, variant = identity["train"], identity["variant"]
    names, torch = (
        _names(identity) | {f"variant={variant}"},
        identity["splat"]["backend"] == "torch",
    )
    found = _variant_sizes(store, str(variant), str(train["views"]))
    sizes = {"steps": train["steps"], "threads": threads, "gaussians": gaussians} | found
    if tests := found.get("tests"):
        sizes["scored"] = tests * evaluations(train["steps"], train.get("evaluate_every", 0))
    return Features(names, _logarithms(sizes), torch, _most(identity, found.get("largest")))


def of_conf(conf: Conf, identity: Mapping[str, Any], threads: int) -> Features | None:
    """Return the features of a cell whose variant is not built, as far as its config tells them.

    Args:
        conf: The cell's config.
        identity: The identity that it will have; its variant is not read.
        threads: Number of threads that train it.

    Returns:
        The features; None if the photographs' own size is kept, which the config does not tell.
    """
    side, hr = conf.variant.long_side, conf.variant.hr_fraction
    if not side:
        return None
    lr_area = conf.variant.factor**-2 if resolve_degradation(conf.variant) == "downsample" else 1.0
    share = {"mixed": hr + (1 - hr) * lr_area, "lr_only": lr_area}.get(conf.train.views, 1.0)
    pixels, train = _ASPECT * side**2, conf.train
    sizes = {"pixels": pixels * share, "steps": train.steps, "threads": threads}
    sizes["scored"] = UNITS["scored"] * evaluations(train.steps, train.evaluate_every)
    names, torch = _names(identity), identity["splat"]["backend"] == "torch"
    most = _most(identity, pixels * (lr_area if train.views == "lr_only" else 1.0))
    return Features(names, _logarithms(sizes), torch, most)


def evaluations(steps: int, every: int) -> int:
    """Return how often a cell scores its test views.

    Args:
        steps: Its steps.
        every: Number of steps after which it does each time; 0 for the end alone.
    """
    return 1 + ((steps - 1) // every if every else 0)


def _most(identity: Mapping[str, Any], largest: object) -> float:
    """Return the most Gaussians that a cell's settings leave at the end.

    Args:
        identity: The cell's identity.
        largest: Number of pixels of its largest training view, which budgets are shares of; None
            where that is not known.
    """
    components = identity["components"]
    limits = [_value(components, "count_matched", "gaussians")]
    if isinstance(largest, (int, float)):
        limits.append(largest * _value(components, "natural_selection", "budget"))
        limits.append(largest * _value(identity["splat"], "densify", "budget"))
    return min((limit for limit in limits if 0 < limit < _MAX_SIZE), default=math.inf)


def _names(identity: Mapping[str, Any]) -> frozenset[str]:
    """Return the names of the effects of a cell's settings, one by one and together."""
    settings = frozenset(_flat({name: identity[name] for name in ("splat", "components")}))
    settings |= {f"views={identity['train']['views']}"}
    return settings | {f"all={hash(settings)}"}


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield each of nested values with its key: `splat.densify.every=500`."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={value!r:.80}"


def _logarithms(sizes: Mapping[str, object]) -> dict[str, float]:
    """Return log(size / unit) of the sizes that are positive numbers."""
    return {
        name: math.log(size / UNITS[name])
        for name, size in sizes.items()
        if name in UNITS and isinstance(size, (int, float)) and 0 < size < _MAX_SIZE
    }


def _value(settings: Mapping[str, Any], part: str, name: str) -> float:
    """Return a number of a part of the settings; 0, which is off, where older code had none."""
    return as_number(settings.get(part, {}).get(name, 0))


@cache
def _variant_sizes(store: Store, variant: str, views: str) -> dict[str, Any]:
    """Return what the files of a frozen variant tell, without verifying them."""
    if not is_name(variant):
        return {}
    folder = store.variants / variant
    try:
        entries = read_object(folder / frozen.MANIFEST)["views"]
        tag = {"hr_only": "HR", "lr_only": "LR"}.get(views)
        splits = ("train", "original") if views == "all_hr" else ("train",)  # originals replace
        pixels = {
            entry["name"]: entry["width"] * entry["height"]
            for split in splits
            for entry in entries
            if entry["split"] == split and tag in (None, entry["tag"])
        }
        points = read_object(folder / frozen.REPORT).get("points")
        return {
            "pixels": fmean(pixels.values()),
            "largest": max(pixels.values()),
            "views": len(pixels),
            "points": points,
            "tests": sum(entry["split"] == "test" for entry in entries),
        }
    except (StoreError, ArithmeticError, KeyError, TypeError, ValueError):
        return {}
