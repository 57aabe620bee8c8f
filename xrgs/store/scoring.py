"""The identity of scores: the code that has computed them. It is no part of a cell's identity.

A cell's `status.json` keeps the digest of the code of each score and of the protocol that renders
views for them. A new or changed metric makes the scores stale, but not the training.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics import METRICS, ON_REQUEST, VIEW_METRICS
from xrgs.safeio.code import CodeFolders, code_digest
from xrgs.safeio.refactorings import canonical

if TYPE_CHECKING:
    from collections.abc import Mapping

#: The key of the protocol among the digests of scores.
PROTOCOL = "protocol"
#: The file of each score's function, relative to the package.
_FILES = {
    metric.name: f"{metric.score.__module__.removeprefix('xrgs.').replace('.', '/')}.py"
    for metric in METRICS
    if metric.score is not None
}
#: The code that scores. A metric's file counts for its score, with what it imports, and all else
#: for the protocol.
_CODE = CodeFolders(
    folders=("evaluation",),
    whole_parts=(),
    folders_of_parts=("evaluation/lpips", "evaluation/metrics"),
    parts=frozenset(_FILES.values()),
    registries=frozenset({"evaluation/metrics/__init__.py"}),
)


@cache
def scoring_code(also: frozenset[str] = frozenset()) -> dict[str, str]:
    """Return the digest of the protocol and of each score, by name, `also` of some `ON_REQUEST`."""
    names, core = {*VIEW_METRICS, *also}, _CODE.core()
    scores = {n: code_digest(*_CODE.part(file, core)) for n, file in _FILES.items() if n in names}
    return without_refactorings({PROTOCOL: code_digest(*core), **scores})


def without_refactorings(codes: Mapping[str, str]) -> dict[str, str]:
    """Return digests of scores by name, each the oldest that is declared equal to it."""
    return {name: canonical(part_of(name), code) for name, code in codes.items()}


def part_of(score: str) -> str:
    """Return the name of a score, or of the protocol, among the parts of the code."""
    return f"scores/{score}"


def stale_scores(scored_by: Mapping[str, str], also: frozenset[str] = frozenset()) -> list[str]:
    """Return which of a cell's scores the installed code would compute otherwise, or lacks.

    Args:
        scored_by: The digests in the cell's `status.json`.
        also: Scores of `ON_REQUEST` that count as lacking where the cell does not have them.
    """
    installed = scoring_code(also | on_request(scored_by))
    scored_by = without_refactorings(scored_by)
    return [name for name, code in installed.items() if scored_by.get(name) != code]


def on_request(scored_by: Mapping[str, str]) -> frozenset[str]:
    """Return the scores of `ON_REQUEST` that a cell has."""
    return ON_REQUEST & scored_by.keys()
