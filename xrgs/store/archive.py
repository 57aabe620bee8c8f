"""The border of a store: packs results for others, and imports what others have made.

`pack` writes done cells, their variants and the records of their sweeps into one archive, which is
a store when it is unpacked. It has what tables are made of and what a sweep goes on from, without
logs, and without the full paths of photographs and stores that configs and commands name.

`import_store` copies a store of somebody else, an archive or a folder, into one's own. Every file
is checked there once: its kind, name and size, its type where it is JSON or CSV, and its hash. What
does not pass is left out and named. Nothing else in xrgs looks at files with such suspicion.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math
import os
import re
import stat
import tarfile
import time
import unicodedata
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import PurePath
from typing import IO, TYPE_CHECKING, Any

import msgspec

from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import paths, saved_variant, variant
from xrgs.photos import scenes
from xrgs.runtime import lease
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer, json_text
from xrgs.safeio.files import is_inside, is_name, remove_path, sync_name, sync_tree, walk_files
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import MAX_BYTES, errors_named, read_file, read_struct, read_table
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store import trimming
from xrgs.store.cell_folder import CONFIG, CellFolder, CellState
from xrgs.store.identity import cell_id
from xrgs.store.schema import FileEntry, SweepRecord
from xrgs.store.store import MAX_RECORD_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from xrgs.store.store import Store

#: The folder in the archive; the default of `store=`, so that commands find it once it is unpacked.
_ROOT = "xrgs-store"
#: The largest file of points, in bytes: twenty million points.
_MAX_POINTS_BYTES = 1 << 30

# Packing

#: Contents of files by their paths in the archive, each with the time it was modified.
_Files = dict[str, tuple[bytes, float]]


@dataclass(frozen=True)
class Packed:
    """What was packed, and what was not."""

    cells: int
    variants: int
    sweeps: int
    bytes: int
    """The size of the archive."""
    left_out: tuple[str, ...]
    """A line for each cell, variant and record that should have been packed, with the reason."""

    def __str__(self) -> str:
        return _counts(self.cells, self.variants, self.sweeps)


def pack(
    store: Store, cells: Sequence[CellFolder], out: Path, here: Path, sweeps: Sequence[str] = ()
) -> Packed:
    """Write an archive of done cells; the store does not change.

    Args:
        store: The store.
        cells: The cells to pack, all of them done.
        out: The archive to write or replace, `.tar.xz`; its folder must exist.
        here: The folder below which full paths in configs and commands are made relative; of a path
            elsewhere only the last name is kept.
        sweeps: Ids of the sweeps whose records are packed; empty for all that have such a cell.

    Returns:
        The numbers of what was packed. What is damaged, or can't be read now, is left out and
        named.

    Raises:
        StoreError: `out` can't be written, or the store can't be read.
    """
    left_out: list[str] = []

    def packed(name: str, files: Callable[[], _Files]) -> _Files:
        try:
            return files()
        except (StoreError, OSError) as error:
            left_out.append(for_line(f"{name}: {CellState.of_error(error).reason}"))
            return {}

    done = {cell: files for cell in cells if (files := packed(cell.id, partial(_cell, cell, here)))}
    variant_ids = sorted({cell.identity().variant for cell in done})
    sweep_ids = sorted(sweeps or _sweeps_of(store, {cell.id for cell in done}))
    variants = [packed(name, partial(_variant, store, name)) for name in variant_ids]
    records = [packed(name, partial(_record, store, name, here)) for name in sweep_ids]
    with errors_named(out):
        size = _write(out, [*done.values(), *variants, *records])
    count = [len(of) - of.count({}) for of in (variants, records)]
    return Packed(len(done), count[0], count[1], size, tuple(left_out))


def _sweeps_of(store: Store, cell_ids: set[str]) -> set[str]:
    """Return the ids of the sweeps that have one of some cells."""
    records, _ = store.records()
    return {
        sweep_id
        for sweep_id, record in records.items()
        if any(row.cell_id in cell_ids for row in record.cells)
    }


def _write(out: Path, groups: Iterable[_Files]) -> int:
    """Write the archive; equal files give equal bytes, whoever packs them."""
    with atomic_writer(out) as stream:
        with tarfile.open(fileobj=stream, mode="w:xz", preset=9) as archive:
            for files in groups:
                for name, (content, modified) in sorted(files.items()):
                    member = tarfile.TarInfo(f"{_ROOT}/{name}")
                    member.size, member.mtime = len(content), modified
                    archive.addfile(member, io.BytesIO(content))
        return stream.tell()


def _cell(cell: CellFolder, here: Path) -> _Files:
    """Return the files of a done cell as if it were trimmed, with its config's paths relative."""
    cell.identity()  # must be readable: it names the variant
    status = cell.trimmed_status()
    contents = {name: _verified(cell.path, name, of.sha256) for name, of in status.files.items()}
    config = json_text(_relative(json.loads(contents[CONFIG]), here)).encode()
    entry = FileEntry(len(config), hashlib.sha256(config).hexdigest())
    status = msgspec.structs.replace(status, files=status.files | {CONFIG: entry})
    text = json_text(msgspec.to_builtins(status))
    contents |= {CONFIG: config, cell.status_file.name: text.encode()}
    modified = cell.status_file.stat().st_mtime
    return {f"cells/{cell.id}/{name}": (content, modified) for name, content in contents.items()}


