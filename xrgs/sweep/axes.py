"""Parses the axes of a command line and expands them into cells, each group with its baseline.

Hydra's grammar has functions for axes, such as `range(0.1, 0.4, 0.1)` and `sort(...)`. The ranges
of hydra-core 1.3 have faults: decimal ones add up rounding errors and include the stop that they
should exclude, and sorting changes the values. Ranges here are those of Hydra 1.4.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, Quote, QuotedString
from omegaconf.errors import OmegaConfBaseException

from xrgs.config import GROUPS
from xrgs.errors import XrgsError
from xrgs.store.store import BASELINE


@dataclass(frozen=True)
class CellSpec:
    """One combination of the command line's axes."""

    label: str
    """The ablation, component values that were set by hand, and the reference of a count match."""
    condition: str
    """Values of the other swept axes, equal for a label and its baseline. Scene and replicate (the
    pair of `variant.seed`, which draws the HR views, and `seed`) are not among them."""
    shared: tuple[str, ...]
    """Overrides that the matching baseline has too."""
    changes: tuple[str, ...]
    """Overrides that the baseline lacks; `matched_to` is among them only if the ablation is
    count-matched."""

    @property
    def matched_to(self) -> str | None:
        """The `matched_to` among the changes; None if there is none, or it is null."""
        values = [text.partition("=")[2] for text in self.changes if _name(text) == "matched_to"]
        return values[0] if values and values[0] != "null" else None

    @property
    def without_match(self) -> CellSpec:
        """The combination without `matched_to`; for the baseline, without any change."""
        kept = tuple(text for text in self.changes if _name(text) != "matched_to")
        return replace(self, changes=() if self.label == BASELINE else kept)

    @property
    def overrides(self) -> list[str]:
        """All overrides, for Hydra to compose."""
        return [*self.shared, *self.changes]


def effective(arguments: Sequence[str]) -> list[str]:
    """Return Hydra overrides without the ones that a later override of the same key replaces.

    The axes of a sweep's file come first, and the command line may set some of them again.
    """
    overrides = parsed(arguments)
    last = {override.get_key_element(): override.input_line for override in overrides}
    return [line for line in last.values() if line is not None]


def expand(arguments: Sequence[str], loader: ConfigLoader | None = None) -> list[CellSpec]:
    """Return every combination of the axes, each group with its matching baseline first.

    The arguments are as for `parsed`, for example `+ablation=consistency,loss_weighting seed=0,1`.

    Raises:
        XrgsError: An axis is an interval instead of a list of values, or has no value.
    """
    overrides = parsed(arguments, loader)
    axes = {override.get_key_element(): _values(override) for override in overrides}
    swept = {key for key, values in axes.items() if len(values) > 1}
    specs: dict[CellSpec, None] = {}
    for combination in itertools.product(*axes.values()):
        shared = tuple(text for text in combination if not _is_change(_name(text)))
        changes = tuple(text for text in combination if _is_change(_name(text)))
        of_axes = (text for key, text in zip(axes, combination, strict=True) if key in swept)
        condition = " ".join(text.lstrip("+") for text in of_axes if _is_condition(_name(text)))
        label = _label(changes)
        specs[CellSpec(BASELINE, condition, shared, ())] = None
        spec = CellSpec(label, condition, shared, changes)
        if label != BASELINE or spec.matched_to is not None:
            specs[spec] = None
    return list(specs)


def _values(override: Override) -> list[str]:
    """Return one override for each value of an axis."""
    key = override.get_key_element()
    try:
        if not override.is_sweep_override():
            return [f"{key}={override.get_value_element_as_str()}"]
        if not override.is_discrete_sweep():
            raise XrgsError(f"{override.input_line}: an axis must be a list of values")
        values = list(override.sweep_string_iterator())
    except OmegaConfBaseException as error:  # a function among the values of a list
        raise XrgsError(f"{override.input_line}: an axis is one list, or one function") from error
    if not values:
        raise XrgsError(f"{override.input_line}: this axis has no value")
    return [f"{key}={as_name(value) if _name(key) in GROUPS else value}" for value in values]


def _name(text: str) -> str:
    """Return the key of an override without the signs of Hydra's grammar before it."""
    return text.partition("=")[0].lstrip("+~")


def _is_change(name: str) -> bool:
    """Return whether a key makes a cell another program than its baseline."""
    return name in {"ablation", "matched_to"} or name.startswith("components.")


def _is_condition(name: str) -> bool:
    """Return whether a swept key is part of the condition; tables have columns for the others."""
    group = name.partition(".")[0]
    return not _is_change(name) and group not in {"scene", "seed"} and name != "variant.seed"


def _label(changes: Iterable[str]) -> str:
    """Return overrides as text; `xrgs.sweep.plan.planned` adds the reference of a count match."""
    named = ((_name(text), text.partition("=")[2]) for text in changes)
    parts = [
        value.strip("[]").replace(",", "+").replace(" ", "").replace("'", "")
        if name == "ablation"
        else f"{name.removeprefix('components.')}={value}"
        for name, value in named
        if name != "matched_to"
    ]
    return " ".join(part for part in parts if part) or BASELINE


#: The most values of a range. A range of training steps without a step would have more.
_MOST_VALUES = 10_000


def parsed(arguments: Sequence[str], loader: ConfigLoader | None = None) -> list[Override]:
    """Parse Hydra overrides; `loader` lists the files of a group, for `glob(...)`.

    Raises:
        HydraException: An override is malformed.
    """
    parser = OverridesParser.create(loader)
    functions = parser.functions.functions
    # Hydra's own signatures stay, which check the types of arguments.
    functions["range"] = _range
    return parser.parse_overrides(list(arguments))


def as_name(text: str) -> str:
    """Return the name of a file; in quotes if Hydra would read a number or a bool: `50`, `true`."""
    (override,) = OverridesParser.create().parse_overrides([f"name={text}"])
    if not isinstance(override.value(), bool | int | float | None):
        return text
    return QuotedString(text, Quote.single).with_quotes()


def _range(start: float, stop: float | None = None, step: float = 1) -> ChoiceSweep:
    """Return `start`, `start + step` and so on in decimal arithmetic, without `stop`."""
    if stop is None:
        start, stop = 0, start
    if step == 0:
        raise ValueError("the step of a range must not be 0")
    numbers = (start, stop, step)
    if not all(map(math.isfinite, numbers)):
        raise ValueError("the numbers of a range must be finite")
    if (count := (stop - start) / step) > _MOST_VALUES:
        raise ValueError(f"this range has {count:.0f} values, {_MOST_VALUES} can be: give a step")
    if isinstance(start, int) and isinstance(stop, int) and isinstance(step, int):
        return ChoiceSweep(list=[*range(start, stop, step)])
    first, end, by = (Decimal(str(number)) for number in numbers)
    values = (first + number * by for number in itertools.count())
    inside = itertools.takewhile(lambda value: value < end if by > 0 else value > end, values)
    return ChoiceSweep(list=[*map(float, inside)])
