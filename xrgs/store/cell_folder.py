"""One cell's folder in a store: its files, its state, and its results.

`config.json` and `identity.json` are there first. `status.json` is written last, by an atomic
rename, and lists every result: a cell is done when that file says so and the listed files are
present and unchanged.
"""

from __future__ import annotations

import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from xrgs.config import Conf
from xrgs.errors import StoreError, UnreadableError
from xrgs.runtime import progress
from xrgs.safeio import checksums
from xrgs.safeio.atomic import write_json, write_text
from xrgs.safeio.files import is_name, is_transient, sync_tree, walk_files
from xrgs.safeio.hashing import file_digest
from xrgs.safeio.records import MAX_BYTES, as_number, read_struct, read_table
from xrgs.safeio.sanitize import for_terminal
from xrgs.store.schema import FileEntry, Identity, Provenance, Status, Summary

if TYPE_CHECKING:
    import pandas as pd

    from xrgs.mixture.views import Variant
    from xrgs.splat.cameras import Camera
    from xrgs.splat.gaussians import Gaussians
    from xrgs.training.dataset import Dataset

CONFIG, IDENTITY, CHECKPOINT, LOG = "config.json", "identity.json", "checkpoint.npz", "log.txt"
HISTORY, SPLATS, STATUS = "history.csv", "splats.ply", "status.json"
#: Reports are made from these files, so they are verified by their hash; others by their size.
_VERIFIED_BY_HASH = frozenset(
    {CONFIG, IDENTITY, "scores.csv", "summary.json", HISTORY, "quality.csv"}
)
#: Files in the folder of a done cell that its status does not list.
NOT_RESULTS = frozenset({LOG, STATUS, "progress.json", CHECKPOINT, f"refused-{CHECKPOINT}"})


@dataclass(frozen=True)
class CellState:
    """The state of a cell, and the reason for it."""

    name: str
    """`absent`, `planned` (a sweep has written its config), `unfinished`, `running`, `failed`,
    `corrupt` or `done`."""
    reason: str = ""
    unreadable: bool = False
    """Whether it is `failed` only because a file can't be read now: the cell may be done."""

    @classmethod
    def of_error(cls, error: StoreError | OSError) -> CellState:
        """Return the state of a cell whose files can't be read, or are damaged."""
        if isinstance(error, OSError):
            unreadable, reason = is_transient(error), f"{error.filename}: {error.strerror}"
        else:
            unreadable, reason = isinstance(error, UnreadableError), str(error)
        return cls("failed" if unreadable else "corrupt", reason, unreadable)