def _verified(folder: Path, name: str, sha256: str) -> bytes:
    content = read_file(folder / name)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise StoreError(f"{folder / name}: it has changed since the cell finished")
    return content


def _variant(store: Store, variant_id: str) -> _Files:
    """Return the files of a variant as if it were trimmed, under a trimmed variant's name."""
    trimmed = paths.trimmed_folder(store.variants, variant_id)
    folder = trimmed if trimmed.is_dir() else store.variants / variant_id
    if damage := trimming.verify_variant(folder):
        raise StoreError("; ".join(damage))
    modified = (folder / saved_variant.MANIFEST).lstat().st_mtime
    return {
        f"variants/{trimmed.name}/{name}": (read_file(folder / name, _MAX_POINTS_BYTES), modified)
        for name in (saved_variant.MANIFEST, saved_variant.POINTS, saved_variant.REPORT)
    }


def _record(store: Store, sweep_id: str, here: Path) -> _Files:
    store.verify_sweep(sweep_id)
    record, file = store.sweep_record(sweep_id), store.sweeps / f"{sweep_id}.json"
    command = tuple(_relative_argument(word, here) for word in record.command)
    text = json_text(msgspec.to_builtins(msgspec.structs.replace(record, command=command)))
    return {f"sweeps/{file.name}": (text.encode(), file.stat().st_mtime)}


def _relative(value: Any, here: Path) -> Any:
    """Return a JSON value with every text that is a full path made relative."""
    if isinstance(value, dict):
        return {key: _relative(item, here) for key, item in value.items()}
    if isinstance(value, list):
        return [_relative(item, here) for item in value]
    if not (isinstance(value, str) and PurePath(value).is_absolute()):
        return value
    path = PurePath(value)
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name


def _relative_argument(word: str, here: Path) -> str:
    """Make the values of an argument relative: `scene.path=/a/fern,/a/horns`."""
    key, equals, values = word.rpartition("=")
    return key + equals + ",".join(_relative(value, here) for value in values.split(","))


# Importing

#: The most files and bytes that an archive or a folder may have.
_MAX_FILES, _MAX_IMPORT_BYTES = 1_000_000, 1 << 40
#: The most lines about what was left out, and the most names in one of them.
_MAX_LINES, _MAX_NAMES = 1000, 3
#: The largest header of a tar member, in bytes. tarfile reads such a header whole.
_MAX_HEADER_BYTES = 1 << 20
_CHUNK = 1 << 20
#: The hidden folder, beside the final places, of what is not checked yet.
_STAGING = ".importing"
_PICTURE_BYTES = 1 << 28
_ID = "[0-9a-f]{16}"
#: The files that an import takes, and the largest size of each, in bytes.
_TAKEN = tuple(
    (re.compile(pattern), most)
    for pattern, most in {
        f"cells/{_ID}/(config|identity|provenance|status|summary)\\.json": MAX_BYTES,
        f"cells/{_ID}/(history|quality|scores)\\.csv": MAX_BYTES,
        f"cells/{_ID}/splats\\.ply": 1 << 33,
        f"cells/{_ID}/renders/[^/]+\\.png": _PICTURE_BYTES,
        f"variants/(trimmed-)?{_ID}-{_ID}/(variant|report)\\.json": MAX_BYTES,
        f"variants/(trimmed-)?{_ID}-{_ID}/points\\.npz": _MAX_POINTS_BYTES,
        f"variants/{_ID}-{_ID}/images/[^/]+/[^/]+\\.png": _PICTURE_BYTES,
        f"scenes/{_ID}/scene\\.json": MAX_BYTES,
        f"scenes/{_ID}/[^/]+\\.png": _PICTURE_BYTES,
        f"sweeps/{_ID}\\.json": MAX_RECORD_BYTES,
    }.items()
)
#: What stores have besides, and an import passes over: what is running, made again, or set aside.
_PASSED_OVER = re.compile(
    r"(.*/)?\..*|(hydra|locks|reports)/.*|variants/failed-.*|cells/[^/]+\.aside-.*"
    rf"|cells/{_ID}/(log\.txt|error\.txt|progress\.json|(refused-)?checkpoint\.npz)"
    rf"|variants/{_ID}-{_ID}/colmap\.log"
)
#: Files that every done cell has.
_OF_EVERY_CELL = ("config.json", "identity.json", "provenance.json", "summary.json", "scores.csv")


