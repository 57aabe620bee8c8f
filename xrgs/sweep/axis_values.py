"""Parses the overrides of a command line, so that each axis has the values that the user means.

Hydra's grammar has functions for axes, such as `range(0.1, 0.4, 0.1)` and `sort(...)`. Those of
hydra-core 1.3 have faults: float ranges add up rounding errors and include the stop that they
should exclude; sorting a range changes its values; and a cast forgets that its values are to be
shuffled. The functions here give the values that Hydra 1.4 gives.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from hydra._internal.grammar import grammar_functions
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Quote, QuotedString

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hydra.core.config_loader import ConfigLoader
    from hydra.core.override_parser.types import Override

#: The most values of a range. A range of training steps without a step would have more.
_MOST_VALUES = 10_000
_CASTS = ("int", "float", "str", "bool")


def parsed(arguments: Sequence[str], loader: ConfigLoader | None = None) -> list[Override]:
    """Parse the overrides of a command line; axes have the values that the user means.

    Args:
        arguments: Hydra overrides.
        loader: Lists the files of a group, for `glob(...)`.

    Raises:
        HydraException: An override is malformed.
    """
    parser = OverridesParser.create(loader)
    functions = parser.functions.functions
    # Hydra's own signatures stay, which check the types of arguments.
    functions |= {"range": _range, "sort": _sort}
    functions |= {name: _kept_shuffled(functions[name]) for name in _CASTS}
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
    return ChoiceSweep(list=[*map(float, _steps(*(Decimal(str(number)) for number in numbers)))])


def _steps(start: Decimal, stop: Decimal, step: Decimal) -> Iterator[Decimal]:
    for number in itertools.count():
        value = start + number * step
        if (value >= stop) if step > 0 else (value <= stop):
            return
        yield value


def _sort(*values: Any, reverse: bool = False, **named: Any) -> Any:
    """Sort as Hydra does; a sorted axis is no longer shuffled."""
    result = grammar_functions.sort(*values, reverse=reverse, **named)
    return replace(result, shuffle=False) if isinstance(result, ChoiceSweep) else result


def _kept_shuffled(cast: Callable[..., Any]) -> Callable[..., Any]:
    """Return a cast of Hydra that keeps whether the values of an axis are to be shuffled."""

    def cast_values(*values: Any, **named: Any) -> Any:
        result = cast(*values, **named)
        axis = values[0] if values else named.get("value")
        if isinstance(axis, ChoiceSweep):
            result = replace(result, shuffle=axis.shuffle, tags=copy(axis.tags))
        return result

    return cast_values