@dataclass(frozen=True)
class CellFolder:
    """The folder of one cell: its config, its results and its state.

    Methods that read a file raise StoreError where it is missing or damaged, or was removed by
    `xrgs-store trim`.
    """

    path: Path
    name: str = ""
    """The cell's id, where the folder has another name."""

    @property
    def id(self) -> str:
        """The cell's id: the digest of its identity."""
        return self.name or self.path.name

    @property
    def checkpoint(self) -> Path:
        """File of the training checkpoint, while the cell is not done."""
        return self.path / CHECKPOINT

    @property
    def progress(self) -> Path:
        """File that says how far the cell is; a process that is killed leaves it behind."""
        return self.path / "progress.json"

    @property
    def status_file(self) -> Path:
        """File of the final state, written after all other files."""
        return self.path / STATUS

    # State

    def state(self, *, verify: bool = True, owner: str | None = None) -> CellState:
        """Return whether this cell's result is present and intact.

        With `verify`, the files that reports are made from are hashed; otherwise only sizes are
        compared. `owner` describes the process that holds the cell's lease: it trains the cell,
        unless that is done.
        """
        state = self._state(verify=verify)
        if owner is None or state.name == "done":
            return state
        now = progress.read(self.progress)
        return CellState("running", f"by {owner}" + (f": {now}" if now else ""))

    def check_done(self, *, verify: bool = True) -> None:
        """Raise `StoreError` where the cell is not done, with its `state` and the reason."""
        state = self.state(verify=verify)
        if state.name != "done":
            why = f": {state.reason}" if state.reason else ""
            raise StoreError(f"{self.path}: the cell is {state.name}, not done{why}")

    def _state(self, *, verify: bool) -> CellState:
        try:
            try:
                self.status_file.stat()  # `exists` hides errors that pass, from Python 3.14 on
            except (FileNotFoundError, NotADirectoryError):
                return self._state_without_status()
            status = self.status()
            if status.state == "failed":
                return CellState("failed", status.reason)
            self._check(status, verify=verify)
        except (StoreError, OSError) as error:
            return CellState.of_error(error)
        return CellState("done")

    def _state_without_status(self) -> CellState:
        if not self.path.exists():
            return CellState("absent")
        if not self.path.is_dir():
            return CellState("corrupt", "it is not a folder")
        if self.checkpoint.exists():
            resumes = "it was stopped before it ended; it resumes from its checkpoint"
            return CellState("unfinished", resumes)
        if not (self.path / LOG).exists():
            return CellState("planned", "it has not begun")
        return CellState("unfinished", "it was stopped before it ended")

    def steps_to_resume(self) -> int:
        """Return about how many steps the next attempt takes from the checkpoint.

        They are counted in the history; 0 without a checkpoint or a readable history.
        """
        if not self.checkpoint.exists():
            return 0
        try:
            header, rows = read_table(self.path / HISTORY)
            return int(dict(zip(header, rows[-1], strict=True))["step"]) + 1
        except (StoreError, LookupError, ValueError):
            return 0

    def _check(self, status: Status, *, verify: bool) -> None:
        """Raise `StoreError` where a file of a done cell is missing or has changed."""
        for name, entry in status.files.items():
            file = self.path / name
            try:
                size = file.stat().st_size
            except (FileNotFoundError, NotADirectoryError):
                size = -1
            if size != entry.bytes:
                raise StoreError(f"{name} is missing or has another size")
            is_read = name in _VERIFIED_BY_HASH
            if is_read and size > MAX_BYTES:
                raise StoreError(f"{name} has {size} bytes, at most {MAX_BYTES} are read")
            if is_read and verify and file_digest(file) != entry.sha256:
                raise StoreError(f"{name} has changed since the cell finished")
        if verify and tuple(view for view, _ in self.view_scores()) != status.views:
            raise StoreError("scores.csv does not have one row for each view that was to be scored")

    def verify(self) -> list[str]:
        """Hash every file of a finished cell, and decode its JSON.

        Return a line for each file that is missing, damaged, has changed, can't be read or does not
        belong there; none for an intact cell.
        """
        decoders = {
            IDENTITY: self.identity,
            "summary.json": self.summary,
            "provenance.json": self.provenance,
        }
        try:
            status = self.status()
            hashes = {name: entry.sha256 for name, entry in status.files.items()}
            damage = [
                f"{error}; try again" if isinstance(error, UnreadableError) else str(error)
                for error in checksums.changed(self.path, hashes, "the cell finished")
            ]
            listed = status.files.keys() | status.trimmed.keys() | NOT_RESULTS
            damage += map(str, checksums.unlisted(self.path, listed))
            for name in () if damage else decoders.keys() & status.files.keys():
                decoders[name]()
        except (StoreError, OSError) as error:
            reason = CellState.of_error(error).reason.replace(f"{self.path}/", "")
            return [f"{self.path}: {reason}"]
        return damage

    # Ending a cell

    def finish(self, views: Sequence[str], scored_by: Mapping[str, str]) -> None:
        """Declare the cell done, with the files that are in the folder now.

        All of them are on the disk before the cell says that it is done. `views` are the scored
        views in the order of `scores.csv`, and `scored_by` the digests of the code that scored them
        (`xrgs.store.scoring`).
        """
        sync_tree(self.path)
        names = sorted(name for name, _ in walk_files(self.path) if name not in NOT_RESULTS)
        files = {name: self._entry(name) for name in names}
        self._write_status(
            Status("done", views=tuple(views), files=files, scored_by=dict(scored_by))
        )
        self.drop_checkpoint()  # last: a cell that is killed before still needs it

    def rescored(self, names: Sequence[str], scored_by: Mapping[str, str]) -> None:
        """Keep new scores of a done cell, in files of these names; the caller holds the lease."""
        status = self.status()
        files = status.files | {name: self._entry(name) for name in names}
        self._write_status(msgspec.structs.replace(status, files=files, scored_by=dict(scored_by)))

    def _entry(self, name: str) -> FileEntry:
        file = self.path / name
        return FileEntry(file.lstat().st_size, file_digest(file))

    def fail(self, reason: str) -> None:
        """Declare the cell failed, and write `error.txt` if its process did not."""
        error = self.path / "error.txt"
        if not error.exists():
            write_text(error, for_terminal(f"{reason}\n"))
        self.progress.unlink(missing_ok=True)
        self._write_status(Status("failed", reason))

    def drop_checkpoint(self) -> None:
        """Remove the checkpoint, which a finished cell no longer needs."""
        self.checkpoint.unlink(missing_ok=True)

    def _write_status(self, status: Status) -> None:
        write_json(self.status_file, msgspec.to_builtins(status))

    # Trimming

    def trimmed_status(self) -> Status:
        """Return the status that a cell has once it is trimmed; `StoreError` if it is not done."""
        status = self.status()
        if status.state != "done":
            raise StoreError(f"{self.status_file}: the cell is not done")
        heavy = {name: entry for name, entry in status.files.items() if _is_heavy(name)}
        kept = {name: entry for name, entry in status.files.items() if name not in heavy}
        return msgspec.structs.replace(status, files=kept, trimmed=status.trimmed | heavy)

    def trim(self) -> None:
        """Remove the Gaussians and the renders of a done cell, and list them in its status.

        The caller holds the cell's lease. The status is written first: a cell that is killed in
        between is done, and the next call removes the rest.
        """
        status = self.trimmed_status()
        self._write_status(status)
        for name in status.trimmed:
            (self.path / name).unlink(missing_ok=True)
        renders = self.path / "renders"
        if renders.is_dir() and not any(renders.iterdir()):
            renders.rmdir()

    def is_trimmed(self) -> bool:
        """Return whether files of the cell were removed by `xrgs-store trim`."""
        try:
            return bool(self.status().trimmed)
        except StoreError:
            return False

    def check_not_trimmed(self, name: str) -> None:
        """Raise `StoreError` where a file was removed on purpose; it says how to make it again."""
        if self.status_file.exists() and name in self.status().trimmed:
            raise StoreError(
                f"cells/{self.id}/{name} was removed by xrgs-store trim; xrgs-sweep rerun= trains"
                " the cell again, in a folder of its own"
            )

    def heavy_bytes(self) -> int:
        """Return the bytes of the Gaussians and the renders, which `trim` would free."""
        return sum(
            status.st_size
            for name, status in walk_files(self.path)
            if stat.S_ISREG(status.st_mode) and _is_heavy(name)
        )

    # Files

    def status(self) -> Status:
        """Read `status.json`."""
        return read_struct(self.status_file, Status)

    def identity(self) -> Identity:
        """Read `identity.json`."""
        return read_struct(self.path / IDENTITY, Identity)

    def summary(self) -> Summary:
        """Read `summary.json`."""
        return read_struct(self.path / "summary.json", Summary)

    def provenance(self) -> Provenance:
        """Read `provenance.json`."""
        return read_struct(self.path / "provenance.json", Provenance)

    def config(self) -> Conf:
        """Return the config that the cell was trained with.

        Keys that were added since have their values in the baseline.

        Raises:
            XrgsError: `config.json` can't be read, or is of another version's schema.
        """
        from xrgs.composing import from_file

        return from_file(self.path / CONFIG)[0]

    def view_scores(self) -> list[tuple[str, dict[str, float]]]:
        """Return the name and the scores of every scored view, NaN where a score is missing."""
        file = self.path / "scores.csv"
        header, rows = read_table(file)
        views = [row[0] for row in rows]
        if header[:1] != ["view"] or not all(map(is_name, views)):
            raise StoreError(f"damaged: {file}: the first column must hold names of views")
        if len(set(views)) < len(views):
            raise StoreError(f"damaged: {file}: a view has two rows")
        try:
            values = [map(as_number, row[1:]) for row in rows]
            scores = [dict(zip(header[1:], row, strict=True)) for row in values]
        except ValueError as error:
            raise StoreError(f"damaged: {file}: {error}") from error
        return list(zip(views, scores, strict=True))

    def scores(self) -> pd.DataFrame:
        """Return the scores of the scored views.

        There is one row a view, indexed by its name (`view`), and one column a score (`psnr` in dB,
        `ssim`, `lpips`); NaN where a score was not computed.
        """
        import pandas as pd

        scores = self.view_scores()
        index = pd.Index([name for name, _ in scores], name="view", dtype=object)
        return pd.DataFrame([values for _, values in scores], index=index)

    def history(self) -> pd.DataFrame:
        """Return the training history, one row per logged step; only `view` is text."""
        import pandas as pd

        header, rows = read_table(self.path / HISTORY)
        table = pd.DataFrame(rows, columns=header, dtype=object)
        for name, values in number_columns(self.path / HISTORY).items():
            numbers = pd.Series(values, dtype=float)
            table[name] = numbers.astype(int) if numbers.map(float.is_integer).all() else numbers
        return table

    def gaussians(self) -> Gaussians:
        """Load the trained Gaussians, in the world of `cameras`."""
        from xrgs.formats.ply import read_ply

        self.check_not_trimmed(SPLATS)
        return read_ply(self.path / SPLATS).gaussians

    def variant(self) -> Variant:
        """Load the variant that the cell was trained on, from the store that the cell is in."""
        from xrgs.mixture import variant
        from xrgs.store.trimming import check_images

        variants, variant_id = self.path.parents[1] / "variants", self.identity().variant
        check_images(variants, variant_id)
        return variant.load(variants / variant_id)

    def dataset(self) -> Dataset:
        """Load the data that the cell was trained and scored on: photographs, cameras, points.

        With `train.validation`, `test` has the held-out training views that its scores are of. The
        cameras and points are in the normalised world of the Gaussians.
        """
        from xrgs.training import dataset

        conf = self.config()
        validation = conf.train.validation
        return dataset.load(self.variant(), conf.train.views, validation=validation, seed=conf.seed)

    def cameras(self) -> dict[str, dict[str, Camera]]:
        """Load the cameras of the cell's views, in the normalised world of its Gaussians.

        They are `{"train": {name: camera}, "test": {name: camera}}`, in the variant's order. The
        photographs are read too.
        """
        data = self.dataset()
        splits = {"train": data.train, "test": data.test}
        return {
            split: {view.name: view.camera for view in views} for split, views in splits.items()
        }


def number_columns(file: Path) -> dict[str, list[float]]:
    """Read a table of numbers by columns, without the column `view`, which is text.

    StoreError says that the file is missing or damaged, or that a value is not a number.
    """
    header, rows = read_table(file)
    columns = {}
    try:
        for place, name in enumerate(header):
            if name != "view":
                columns[name] = [as_number(row[place]) for row in rows]
    except ValueError as error:
        raise StoreError(f"damaged: {file}: {name}: {error}") from error
    return columns


def _is_heavy(name: str) -> bool:
    """Return whether a file of a done cell is needed only by pictures, viewers and `rerun=`."""
    return name == SPLATS or name.startswith("renders/")
