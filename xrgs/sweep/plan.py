"""The cells of a study: what each is, where it stands, and what is left to do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from xrgs.capture import scenes
from xrgs.experiment.identity import cell_identity
from xrgs.experiment.store import State
from xrgs.runtime.progress import duration
from xrgs.safeio.hashing import digest
from xrgs.safeio.untrusted import printable

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from xrgs.config import Conf
    from xrgs.experiment.store import Store
    from xrgs.sweep.estimate import RuntimeEstimator
    from xrgs.sweep.locks import Owner

BASELINE = "baseline"


@dataclass(frozen=True)
class CellSpec:
    """One combination of the command line's axes."""

    label: str
    """What is compared: the ablation and the component values set by hand."""
    condition: str
    """The other axes' values, beside scene and seed: what label and baseline share."""
    shared: tuple[str, ...]
    """Overrides that the matching baseline has too."""
    changes: tuple[str, ...]
    """Overrides that make it another program than the baseline."""

    @property
    def overrides(self) -> list[str]:
        """All of it, for Hydra to compose."""
        return [*self.shared, *self.changes]


@dataclass(frozen=True)
class Planned:
    """A cell of the study: what it is, and where it stands."""

    wish: CellSpec
    conf: Conf
    variant_id: str | None = None
    cell_id: str | None = None
    state: State = field(default_factory=lambda: State("absent"))
    error: str | None = None
    """Why the cell can't be run: its scene failed, or the cell that it takes a number from."""
    seconds: float | None = None
    """Of training, as cells before it took; None where the store knows none like it."""

    @property
    def name(self) -> str:
        """For people."""
        parts = (scenes.label(self.conf.scene), self.wish.label, self.wish.condition)
        return " / ".join(part for part in parts if part) + f" / seed {self.conf.seed}"

    @property
    def reference(self) -> CellSpec | None:
        """The cell whose number of Gaussians this one is to have."""
        name = self.conf.matched_to
        return replace(self.wish, label=name, changes=(f"+ablation={name}",)) if name else None

    @property
    def waits(self) -> bool:
        """Whether that number is still to come."""
        return self.reference is not None and not self.conf.components.count_matched.gaussians


def identified(cell: Planned, store: Store, held: Mapping[str, Owner | None]) -> Planned:
    """The cell with its identity, if it has one yet, and its state; what is done stays done."""
    if cell.variant_id is None or cell.waits or cell.state.name == "done":
        return cell
    cell_id = cell.cell_id or digest(cell_identity(cell.conf, cell.variant_id))
    state = store.cell(cell_id).state()
    if state.name != "done" and cell_id in held:
        state = store.cell(cell_id).running(held[cell_id])
    return replace(cell, cell_id=cell_id, state=state)


def estimated(plan: Sequence[Planned], past: RuntimeEstimator) -> list[Planned]:
    """The cells with the time that each will take, where past ones tell."""
    if not past.known:
        return list(plan)
    return [
        replace(cell, seconds=past.seconds(cell_identity(cell.conf, cell.variant_id)))
        if cell.variant_id is not None and cell.state.name != "done"
        else cell
        for cell in plan
    ]


def length(cell: Planned) -> tuple[float, int]:
    """What is longest by what is known comes last; of what isn't, the number of steps tells."""
    return (float("inf") if cell.seconds is None else cell.seconds, cell.conf.train.steps)


def ready(
    plan: Sequence[Planned], tried: Container[str], *, retry: bool = False
) -> dict[str, Planned]:
    """The cells that can be run now and are not done, by their identity."""
    left = {"done", "running"} if retry else {"done", "running", "failed"}
    return {
        cell.cell_id: cell
        for cell in plan
        if cell.cell_id is not None
        and cell.cell_id not in tried
        and cell.error is None
        and cell.state.name not in left
    }


def describe(plan: Sequence[Planned]) -> str:
    """The plan as lines: state, identity, time, name, and why where it is not plain."""
    done = sum(cell.state.name == "done" for cell in plan)
    lines = [f"plan: {len(plan)} cells, {done} done{_left(plan)}"]
    for cell in plan:
        state = "failed" if cell.error else "waits" if cell.waits else cell.state.name
        reason = (cell.error or cell.state.reason or "").partition("\n")[0]
        identity = cell.cell_id or ("no count yet" if cell.waits else "variant not built")
        wanted = not cell.error and state != "done"
        time_left = duration(cell.seconds) if wanted else ""
        line = f"  {state:<10} {identity:<18} {time_left:>8}  {cell.name}"
        lines.append(printable(f"{line}  ({reason})" if reason else line))
    failed = any(cell.error or cell.state.name == "failed" for cell in plan)
    if plan[0].conf.retry != "failed" and failed:
        lines.append("failed cells are left as they are: retry=failed runs them again")
    return "\n".join(lines)


def _left(plan: Sequence[Planned]) -> str:
    """How long the training that is left takes, as far as the store's cells tell."""
    retry = plan[0].conf.retry == "failed"
    left = [cell for cell in plan if cell.waits and not cell.error]
    left += ready(plan, (), retry=retry).values()
    known = [cell.seconds for cell in left if cell.seconds is not None]
    if not known:
        return ""
    unknown = len(left) - len(known)
    more = f" and {unknown} cells that no past one tells of" if unknown else ""
    return f"; left to train, one after another: {duration(sum(known))}{more}"


def record(plan: Sequence[Planned]) -> list[dict[str, Any]]:
    """The rows that a report is made from: each cell with its matching baseline's id."""
    baselines = {c.wish.shared: c.cell_id for c in plan if c.wish.label == BASELINE}
    return [
        {
            "cell_id": cell.cell_id,
            "label": cell.wish.label,
            "condition": cell.wish.condition,
            "scene": scenes.label(cell.conf.scene),
            "seed": cell.conf.seed,
            "variant_id": cell.variant_id,
            "baseline_id": baselines[cell.wish.shared],
            "error": cell.error,
        }
        for cell in plan
    ]
