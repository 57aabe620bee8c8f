"""The identity of scores, apart from that of the training: which code has computed them.

A cell's `status.json` keeps the digest of the code of each score and of the protocol that renders
views for them. A new or changed metric makes scores stale, and never the training.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from xrgs.evaluation.metrics import METRICS
from xrgs.safeio.code import code_digest

if TYPE_CHECKING:
    from collections.abc import Mapping

#: The key of the protocol among the digests of scores.
PROTOCOL = "protocol"


@cache
def scoring_code() -> dict[str, str]:
    """Return the digest of the protocol and of each score, by name."""
    scores = {metric.name: code_digest(*metric.sources) for metric in METRICS if metric.score}
    return {PROTOCOL: code_digest("evaluation/protocol.py"), **scores}


def stale_scores(scored_by: Mapping[str, str]) -> list[str]:
    """Return which of a cell's scores the installed code would compute otherwise, or lacks.

    Args:
        scored_by: The digests in the cell's `status.json`.
    """
    return [name for name, code in scoring_code().items() if scored_by.get(name) != code]
