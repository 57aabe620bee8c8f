"""Reads the overrides of a command line, with the values that an axis names.

Hydra's grammar has functions for axes, such as `range(0.1, 0.4, 0.1)` and `sort(...)`. Those of
hydra-core 1.3 give other values than are written: float ranges add up the errors of binary
fractions, and take in the end that they exclude; sorting a range moves its values; and a cast
forgets that its values are shuffled. The functions here give what Hydra 1.4 gives.
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

#: The most values of a range; without its step, a range of training steps has many more.
_MOST_VALUES = 10_000
_CASTS = ("int", "float", "str", "bool")


def parsed(arguments: Sequence[str], loader: ConfigLoader | None = None) -> list[Override]:
    """Return the overrides of a command line, whose axes have the values that are written.

    Args:
        arguments: Hydra overrides.
        loader: Lists the files of a group, for `glob(...)`.

    Raises:
        HydraException: An override is malformed.
    """
    parser = OverridesParser.create(loader)
    known = parser.functions.functions
    # Under Hydra's signatures, which check the types of arguments.
    known |= {"range": _range, "sort": _sort}
    known |= {name: _kept_shuffled(known[name]) for name in _CASTS}
    return parser.parse_overrides(list(arguments))


def as_name(text: str) -> str:
    """Return the name of a file, in quotes if Hydra reads no text from it: `50`, `1e3`, `true`."""
    (override,) = OverridesParser.create().parse_overrides([f"name={text}"])
    if not isinstance(override.value(), bool | int | float | None):
        return text
    return QuotedString(text, Quote.single).with_quotes()


def _range(start: float, stop: float | None = None, step: float = 1) -> ChoiceSweep:
    """Return `start`, `start + step` and so on as they are written, without `stop`."""
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
    """Sort as Hydra does; what is sorted is not shuffled any more."""
    found = grammar_functions.sort(*values, reverse=reverse, **named)
    return replace(found, shuffle=False) if isinstance(found, ChoiceSweep) else found


def _kept_shuffled(cast: Callable[..., Any]) -> Callable[..., Any]:
    def cast_values(*values: Any, **named: Any) -> Any:
        found = cast(*values, **named)
        given = values[0] if values else named.get("value")
        if isinstance(given, ChoiceSweep):
            found = replace(found, shuffle=given.shuffle, tags=copy(given.tags))
        return found

    return cast_values
