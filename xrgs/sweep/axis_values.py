"""Parses the overrides of a command line, so that each axis has the values that the user means.

Hydra's grammar has functions for axes, such as `range(0.1, 0.4, 0.1)` and `sort(...)`. The ranges
of hydra-core 1.3 have faults: decimal ones add up rounding errors and include the stop that they
should exclude, and sorting changes the values. Ranges here are those of Hydra 1.4.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from decimal import Decimal
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Quote, QuotedString

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hydra.core.config_loader import ConfigLoader
    from hydra.core.override_parser.types import Override

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
    return ChoiceSweep(list=[*map(float, _steps(*(Decimal(str(number)) for number in numbers)))])


def _steps(start: Decimal, stop: Decimal, step: Decimal) -> Iterator[Decimal]:
    for number in itertools.count():
        value = start + number * step
        if (value >= stop) if step > 0 else (value <= stop):
            return
        yield value