@dataclass(frozen=True)
class Imported:
    """What an import has added to a store, and what it has left out."""

    cells: int
    variants: int
    scenes: int
    sweeps: int
    present: int
    """How many cells, variants, scenes and records the store had already: they did not change."""
    left_out: tuple[str, ...]
    """A line for each reason why something was left out, with the names of the first items."""

    def __str__(self) -> str:
        counts = _counts(self.cells, self.variants, self.sweeps, self.scenes)
        return f"imported: {counts}; already there: {self.present}"


def import_store(source: Path, store: Store) -> Imported:
    """Copy a store of somebody else into one's own, after every file is checked.

    Cells that are not done, checkpoints, logs and reports are not imported. Each cell, variant,
    scene and record gets its name once it is whole and on the disk. An import that was stopped
    goes on when it is run again: what it has imported is already there.

    Args:
        source: The archive (`.tar`, `.tar.xz`, `.tar.gz`, `.tar.bz2`), or the folder of a store.
        store: The store to copy to; it is made where it is missing.

    Returns:
        The numbers of what was imported, and a line for each thing that was left out.

    Raises:
        StoreError: The source is no folder and no archive, or the store can't be written.
    """
    store.prepare()
    with errors_named(store.path), lease.waited_for(store.path, ".import.lock"):
        border = _Border(store)
        try:
            border.clear()
            border.receive(source)
            return border.admit()
        finally:
            border.clear()


@dataclass
class _Member:
    """A file, a folder or something else in an archive or a folder."""

    name: str
    """Its path, with `/`."""
    size: int
    modified: float
    wrong: str
    """Why it is not taken; empty for a regular file."""
    open: Callable[[], IO[bytes] | None]


