"""One cell's folder in a store: its files, its state, and its results.

A cell's `status.json` is written last, by atomic rename, and lists every other file of the cell: a
cell is done when that file says so and the listed files are present and unchanged.
"""

from __future__ import annotations

import stat
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xrgs.errors import StoreError, UnreadableError
from xrgs.runtime import progress
from xrgs.safeio import untrusted
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.confined import confined, is_passing
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.records import MAX_BYTES, as_number, read_object, read_table
from xrgs.safeio.words import for_terminal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import pandas as pd

    from xrgs.capture.dataset import Dataset
    from xrgs.config import Conf
    from xrgs.safeio.confined import ConfinedPath
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians

#: Reports are made from these files, so they are verified by their hash; others by their size.
_VERIFIED_BY_HASH = frozenset(
    {"config.json", "identity.json", "scores.csv", "summary.json", "history.csv", "quality.csv"}
)
#: Name of the training checkpoint, which is there while the cell is not done.
CHECKPOINT = "checkpoint.npz"
_PROGRESS = "progress.json"
_NOT_RESULTS = frozenset({"log.txt", "status.json", _PROGRESS, CHECKPOINT, f"refused-{CHECKPOINT}"})
#: Files of a done cell that only pictures, viewers and `rerun=` need: most of a store's bytes.
_HEAVY, _HEAVY_FOLDER = frozenset({"splats.ply"}), "renders"


@dataclass(frozen=True)
class CellState:
    """The state of a cell, and the reason for it."""

    name: str
    """`absent`, `unfinished`, `running`, `failed`, `corrupt` or `done`; `unknown` where a file can
    not be read now, so that nothing may be done with the cell but to look again."""
    reason: str = ""

    @classmethod
    def of_error(cls, error: Exception) -> CellState:
        """Return the state of a cell whose files can't be read, or are not what they should be.

        Args:
            error: What was raised when they were read.
        """
        if isinstance(error, UnreadableError):
            return cls("unknown", f"it can't be read now: {error}")
        if isinstance(error, OSError):
            kind = "unknown" if is_passing(error) else "corrupt"
            return cls(kind, f"{error.filename}: {error.strerror}")
        if isinstance(error, StoreError):
            return cls("corrupt", str(error))
        return cls("corrupt", f"a file is malformed: {error!r}")


#: What reading the files of a cell may raise, whatever is in them.
READING_ERRORS = (StoreError, OSError, AttributeError, KeyError, TypeError, ValueError)


