"""All cases, by theme."""

from __future__ import annotations

from collections.abc import Mapping

from tests.hostile import (
    counts,
    links,
    nesting,
    permissions,
    pictures,
    resumed,
    sizes,
    sweeps,
    variants,
    words,
)
from tests.hostile.looks import Maker

THEMES: Mapping[str, Mapping[str, Maker]] = {
    "words": words.CASES,
    "counts": counts.CASES,
    "links": links.CASES,
    "nesting": nesting.CASES,
    "permissions": permissions.CASES,
    "sizes": sizes.CASES,
    "sweeps": sweeps.CASES,
    "pictures": pictures.CASES,
    "variants": variants.CASES,
    "resumed": resumed.CASES,
}