@dataclass
class _Border:
    """Receives the files of one import, and admits what is whole.

    A cell, a variant, a scene or a record is an item, named by its kind and its name in the store:
    `cells/0123456789abcdef`.
    """

    store: Store
    left_out: dict[str, list[str]] = field(default_factory=dict)
    """The names of what is not imported, by the reason."""
    received: dict[str, set[str]] = field(default_factory=dict)
    """The files of each item, as file systems see them that ignore case."""
    refused: dict[str, str] = field(default_factory=dict)
    """Why an item is not admitted, where that is known before it is whole."""
    present: set[str] = field(default_factory=set)

    def homes(self) -> dict[str, Path]:
        """Return the folder of each kind of item."""
        store = self.store
        return {
            "variants": store.variants,
            "scenes": store.scenes,
            "cells": store.cells_folder,
            "sweeps": store.sweeps,
        }

    def clear(self) -> None:
        """Remove what this import, or a stopped one before it, has left in the hidden folders."""
        for home in self.homes().values():
            remove_path(home / _STAGING)

    def leave_out(self, name: str, why: str) -> None:
        """Remember something that is not imported, and why."""
        self.left_out.setdefault(why, []).append(name)

    # Receiving

    def receive(self, source: Path) -> None:
        """Copy the files that a store may have into the hidden folders."""
        total = 0
        try:
            for number, member in enumerate(progress(_members(source), "reading", "file")):
                total += member.size
                if number >= _MAX_FILES or total > _MAX_IMPORT_BYTES:
                    what = f"more than {_MAX_FILES} files or {_MAX_IMPORT_BYTES} bytes"
                    self.leave_out(str(source), f"{what}: the rest was not read")
                    return
                self._receive_one(member)
        except tarfile.TarError as error:
            if not self.received:
                raise StoreError(f"{source}: not an archive of a store ({error})") from error
            self.leave_out(str(source), f"damaged, the rest can't be read ({error})")

    def _receive_one(self, member: _Member) -> None:
        name = member.name.removeprefix("./")
        if not is_inside(name):
            self.leave_out(member.name, "not the path of a file in a store")
            return
        top, _, below = name.partition("/")
        if top not in {*self.homes(), "hydra", "locks", "reports"}:
            name = below or name  # the store has a folder around it
        if not name or _PASSED_OVER.fullmatch(name):
            return
        most = next((most for pattern, most in _TAKEN if pattern.fullmatch(name)), None)
        if most is None:
            self.leave_out(member.name, member.wrong or "no store has a file of this name")
            return
        kind, item_name, *_ = name.split("/")
        item = f"{kind}/{item_name}"
        if item in self.present or item in self.refused:
            return
        if self._is_present(kind, item_name):
            self.present.add(item)
            return
        why = member.wrong or (f"{member.size} bytes, at most {most}" if member.size > most else "")
        # On file systems that ignore case or the form of accents, two such names are one.
        plain = unicodedata.normalize("NFC", name).casefold()
        files = self.received.setdefault(item, set())
        if plain in files:
            why = "another file has the same name, or one that differs in case alone"
        if why:
            self.refused[item] = f"{name}: {why}"
            return
        files.add(plain)
        self._copy(member, self._staged(item, name))

    def _is_present(self, kind: str, name: str) -> bool:
        home = self.homes()[kind]
        if kind != "variants":
            return (home / name).exists()
        variant_id = paths.id_of(name)  # of a variant, with its images or trimmed
        return (home / variant_id).exists() or paths.trimmed_folder(home, variant_id).exists()

    def _staged(self, item: str, name: str = "") -> Path:
        """Return the hidden path of an item, or of a file in it."""
        kind, _, inside = (name or item).partition("/")
        return self.homes()[kind] / _STAGING / inside

    def _copy(self, member: _Member, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream = member.open()
        if stream is None:
            raise StoreError(f"{member.name}: not a regular file")
        with stream, target.open("xb") as copy:
            left = member.size
            while left > 0:
                with _errors_of_archives():
                    chunk = stream.read(min(left, _CHUNK))
                if not chunk:
                    break  # the hash will tell
                copy.write(chunk)
                left -= len(chunk)
        _set_time(target, member.modified)

    # Admitting

    def admit(self) -> Imported:
        """Check each item, and give it its name in the store."""
        count = dict.fromkeys(self.homes(), 0)
        kinds = list(count)
        items = sorted(self.received, key=lambda item: (kinds.index(item.partition("/")[0]), item))
        for item in progress(items, "checking", "item"):
            kind = item.partition("/")[0]
            try:
                if item in self.refused:
                    raise StoreError(self.refused[item])
                _CHECKS[kind](self._staged(item))
            except XrgsError as error:
                staged = str(self._staged(item))
                message = str(error).replace(f"{staged}/", "").replace(staged, "it")
                self.leave_out(item, message)
                continue
            if self._name(item):
                count[kind] += 1
            else:
                self.present.add(item)
        return Imported(**count, present=len(self.present), left_out=tuple(self._lines()))

    def _lines(self) -> Iterator[str]:
        """Yield a line for each reason, with the first names that it is of."""
        for why, names in itertools.islice(self.left_out.items(), _MAX_LINES):
            rest = len(names) - _MAX_NAMES
            more = f" and {rest} more" if rest > 0 else ""
            yield for_line(f"{', '.join(names[:_MAX_NAMES])}{more}: {why}", 500)
        if (rest := len(self.left_out) - _MAX_LINES) > 0:
            yield f"and {rest} more reasons"

    def _name(self, item: str) -> bool:
        """Give an item its name; return False where another process did so meanwhile."""
        kind, _, name = item.partition("/")
        staged, home = self._staged(item), self.homes()[kind] / name
        if staged.is_dir():
            sync_tree(staged)
        else:
            with staged.open("rb") as stream:
                os.fsync(stream.fileno())
        if self._is_present(kind, name):
            return False
        staged.rename(home)
        sync_name(home)
        return True


def _set_time(file: Path, modified: float) -> None:
    """Keep the time of a file, for the order of records; a time in the future becomes now."""
    now = time.time()
    kept = min(max(modified, 0.0), now) if math.isfinite(modified) else now
    os.utime(file, (kept, kept))


def _members(source: Path) -> Iterator[_Member]:
    """Yield all that an archive or a folder has, without folders; links are not followed.

    Raises:
        StoreError: The source can't be read.
        tarfile.TarError: It is no archive, or is damaged.
    """
    if source.is_dir():
        with errors_named(source):
            for name, status in walk_files(source):
                wrong = "" if stat.S_ISREG(status.st_mode) else "not a regular file"
                size, modified = status.st_size, status.st_mtime
                yield _Member(name, size, modified, wrong, partial(_open, source / name))
        return
    with errors_named(source):
        content = source.open("rb")
    with content, ExitStack() as stack:
        with _errors_of_archives():
            archive = stack.enter_context(
                tarfile.open(fileobj=content, mode="r|*", tarinfo=_Header)
            )
        while True:
            with _errors_of_archives():
                header = archive.next()
            if header is None:
                return
            archive.members.clear()  # type: ignore[attr-defined]  # tarfile would keep them all
            if header.isdir():
                continue
            regular = header.type in (tarfile.REGTYPE, tarfile.AREGTYPE) and not header.issparse()
            wrong = "" if regular else "not a regular file"
            extracted = partial(archive.extractfile, header)
            yield _Member(header.name, header.size, float(header.mtime), wrong, extracted)


def _open(file: Path) -> IO[bytes]:
    return file.open("rb")


@contextmanager
def _errors_of_archives() -> Iterator[None]:
    """Turn whatever tarfile raises for damaged data, even TypeError, into `tarfile.TarError`."""
    try:
        yield
    except Exception as error:
        if isinstance(error, tarfile.TarError) or getattr(error, "errno", None) is not None:
            raise
        raise tarfile.ReadError(str(error) or type(error).__name__) from error


class _Header(tarfile.TarInfo):
    """A header of an archive, whose long names and attributes have a bounded size."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> _Header:
        header = super().frombuf(buf, encoding, errors)
        kinds = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE)
        long_names = (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)
        most = _MAX_HEADER_BYTES if header.type in (*kinds, *long_names) else _MAX_IMPORT_BYTES
        if not 0 <= header.size <= most:
            raise tarfile.ReadError(f"a member or a header of {header.size} bytes")
        return header


def _check_cell(folder: Path) -> None:
    """Raise `XrgsError` where a cell is not done, or not what its files and its name say."""
    cell = CellFolder(folder)
    status = cell.status()
    if status.state != "done":
        raise StoreError(f"the cell has {status.state}")
    if missing := set(_OF_EVERY_CELL) - status.files.keys():
        raise StoreError(f"status.json: files: {min(missing)} is not listed")
    if damage := cell.verify():
        raise StoreError("; ".join(damage))
    state = cell.state()
    if state.name != "done":
        raise StoreError(state.reason)
    if cell_id(cell.identity()) != cell.id:
        raise StoreError(
            "identity.json: its digest is not the id of the cell: the file has changed, or the cell"
            " is of version 0.1.0, whose archives are unpacked instead (tar xJf FILE)"
        )
    if cell.config().seed != cell.identity().seed:
        raise StoreError("config.json: seed: not the seed of identity.json")
    for name in {"history.csv", "quality.csv"} & status.files.keys():
        read_table(folder / name)


def _check_variant(folder: Path) -> None:
    manifest = saved_variant.read_manifest(folder)
    names = (view.name for view in manifest.views)
    if not all(map(is_name, names)) or not all(map(is_inside, manifest.files)):
        raise StoreError("variant.json: the name of a view or a file is not valid")
    is_trimmed = paths.is_trimmed(folder.name)
    if paths.id_of(folder.name) != manifest.id:
        raise StoreError("variant.json: its id is not the name of the folder")
    if damage := (trimming.verify_variant if is_trimmed else variant.verify)(folder):
        raise StoreError("; ".join(damage))
    read_struct(folder / saved_variant.REPORT, dict[str, Any])


def _check_scene(folder: Path) -> None:
    if damage := scenes.verify(folder):
        raise StoreError("; ".join(damage))


def _check_record(file: Path) -> None:
    record = read_struct(file, SweepRecord, MAX_RECORD_BYTES)
    if digest(msgspec.to_builtins(record.cells)) != record.digest:
        raise StoreError("its cells have changed since it was written")


_CHECKS: dict[str, Callable[[Path], None]] = {
    "variants": _check_variant,
    "scenes": _check_scene,
    "cells": _check_cell,
    "sweeps": _check_record,
}


def _counts(cells: int, variants: int, sweeps: int, scenes: int = 0) -> str:
    """Return numbers as a text, for example `2 cells, 1 variant, 1 record of sweeps`."""
    parts = [counted(cells, "cell"), counted(variants, "variant")]
    parts += [counted(scenes, "rendered scene")] if scenes else []
    return ", ".join([*parts, f"{counted(sweeps, 'record')} of sweeps"])
