"""Packs results of a store for other people, and imports their stores.

A pack is a store when it is unpacked, with the files that reports are made from and that sweeps
continue from. It has no logs, and no full paths.

An import unpacks archives by tarfile's filter `data`. JSON and CSV files are decoded by their
types, and all files are verified by their hashes. An item that fails a check is left out and named.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import stat
import tarfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import msgspec

from xrgs.errors import StoreError, XrgsError
from xrgs.mixture import paths, saved_variant, variant
from xrgs.photos import scenes
from xrgs.photos.scenes.scene import ALL_BELOW
from xrgs.runtime import lease
from xrgs.runtime.progress import progress
from xrgs.runtime.text import listed
from xrgs.safeio.atomic import atomic_writer, json_text
from xrgs.safeio.files import is_inside, is_name, remove_path, sync_name, sync_tree, walk_files
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import errors_named, read_file, read_struct, read_table
from xrgs.safeio.sanitize import counted, for_line
from xrgs.store import trimming
from xrgs.store.cell_folder import (
    CONFIG,
    HISTORY,
    IDENTITY,
    NOT_RESULTS,
    STATUS,
    CellFolder,
    CellState,
)
from xrgs.store.identity import cell_id
from xrgs.store.schema import FileEntry, RecordedCell
from xrgs.store.store import Store, unchanged_record

#: The folder in the archive; the default of `store=`, so that commands find it once it is unpacked.
_ROOT = "xrgs-store"
#: The largest file of points, in bytes: twenty million points.
_MAX_POINTS_BYTES = 1 << 30

# Packing

#: Contents of files by their paths in the archive, each with the time it was modified.
_Files = dict[str, tuple[bytes, float]]


@dataclass(frozen=True)
class Copied:
    """How much was packed or imported, and which items were left out."""

    cells: int
    variants: int
    scenes: int
    sweeps: int
    left_out: tuple[str, ...]
    """Lines on items that are damaged or can't be read now, with the reasons and names."""
    bytes: int = 0
    """The size of the packed archive."""
    present: int = 0
    """How many imported items the store had already: they did not change."""

    def __str__(self) -> str:
        scenes = [counted(self.scenes, "rendered scene")] if self.scenes else []
        parts = [counted(self.cells, "cell"), counted(self.variants, "variant"), *scenes]
        return ", ".join([*parts, f"{counted(self.sweeps, 'record')} of sweeps"])