@dataclass(frozen=True)
class CellFolder:
    """The folder of one cell: its config, its results and its state."""

    folder: ConfinedPath
    """The folder, named by the cell's id."""

    def __init__(self, folder: Path | ConfinedPath) -> None:
        object.__setattr__(self, "folder", confined(folder))

    @property
    def path(self) -> Path:
        """The folder's path. What is in the folder may come from anybody: `folder` opens it."""
        return self.folder.path

    @property
    def id(self) -> str:
        """The cell's id: the digest of its identity."""
        return self.folder.name

    @property
    def checkpoint(self) -> ConfinedPath:
        """File of the training checkpoint; it exists while the cell is not done."""
        return self.folder / CHECKPOINT

    @property
    def progress(self) -> ConfinedPath:
        """File that says how far the cell is; a process that is killed leaves it behind."""
        return self.folder / _PROGRESS

    @property
    def status(self) -> ConfinedPath:
        """File of the final state, written after all other files."""
        return self.folder / "status.json"

    def state(self, *, verify: bool = True) -> CellState:
        """Return whether this cell's result is present and can be trusted.

        Args:
            verify: Hash the files that reports are made from; otherwise only sizes are compared.
        """
        try:
            return self._look(verify=verify)
        except READING_ERRORS as error:
            return CellState.of_error(error)

    def _look(self, *, verify: bool) -> CellState:
        try:
            status = read_object(self.status)
        except StoreError:
            if (state := self._without_status()) is None:
                raise
            return state
        try:
            if status["state"] == "failed":
                return CellState("failed", str(status["reason"]))
            self._check(status, verify=verify)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise StoreError(f"{self.status}: it is malformed ({error!r})") from error
        return CellState("done")

    def _without_status(self) -> CellState | None:
        """Return the state of a cell that has no status; None where it has one."""
        found = self.folder.look()
        if found is not None and stat.S_ISLNK(found.st_mode):
            return CellState("corrupt", "it is a symbolic link; a cell must be a folder")
        if found is None:
            return CellState("absent")
        if not stat.S_ISDIR(found.st_mode):
            return CellState("corrupt", "it is not a folder")
        if self.status.exists():
            return None
        resumes = "; it resumes from its checkpoint" if self.checkpoint.exists() else ""
        return CellState("unfinished", f"it was stopped before it ended{resumes}")

    def running(self, owner: str) -> CellState:
        """Return the state of a cell whose lock is held.

        Args:
            owner: Description of the process that holds the lock.
        """
        now = progress.read(self.progress)
        return CellState("running", f"by {owner}" + (f": {now}" if now else ""))

    def _check(self, status: Mapping[str, Any], *, verify: bool) -> None:
        if status["state"] != "done":
            raise StoreError(f"status.json: unknown state {status['state']!r}")
        files = status["files"]
        for name in files:
            if not untrusted.is_inside(name):
                raise StoreError(f"status.json: {name!r:.80} is not a file of this cell")
        sizes = self.folder.sizes(list(files))
        for name, entry in files.items():
            if sizes[name] != entry["bytes"]:
                raise StoreError(f"{name} is missing or has another size")
            is_read = name in _VERIFIED_BY_HASH
            if is_read and sizes[name] > MAX_BYTES:
                raise StoreError(f"{name} has {sizes[name]} bytes, at most {MAX_BYTES} are read")
            if is_read and verify and file_digest(self.folder / name) != entry["sha256"]:
                raise StoreError(f"{name} has changed since the cell finished")
        if verify and [view for view, _ in self.view_scores()] != status["views"]:
            raise StoreError("scores.csv does not have one row for each view that was to be scored")

    def verify(self) -> list[str]:
        """Hash every file of a finished cell.

        Returns:
            A line for each file that is missing, has changed, can't be read now or does not belong
            there; empty for an intact cell.
        """
        try:
            files = read_object(self.status)["files"]
            wrong = [why for name, entry in files.items() if (why := self._wrong(name, entry))]
            listed = files.keys() | self.trimmed().keys() | _NOT_RESULTS
            wrong += [
                f"{self.folder}/{name}: it does not belong there"
                for name, _ in self.folder.walk()
                if name not in listed
            ]
        except READING_ERRORS as error:
            return [f"{self.status}: {CellState.of_error(error).reason}"]
        return wrong

    def _wrong(self, name: str, entry: Mapping[str, Any]) -> str:
        """Return what is wrong with one of the cell's files; empty where nothing is."""
        try:
            intact = file_digest(self.folder / name) == entry["sha256"]
        except OSError as error:
            again = "; try again" if is_passing(error) else ""
            return f"{self.folder}/{name}: {error.strerror}{again}"
        return "" if intact else f"{self.folder}/{name}: it has changed since the cell finished"

    def view_scores(self) -> list[tuple[str, dict[str, float]]]:
        """Return the name and the scores of every test view, NaN where a score is missing.

        Raises:
            StoreError: `scores.csv` is missing or malformed.
        """
        file = self.folder / "scores.csv"
        header, rows = read_table(file)
        views = [row[0] for row in rows]
        if header[:1] != ["view"] or not all(map(untrusted.is_name, views)):
            raise StoreError(f"{file}: the first column must hold names of views")
        if len(set(views)) < len(views):
            raise StoreError(f"{file}: a view has two rows")
        try:
            values = [map(as_number, row[1:]) for row in rows]
            scores = [dict(zip(header[1:], row, strict=True)) for row in values]
        except ValueError as error:
            raise StoreError(f"{file}: {error}") from error
        return list(zip(views, scores, strict=True))

    def finish(self, views: Sequence[str], protocol: int) -> None:
        """Declare the cell done, with the files that are in the folder now.

        All of them are on the disk before the cell says that it is done.

        Args:
            views: Names of the test views, in the order of `scores.csv`.
            protocol: Version of the evaluation protocol.
        """
        self.folder.sync_tree()
        files = {
            name: {"bytes": status.st_size, "sha256": file_digest(self.folder / name)}
            for name, status in sorted(self.folder.walk())
            if name not in _NOT_RESULTS
        }
        self._set_status(
            {
                "state": "done",
                "reason": "",
                "views": list(views),
                "protocol": protocol,
                "files": files,
            }
        )
        self.drop_checkpoint()  # after the status: a cell that is killed before needs it

    def drop_checkpoint(self) -> None:
        """Remove the checkpoint, which a finished cell no longer needs.

        `finish` does this too, but its process may be killed in between.
        """
        self.checkpoint.unlink(missing_ok=True)

    def trimmed(self) -> dict[str, dict[str, Any]]:
        """Return the files that were removed on purpose: `bytes` and `sha256` by their names.

        Empty for a cell that was not trimmed, and where its status can't be read.
        """
        try:
            found = read_object(self.status).get("trimmed", {})
        except StoreError:
            return {}
        return found if isinstance(found, dict) else {}

    def check_not_trimmed(self, name: str) -> None:
        """Refuse a file that was removed on purpose.

        Args:
            name: The file's path in the cell's folder, with `/`.

        Raises:
            StoreError: It was; the message says how to make it again.
        """
        if name in self.trimmed():
            raise StoreError(
                f"cells/{self.id}/{name} was removed by xrgs-store trim; xrgs-sweep rerun= trains"
                " the cell again, in a folder of its own"
            )

    def heavy_bytes(self) -> int:
        """Return the bytes that `trim` would free: those of the Gaussians and the renders."""
        return sum(
            status.st_size
            for name, status in self.folder.walk()
            if stat.S_ISREG(status.st_mode) and _is_heavy(name)
        )

    def trimmed_status(self) -> dict[str, Any]:
        """Return what the status of a done cell is once it is trimmed.

        Raises:
            StoreError: The status can't be read, or is not that of a done cell.
        """
        status = read_object(self.status)
        if status.get("state") != "done" or not isinstance(status.get("files"), dict):
            raise StoreError(f"{self.status}: the cell is not done")
        heavy = {name: entry for name, entry in status["files"].items() if _is_heavy(name)}
        if not heavy:
            return status
        kept = {name: of for name, of in status["files"].items() if name not in heavy}
        return status | {"files": kept, "trimmed": self.trimmed() | heavy}

    def trim(self) -> None:
        """Remove the Gaussians and the renders of a done cell, and list them in its status.

        The caller holds the cell's lock. The status is written first: a cell that is killed in
        between is done, and the next call removes the rest.

        Raises:
            StoreError: The status can't be read, or is not that of a done cell.
            OSError: A file can't be removed.
        """
        self._set_status(self.trimmed_status())
        for name in self.trimmed():
            if untrusted.is_inside(name):
                (self.folder / name).unlink(missing_ok=True)
        renders = self.folder / _HEAVY_FOLDER
        if renders.is_dir() and not renders.names():
            renders.remove()

    def fail(self, reason: str) -> None:
        """Declare the cell failed, and write `error.txt` if its process did not.

        Args:
            reason: Why it failed, for the status and for people.
        """
        error = self.folder / "error.txt"
        if not error.exists():
            write_text(error, for_terminal(f"{reason}\n"))
        self.progress.unlink(missing_ok=True)
        self._set_status({"state": "failed", "reason": reason, "views": [], "files": {}})

    def _set_status(self, status: Mapping[str, Any]) -> None:
        write_json(self.status, status)

    def identity(self) -> dict[str, Any]:
        """Return the values that the cell's id is the digest of.

        Raises:
            StoreError: `identity.json` is missing or malformed.
        """
        return read_object(self.folder / "identity.json")

    def summary(self) -> dict[str, Any]:
        """Return the figures of the whole cell: training time, Gaussians, memory and others.

        Raises:
            StoreError: `summary.json` is missing or malformed.
        """
        return read_object(self.folder / "summary.json")

    def provenance(self) -> dict[str, Any]:
        """Return where, when and with which software the cell was trained.

        Raises:
            StoreError: `provenance.json` is missing or malformed.
        """
        return read_object(self.folder / "provenance.json")

    def history(self) -> pd.DataFrame:
        """Return the training history, one row per logged step; `view` is text, all else numbers.

        Raises:
            StoreError: `history.csv` can't be read, or is not such a table.
        """
        import pandas as pd

        file = self.folder / "history.csv"
        header, rows = read_table(file)
        table = pd.DataFrame(rows, columns=header, dtype=object)
        try:
            for name in header:
                if name != "view":
                    table[name] = pd.to_numeric(table[name].map(as_number), downcast="integer")
        except ValueError as error:
            raise StoreError(f"{file}: {name}: {error}") from error
        return table

    def scores(self) -> pd.DataFrame:
        """Return the scores of the test views.

        Returns:
            One row a view, indexed by its name (`view`), one column a score (`psnr` in dB, `ssim`,
            `lpips`); NaN where a score was not computed.

        Raises:
            StoreError: `scores.csv` is missing or is not such a table.
        """
        import pandas as pd

        scores = self.view_scores()
        index = pd.Index([name for name, _ in scores], name="view", dtype=object)
        return pd.DataFrame([values for _, values in scores], index=index)

    def config(self) -> Conf:
        """Return the config that the cell was trained with.

        Keys that were added since have their values in the baseline.

        Raises:
            XrgsError: `config.json` can't be read, or is of another version's schema.
        """
        from xrgs.composing import from_file

        return from_file(self.folder / "config.json")[0]

    def gaussians(self) -> Gaussians:
        """Load the trained Gaussians, in the world of `cameras`.

        Raises:
            XrgsError: `splats.ply` is missing or damaged, or was removed on purpose.
        """
        from xrgs.splat.ply import load_ply

        self.check_not_trimmed("splats.ply")
        return load_ply(self.folder / "splats.ply")

    def dataset(self) -> Dataset:
        """Load what the cell was trained and scored on: photographs, cameras, points.

        With `train.validation`, `test` has the held-out training views that its scores are of.
        The cameras and points are in the normalised world of the Gaussians.

        Raises:
            StoreError: `identity.json` can't be read.
            XrgsError: The variant is not in the store, or is damaged.
        """
        from xrgs.experiment.results import load_dataset

        return load_dataset(self.folder)

    def cameras(self) -> dict[str, dict[str, Camera]]:
        """Load the cameras of the cell's views, in the normalised world of its Gaussians.

        Returns:
            `{"train": {name: camera}, "test": {name: camera}}`, in the variant's order.

        Raises:
            XrgsError: As `dataset`, whose photographs are read with them.
        """
        data = self.dataset()
        splits = {"train": data.train, "test": data.test}
        return {
            split: {view.name: view.camera for view in views} for split, views in splits.items()
        }


def _is_heavy(name: str) -> bool:
    return name in _HEAVY or name.startswith(f"{_HEAVY_FOLDER}/")
