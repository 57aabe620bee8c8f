"""The components of xrgs, by the keys of `components` in the config.

To add a component, write its module in `components/` and add its entry here. This module imports
neither torch nor the components, so that planning can read it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

_FOLDER = "training/components"


@dataclass(frozen=True)
class ComponentEntry:
    """Where a component is."""

    module: str
    """Module of `xrgs.training.components`."""
    name: str
    """Class in that module."""
    reads: tuple[str, ...] = ()
    """Further keys of `components` that the class reads."""


#: In the order in which hooks run. The weights of views come after `consistency`, since they
#: multiply its loss as well, and before `regularization`, whose penalties have no weight of a view.
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
    """Return the source file of the component that a key of `components` switches on.

    Args:
        key: A key of `BUILT_IN`, or one that an entry reads. `plugins` and `count_matched` have no
            component here.

    Returns:
        Its path in the package, such as `training/components/weighting.py`; None without one.
    """
    for own_key, entry in BUILT_IN.items():
        if key == own_key or key in entry.reads:
            return f"{_FOLDER}/{entry.module}.py"
    return None


def order_of(keys: Iterable[str]) -> str:
    """Return the classes of the components that are on, in the order in which their hooks run."""
    on = set(keys)
    entries = (entry for key, entry in BUILT_IN.items() if on & {key, *entry.reads})
    return " ".join(f"{entry.module}:{entry.name}" for entry in entries)