def pack(
    store: Store, cells: Sequence[CellFolder], out: Path, here: Path, sweeps: Sequence[str] = ()
) -> Copied:
    """Write an archive (`.tar.xz`, replaced) of cells that are all done; the store does not change.

    Full paths in configs and commands are made relative to `here`; of a path elsewhere only the
    last name is kept. `sweeps` are ids of the sweeps whose records are packed; empty for all that
    have such a cell. StoreError says that `out` can't be written, or the store not be read.
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
    sweep_ids = sorted(sweeps or store.sweeps_of(*(cell.id for cell in done)))
    variants = [packed(name, partial(_variant, store, name)) for name in variant_ids]
    records = [packed(name, partial(_record, store, name, here)) for name in sweep_ids]
    with errors_named(out):
        size = _write(out, [*done.values(), *variants, *records])
    counts = [len(items) - items.count({}) for items in (variants, records)]
    return Copied(len(done), counts[0], 0, counts[1], tuple(left_out), bytes=size)


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
    contents = {name: _verified(cell.path, name, e.sha256) for name, e in status.files.items()}
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
    folder = trimming.home_of(store.variants, variant_id)
    _check_damage(trimming.verify_variant(folder))
    modified = (folder / saved_variant.MANIFEST).lstat().st_mtime
    names = (saved_variant.MANIFEST, saved_variant.POINTS, saved_variant.REPORT)
    contents = {name: read_file(folder / name, _MAX_POINTS_BYTES) for name in names}
    if known := trimming.textures(folder):
        contents[trimming.TEXTURES] = json_text(known).encode()
    return {f"variants/{trimmed.name}/{name}": (of, modified) for name, of in contents.items()}


def _record(store: Store, sweep_id: str, here: Path) -> _Files:
    file = store.sweeps / f"{sweep_id}.json"
    record = unchanged_record(file)
    command = tuple(_relative_argument(word, here) for word in record.command)
    found = [path for word in record.command for path in _FULL_PATH.findall(word)]
    full = sorted(found, key=len, reverse=True)  # a path may begin with another one

    def shown(row: RecordedCell) -> RecordedCell:
        if (error := row.error) is None:
            return row
        for path in full:
            error = error.replace(path, _relative(path, here))
        return msgspec.structs.replace(row, error=error.replace(f"{here}/", ""))

    cells = tuple(map(shown, record.cells))
    record = msgspec.structs.replace(
        record, command=command, cells=cells, digest=digest(msgspec.to_builtins(cells))
    )
    text = json_text(msgspec.to_builtins(record))
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
    if path.is_relative_to(here):
        return str(path.relative_to(here))
    below = ALL_BELOW.strip("/")  # of `/a/garden/**` the name is garden
    return f"{path.parent.name}/{below}" if path.name == below else path.name


#: A full path in an argument: behind a sign of Hydra's grammar, up to the next one.
_FULL_PATH = re.compile(r"""(?<![^=,\[('" ])/[^,\[\]()'"]*""")


def _relative_argument(word: str, here: Path) -> str:
    """Make the paths of an argument relative: `scene.path=/a/fern,'/a/my horns'`."""
    return _FULL_PATH.sub(lambda found: _relative(found[0], here), word)


# Importing

#: Name of the hidden folders, in the store and beside the final places, where items are put first.
_STAGING = ".importing"
_ID = "[0-9a-f]{16}"
#: Folder of a kind of items in a store -> the names that its items have.
_NAMES = {
    "variants": re.compile(f"(trimmed-)?{_ID}-{_ID}"),
    "scenes": re.compile(_ID),
    "cells": re.compile(_ID),
    "sweeps": re.compile(f"{_ID}\\.json"),
}
#: Names that an import passes over: hidden folders, failed scenes, and folders that were set aside.
_PASSED_OVER = re.compile(r"\..*|failed-.*|.*\.aside-.*")
#: Files of a cell or a variant that are not copied.
_NOT_COPIED = (NOT_RESULTS - {STATUS}) | {saved_variant.LOG}
#: Files that every done cell has.
_REQUIRED = (CONFIG, IDENTITY, "provenance.json", "summary.json", "scores.csv")


def import_store(source: Path, store: Store) -> Copied:
    """Copy a store of somebody else, an archive or a folder, after every file is checked.

    Cells that are not done, checkpoints, logs and reports are not imported. Each cell, variant,
    scene and record gets its name once it is whole and on the disk. An import that was stopped goes
    on when it is run again.

    Raises:
        StoreError: The source is no store; an archive is damaged, or has a link or a name outside
            its folder; or the store can't be written.
    """
    with errors_named(source):
        is_folder = stat.S_ISDIR(source.stat().st_mode)
    root = _root(source, source) if is_folder else None  # before a store is made for it
    store.prepare()
    with errors_named(store.path), lease.waited_for(store.path, ".import.lock"):
        importing = _Import(store.path)
        importing.clear()
        try:
            return importing.copy_all(root or _unpacked(source, store.path / _STAGING))
        finally:
            importing.clear()


def _unpacked(archive: Path, folder: Path) -> Path:
    folder.mkdir()
    _unpack(archive, folder)
    return _root(archive, folder)


def _root(source: Path, folder: Path) -> Path:
    """Return the folder that has `cells`, of the folder of a source; messages name the source."""
    with errors_named(source):
        inside = sorted(path for path in folder.iterdir() if path.is_dir())
    for root in (folder, *inside):  # the store may have a folder around it
        if any((root / kind).is_dir() for kind in _NAMES):
            return root
    raise StoreError(f"{source}: not a store: it has no folder {', '.join(_NAMES)}")


def _unpack(archive: Path, folder: Path) -> None:
    with errors_named(archive):
        content = archive.open("rb")
    with content:
        try:
            with tarfile.open(fileobj=content) as opened:
                opened.extractall(folder, filter=_regular_files)  # noqa: S202
        except Exception as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            # tarfile, zlib and lzma raise errors of many types for damaged data. tarfile's message
            # on a file of no format has a line for each format.
            lines = str(error).splitlines()
            why = "it is no .tar, .tar.xz, .tar.gz or .tar.bz2" if len(lines) > 1 else error
            raise StoreError(f"{archive}: not an archive of a store ({why})") from error


def _regular_files(member: tarfile.TarInfo, folder: str) -> tarfile.TarInfo | None:
    """Filter an archive: only regular files are unpacked, and none outside the folder."""
    member = tarfile.data_filter(member, folder)
    if member.isdir():
        return None
    if not member.isreg():
        raise tarfile.SpecialFileError(member)
    return member


@dataclass(frozen=True)
class _Import:
    """Copies intact items. An item is a cell, a variant, a scene or the record of a sweep."""

    home: Path
    """The folder of the store. Each kind of item is in a folder of it, as in any store."""

    def clear(self) -> None:
        """Remove the hidden folders, also those of an import that was stopped."""
        for folder in (self.home, *(self.home / kind for kind in _NAMES)):
            remove_path(folder / _STAGING)

    def copy_all(self, root: Path) -> Copied:
        """Check each item of a folder, and copy it to its place in the store."""
        items = [
            path
            for kind in _NAMES
            if (root / kind).is_dir()
            for path in sorted((root / kind).iterdir())
            if not _PASSED_OVER.fullmatch(path.name)
        ]
        count, present = dict.fromkeys(_NAMES, 0), 0
        left_out: dict[str, list[str]] = {}
        for item in progress(items, "importing", "item"):
            kind = item.parent.name
            try:
                self._check(item)
                copied = not self._is_present(item) and self._copy(item)
            except XrgsError as error:
                message = str(error).replace(f"{item}/", "").replace(str(item), "it")
                left_out.setdefault(message, []).append(f"{kind}/{item.name}")
                continue
            count[kind] += copied
            present += not copied
        lines = (f"{listed(names)}: {why}" for why, names in left_out.items())
        return Copied(**count, present=present, left_out=tuple(map(for_line, lines)))

    def _check(self, item: Path) -> None:
        kind = item.parent.name
        if not _NAMES[kind].fullmatch(item.name):
            raise StoreError("no store has anything of this name")
        if self._is_present(item):
            return
        with errors_named(item):
            files = [("", item.lstat())] if kind == "sweeps" else walk_files(item)
            for name, status in files:
                if not stat.S_ISREG(status.st_mode):
                    raise StoreError(f"{name or 'it'}: not a regular file")
            _CHECKS[kind](item)

    def _is_present(self, item: Path) -> bool:
        home = self.home / item.parent.name
        if item.parent.name != "variants":
            return (home / item.name).exists()
        variant_id = paths.id_of(item.name)  # of a variant, with its images or trimmed
        return (home / variant_id).exists() or paths.trimmed_folder(home, variant_id).exists()

    def _copy(self, item: Path) -> bool:
        """Copy an item; return False where another process made it meanwhile."""
        home = self.home / item.parent.name
        staged = home / _STAGING / item.name
        files = [name for name, _ in walk_files(item)] if item.is_dir() else [""]
        for name in files:
            if name not in _NOT_COPIED:
                (staged / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(item / name, staged / name)
        sync_tree(staged.parent)
        if self._is_present(item):
            return False
        staged.rename(home / item.name)
        sync_name(home / item.name)
        return True


def _check_cell(folder: Path) -> None:
    """Raise `XrgsError` where a cell is not done, is damaged, or its id does not fit its files."""
    cell = CellFolder(folder)
    cell.check_done(verify=False)
    listed_files = cell.status().files.keys()
    if missing := set(_REQUIRED) - listed_files:
        raise StoreError(f"status.json: files: {min(missing)} is not listed")
    _check_damage(cell.verify())
    cell.check_done()
    if cell_id(cell.identity()) != cell.id:
        raise StoreError(
            "identity.json: its digest is not the id of the cell: the file has changed, or the cell"
            " is of version 0.1.0, whose archives are unpacked instead (tar xJf FILE)"
        )
    if cell.config().seed != cell.identity().seed:
        raise StoreError("config.json: seed: not the seed of identity.json")
    for name in {HISTORY, "quality.csv"} & listed_files:
        read_table(folder / name)


def _check_variant(folder: Path) -> None:
    manifest = saved_variant.read_manifest(folder)
    names = (view.name for view in manifest.views)
    if not all(map(is_name, names)) or not all(map(is_inside, manifest.files)):
        raise StoreError("variant.json: the name of a view or a file is not valid")
    is_trimmed = paths.is_trimmed(folder.name)
    if paths.id_of(folder.name) != manifest.id:
        raise StoreError("variant.json: its id is not the name of the folder")
    _check_damage((trimming.verify_variant if is_trimmed else variant.verify)(folder))
    read_struct(folder / saved_variant.REPORT, dict[str, Any])
    if (folder / trimming.TEXTURES).exists():
        trimming.textures(folder)


def _check_damage(damage: Sequence[str]) -> None:
    if damage:
        raise StoreError("; ".join(damage))


_CHECKS: dict[str, Callable[[Path], object]] = {
    "variants": _check_variant,
    "scenes": lambda folder: _check_damage(scenes.verify(folder)),
    "cells": _check_cell,
    "sweeps": unchanged_record,
}
