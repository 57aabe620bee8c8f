"""The folder of one call of `xrgs-sweep`, which the call shares with its jobs.

The folder is in the store, so that jobs on other machines see it. The file `sweep` names the call's
process, and the file `stopped` says why no further job may begin.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from xrgs.runtime import lease
from xrgs.safeio.files import is_transient, read_bytes
from xrgs.safeio.sanitize import for_line

_MAX_REASON = 1 << 12  # bytes of the file `stopped`


@dataclass(frozen=True)
class SweepSession:
    """One call of `xrgs-sweep`; a job knows the call by this folder."""

    folder: Path
    brief: bool = False
    """Whether the jobs print only failures, as for `xrgs-train`."""

    @property
    def exists(self) -> bool:
        """Whether the folder is there and belongs to a call."""
        return (self.folder / "sweep").is_file()

    def stop(self, reason: str) -> None:
        """Let no further job begin; keep the reason, unless an earlier one is there."""
        # A full disk may have room for the file's name and none for the reason in it.
        with suppress(OSError), (self.folder / "stopped").open("xb") as stream:
            stream.write(reason.encode())

    def end(self) -> None:
        """Remove the folder when no job is left, unless a launcher has left its logs in it."""
        files = {self.folder / "sweep", self.folder / "stopped"}
        with suppress(OSError):  # a folder that stays disturbs nobody
            for job_folder in set(self.folder.iterdir()) - files:
                job_folder.rmdir()  # fails where there are logs: then all of the folder stays
            for file in files:
                file.unlink(missing_ok=True)
            self.folder.rmdir()

    @cached_property
    def _owner(self) -> lease.Owner | None:
        return lease.signature(self.folder / "sweep")

    @property
    def owner_dead(self) -> bool:
        """Whether the process of this call has ended; False if it ran on another machine."""
        return self._owner is not None and self._owner.here and not self._owner.lives

    @property
    def stopped(self) -> str:
        """Why no further job may begin; empty while they may."""
        file = self.folder / "stopped"
        try:
            reason = read_bytes(file, _MAX_REASON).decode(errors="replace")
            return for_line(reason) or f"{file} exists"
        except FileNotFoundError:
            if not self.folder.exists():
                return f"{self.folder} is no longer there"
        except OSError as error:
            if not is_transient(error):  # something else has that name
                return f"{file} exists"
        return "the process of the sweep has ended" if self.owner_dead else ""
