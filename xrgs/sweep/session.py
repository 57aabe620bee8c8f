"""The folder of one call of `xrgs-sweep`, through which the plan hands its cells over to jobs.

The folder is in the store, so that jobs on other machines see it. It holds `sweep` (which process
the call is), `stopped` (why no further job may begin) and `cells/<cell id>.json` (what the plan
knows of a cell that it launches). A job is given the folder and a cell's id, and reads the rest.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.identity import changed_code
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json
from xrgs.safeio.confined import ConfinedPath, RootMissingError, is_passing
from xrgs.safeio.hashing import canonical_json, digest
from xrgs.safeio.records import read_object
from xrgs.safeio.words import for_line
from xrgs.splat.backend import arithmetic, resolve_backend
from xrgs.sweep import locks

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

#: Files are named in a message up to this many.
_MAX_NAMED = 3
_MAX_REASON = 1 << 12  # bytes of the file `stopped`


@dataclass(frozen=True)
class HandOver:
    """What the plan hands over to the job of one cell."""

    name: str
    """The cell's name for people: scene, label, condition and seed."""
    config: Mapping[str, Any]
    """The cell's config as plain JSON values, its paths absolute and its backend chosen."""
    identity: Mapping[str, Any]
    """The values that the cell's id is the digest of."""
    dead_locks: tuple[str, ...] = ()
    """Locks of the cell whose owners the plan has watched long enough, see `locks.confirmed`."""

    @property
    def cell_id(self) -> str:
        """The cell's id."""
        return digest(self.identity)

    @property
    def variant_id(self) -> str:
        """The id of the frozen variant that the cell trains on."""
        return str(self.identity["variant"])

    def check_code(self) -> None:
        """Refuse to train with other code or other arithmetic than the cell was planned with.

        Raises:
            XrgsError: The planned backend is not available here, source files of the installed
                package differ from the planned ones, or this machine's arithmetic does.
        """
        backend = resolve_backend(self.identity["splat"]["backend"])
        files = changed_code(self.identity["code"], backend)
        if files:
            named = ", ".join(files[:_MAX_NAMED]) + (", ..." if files[_MAX_NAMED:] else "")
            raise XrgsError(
                f"{self.name}: cell {self.cell_id} was planned with other code than is installed "
                f"here and now; {len(files)} files differ ({named}). Install the same version of "
                "xrgs wherever cells are trained, and start the sweep again"
            )
        planned, here = self.identity.get("arithmetic"), arithmetic(backend)
        if planned != here:
            raise XrgsError(
                f"{self.name}: cell {self.cell_id} was planned with the arithmetic {planned}, and"
                f" this machine has {here}, which gives other last digits. Start the sweep on a"
                " machine like those that train, or set splat.backend=torch"
            )


@dataclass(frozen=True)
class SweepSession:
    """One call of `xrgs-sweep`, known to its jobs by a folder of its own."""

    folder: ConfinedPath
    """The folder. It is a root of its own: a job does not create it again when it vanishes."""

    def __init__(self, folder: Path) -> None:
        object.__setattr__(self, "folder", ConfinedPath(folder))

    @property
    def exists(self) -> bool:
        """Whether the folder is there, and is that of a call.

        Raises:
            OSError: It can't be told now.
        """
        try:
            return (self.folder / "sweep").is_file()
        except RootMissingError:
            return False

    def begin(self) -> None:
        """Write which process this call is.

        Raises:
            OSError: The folder can't be written, or belongs to another call.
        """
        locks.sign(self.folder / "sweep")
        (self.folder / "cells").make_folder(exclusive=True)

    def hand_over(self, cell: HandOver) -> str:
        """Write what a job needs to know of a cell.

        Args:
            cell: The config, the identity and the name of the cell.

        Returns:
            The cell's id, with which `read` finds it.

        Raises:
            OSError: The folder can't be written.
        """
        cell_id = cell.cell_id
        # Not durable: when the power goes, this call and its jobs are over.
        write_json(self._file(cell_id), asdict(cell), durable=False)
        return cell_id

    def read(self, cell_id: str) -> HandOver:
        """Read what the plan has written for a cell.

        Args:
            cell_id: The cell's id.

        Raises:
            XrgsError: The file is missing or malformed, its identity is not the cell's, or its
                config contradicts its identity.
        """
        if not untrusted.is_name(cell_id):
            raise XrgsError(f"{cell_id!r:.80} is not the id of a cell")
        file = self._file(cell_id)
        try:
            content = read_object(file)
        except StoreError as error:
            where = "hydra.sweep.dir must be a folder that every machine of the sweep can read"
            raise XrgsError(f"{error} ({where})") from error
        try:
            dead = tuple(content["dead_locks"])
            cell = HandOver(content["name"], content["config"], content["identity"], dead)
            wrong = _contradiction(cell, cell_id)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise XrgsError(f"{file} is not what a plan writes for a job ({error!r})") from error
        if wrong:
            raise XrgsError(f"{file} is not what the plan of this sweep has written: {wrong}")
        return cell

    def _file(self, cell_id: str) -> ConfinedPath:
        return self.folder / "cells" / f"{cell_id}.json"

    def stop(self, reason: str) -> None:
        """Let no further job begin; of several reasons the first is kept.

        Args:
            reason: Why, for people.
        """
        # A full disk may have room for the file's name and none for the reason in it.
        with suppress(OSError), (self.folder / "stopped").create() as stream:
            stream.write(reason.encode())

    @cached_property
    def _owner(self) -> locks.Owner | None:
        return locks.signature(self.folder / "sweep")

    @property
    def owner_dead(self) -> bool:
        """Whether the process of this call has ended; False on machines that can't know."""
        return self._owner is not None and self._owner.here and not self._owner.lives

    @property
    def missing(self) -> bool:
        """Whether the folder is not there: it vanished with its store, or was never shared."""
        try:
            return not self.folder.is_dir()
        except OSError:
            return False

    @property
    def stopped(self) -> str:
        """Why no further job may begin; empty while they may."""
        file = self.folder / "stopped"
        try:
            reason = file.read_bytes(_MAX_REASON).decode(errors="replace")
            return for_line(reason) or f"{file} exists"
        except RootMissingError:
            return f"{self.folder} is no longer there"
        except FileNotFoundError:
            pass
        except OSError as error:
            if not is_passing(error):  # something else has that name
                return f"{file} exists"
        return "the process of the sweep has ended" if self.owner_dead else ""


def _contradiction(cell: HandOver, cell_id: str) -> str:
    """Return what is inconsistent in a hand-over that was read; empty if nothing is."""
    config, identity = cell.config, cell.identity
    rules = {
        f"its identity has the digest {cell.cell_id}": cell.cell_id == cell_id,
        "the id of its variant is not a name": untrusted.is_name(identity["variant"]),
        "its code is not a list of digests": all(
            isinstance(text, str) for text in identity["code"].values()
        ),
        "its name or the path of its store is not text": isinstance(cell.name, str)
        and isinstance(config["store"], str),
        "its dead locks are not text": all(isinstance(text, str) for text in cell.dead_locks),
        "fail_fast is neither true nor false": isinstance(config["fail_fast"], bool),
        "a limit is not a number": all(
            type(config["limits"][name]) in {int, float} for name in ("minutes", "memory_gb")
        ),
    } | {
        f"{key} differs between its config and its identity": canonical_json(config[key])
        == canonical_json(identity[key])
        for key in ("splat", "train", "components", "seed")
    }
    return next((problem for problem, holds in rules.items() if not holds), "")
