"""The figures of the paper, and where the page has their counterparts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from xrgs.report.html.content import shown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.report.compare import Comparison
    from xrgs.report.html.content import Content


@dataclass(frozen=True)
class _Figure:
    """A figure of the paper: photograph, baseline and one ablation."""

    name: str
    shows: str
    ablation: str
    """The ablation that it shows, by its name in `conf/ablation/`."""
    scenes: tuple[str, ...]
    """The scene that it shows, and what it may be called here; empty for any."""
    tag: str
    """`LR` or `HR` for a training view; empty for a test view."""


_FIGURES = (
    _Figure(
        "Figure 2",
        "an LR training view, loss weighting and gradient scaling (fern)",
        "loss_gradient",
        ("fern",),
        "LR",
    ),
    _Figure(
        "Figure 3",
        "an HR view, densification and pruning (orchids)",
        "densify",
        ("orchids",),
        "HR",
    ),
    _Figure("Figure 4", "resolution-aware rendering", "render_scale", (), "LR"),
    _Figure(
        "Figure 5",
        "an LR training view, consistency loss (dining room)",
        "consistency",
        ("dining", "dining_room"),
        "LR",
    ),
    _Figure("Figure 6", "a novel view, consistency loss", "consistency", (), ""),
    _Figure(
        "Figure 7",
        "the full method on a cluttered scene (dining room)",
        "xrgs",
        ("dining", "dining_room"),
        "",
    ),
    _Figure(
        "Figure 8",
        "the full method on a single object (keychain)",
        "xrgs",
        ("keychain",),
        "",
    ),
)


@dataclass(frozen=True)
class Counterpart:
    """What the page has for a figure of the paper."""

    name: str
    shows: str
    here: str
    """What the page shows instead, or why it shows nothing."""
    section: str = ""
    """`views` or `training` where the page has it."""
    place: int = 0
    """The entry of that part of the content."""
    label: str = ""
    """The ablation to select there."""


def counterparts(content: Content, comparison: Comparison) -> list[Counterpart]:
    """Find for each figure of the paper what the page shows of it.

    Args:
        content: The finished content of the page.
        comparison: The comparison.
    """
    labels = {shown(label) for label, _ in comparison.groups}
    return [_counterpart(figure, content, labels) for figure in _FIGURES]


def _counterpart(figure: _Figure, content: Content, labels: set[str]) -> Counterpart:
    if figure.ablation not in labels:
        why = f"this sweep has no cell of it: xrgs-sweep +ablation={figure.ablation} trains it"
        return Counterpart(figure.name, figure.shows, why)
    section = "training" if figure.tag else "views"
    entries = content.training if figure.tag else content.views
    fitting = [
        place
        for place, entry in enumerate(entries)
        if entry.get("tag", "") == figure.tag and _has_image(entry, figure.ablation)
    ]
    if not fitting:
        return Counterpart(figure.name, figure.shows, "the page has no picture of it, see below")
    place = _best(entries, fitting, figure)
    found = entries[place]
    here = f"{found['scene']}, view {found['view']}, {figure.ablation}"
    return Counterpart(figure.name, figure.shows, here, section, place, figure.ablation)


def _has_image(entry: dict[str, object], label: str) -> bool:
    arms = entry["arms"]
    return isinstance(arms, list) and any(a["label"] == label and "image" in a for a in arms)


def _best(entries: Sequence[dict[str, object]], fitting: list[int], figure: _Figure) -> int:
    """Return the first entry of the figure's own scene; of any scene where there is none."""
    own = [place for place in fitting if entries[place]["scene"] in figure.scenes]
    return (own or fitting)[0]
