"""The identity of scores, which is the code that has computed them, and new scores of done cells.

A cell's `status.json` keeps the digest of the code of each score and of the protocol that renders
views for them. A new or changed metric makes the scores stale, but not the training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.metrics import METRICS, ON_REQUEST, VIEW_METRICS, also_scored
from xrgs.runtime import lease
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import write_text
from xrgs.safeio.code import CodeFolders, code_digest
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.records import table_text
from xrgs.safeio.refactorings import canonical
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store.cell_folder import SPLATS, CellFolder
from xrgs.store.identity import changed_code
from xrgs.store.store import Store

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


def rescore(
    store: Store, cells: Sequence[CellFolder], also: Sequence[str] = ()
) -> tuple[str, bool]:
    """Score done cells anew where their scores lack a metric, or are of other code.

    Views are rendered from the cell's Gaussians, as after its training, and `scores.csv` and the
    renders are replaced. A cell that is being trained, is not done, has no Gaussians any more, or
    was trained with another rasterizer is left. Scores of `ON_REQUEST` that are named in `also` are
    added; a cell that has one keeps it.

    Return lines for a terminal on the cells that are left, and on how many were scored, and whether
    none is left. XrgsError says that the store can't be written, or that a score is none of
    `ON_REQUEST`.
    """
    if unknown := sorted(set(also) - ON_REQUEST):
        raise XrgsError(f"also={unknown[0]}: choose from: {', '.join(sorted(ON_REQUEST))}")
    added = frozenset(also)
    scored, current, left = 0, 0, list[str]()
    for cell in progress(cells, "scoring", "cell", len(cells)):
        try:
            status = cell.status()
            if status.state != "done":
                raise StoreError(f"it failed: {status.reason}")
            if not stale_scores(status.scored_by, added):
                current += 1
                continue
            with lease.held(store.leases, cell.id) as held:
                if held is None:
                    raise StoreError("a sweep is training it")
                _score(cell, added)
            scored += 1
        except XrgsError as error:
            left.append(f"left: {cell.id}: {error}")
        except OSError as error:
            raise StoreError(f"store={store.path}: {error}") from error
    counts = f"scored {counted(scored, 'cell')} anew"
    lines = [*left, f"{counts}; {counted(current, 'cell')} had the scores of this code already"]
    return "\n".join(map(for_line, lines)), not left


def _score(cell: CellFolder, also: frozenset[str]) -> None:
    from xrgs.evaluation import protocol

    if parts := changed_code(cell.identity()):
        raise StoreError(
            f"it was trained with other code ({', '.join(parts)}), which may render its Gaussians"
            " otherwise: train it again"
        )
    cell.check_not_trimmed(SPLATS)
    if file_digest(cell.path / SPLATS) != cell.status().files[SPLATS].sha256:
        raise StoreError(f"{SPLATS} has changed since the cell finished")
    views, settings = cell.dataset().test, cell.config().splat
    requested = also | on_request(cell.status().scored_by)
    with also_scored(requested):
        rows = protocol.score_views(cell.gaussians(), views, settings, cell.path / "renders")
    # A kill between these two writes leaves scores that differ from the status: the cell is corrupt
    # until it is scored again.
    write_text(cell.path / "scores.csv", table_text(rows))
    renders = [f"renders/{view.name}.png" for view in views]
    cell.rescored(["scores.csv", *renders], scoring_code(requested))
