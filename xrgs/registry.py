"""The built-in components, by their keys under `components` in the config.

To add a component, write its module in `training/components/`, and add an entry here. This module
imports neither torch nor the components, so that planning stays quick.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

_FOLDER = "training/components"


@dataclass(frozen=True)
class ComponentEntry:
    """Module and class of a component."""

    module: str
    """Module of `xrgs.training.components`."""
    name: str
    """Class in the module."""
    reads: tuple[str, ...] = ()
    """Further groups of `components` that the class reads."""


#: Key -> entry, in the order of the hooks. `loss_weighting` comes after `consistency`, whose loss
#: it multiplies too, and before `regularization`, whose penalties it does not multiply.
BUILT_IN: Mapping[str, ComponentEntry] = {
    "consistency": ComponentEntry("consistency", "Consistency"),
    "loss_weighting": ComponentEntry(
        "weighting",
        "Weighting",
        reads=(
            "continuous_weighting",
            "adaptive_weighting",
            "region_weighting",
            "hybrid_schedule",
        ),
    ),
    "gradient_scaling": ComponentEntry("gradient_scaling", "GradientScaling"),
    "floaters": ComponentEntry("floaters", "Floaters"),
    "densify": ComponentEntry("densify", "Densify"),
    "curriculum": ComponentEntry("curriculum", "Curriculum"),
    "mip": ComponentEntry("mip", "Mip"),
    "render_scale": ComponentEntry("render_scale", "RenderScale"),
    "supersampled": ComponentEntry("supersampled", "Supersampled", reads=("formation",)),
    "resolution_schedule": ComponentEntry("resolution_schedule", "ResolutionSchedule"),
    "natural_selection": ComponentEntry("natural_selection", "NaturalSelection"),
    "exposure": ComponentEntry("exposure", "Exposure"),
    "regularization": ComponentEntry("regularization", "Regularization"),
}


def file_of(key: str) -> str | None:
    """Return the source file of the component for a group of `components` in the config.

    Args:
        key: A key of `BUILT_IN`, or a group that an entry reads. `plugins` and `count_matched` have
            no component here.

    Returns:
        The file's path in the package, such as `training/components/weighting.py`; None if there
        is no component.
    """
    for own_key, entry in BUILT_IN.items():
        if key == own_key or key in entry.reads:
            return f"{_FOLDER}/{entry.module}.py"
    return None


def order_of(keys: Iterable[str]) -> str:
    """Return a text of the classes of the components that are on, in the order of their hooks."""
    on = set(keys)
    entries = (entry for key, entry in BUILT_IN.items() if on & {key, *entry.reads})
    return " ".join(f"{entry.module}:{entry.name}" for entry in entries)
