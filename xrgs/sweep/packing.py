"""Packs done cells, their variants and the records of sweeps into one archive, to publish a study.

The archive is enough for tables, and for a sweep to continue. It has the files that trimmed cells
and variants keep, without logs. Full paths of photographs and stores become relative. Unpacked, the
archive is a store. The packed store does not change.
"""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from dataclasses import dataclass
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import msgspec

from xrgs.capture import frozen
from xrgs.capture.folders import trimmed_folder
from xrgs.errors import StoreError
from xrgs.experiment import trimming
from xrgs.experiment.cell_folder import CellState
from xrgs.experiment.schema import FileEntry
from xrgs.safeio.atomic import atomic_writer, json_text
from xrgs.safeio.records import errors_named, read_file
from xrgs.safeio.sanitize import counted, for_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from xrgs.experiment.listing import CellRow
    from xrgs.experiment.store import Store

#: The folder in the archive; the default of `store=`, so that commands find it once it is unpacked.
_ROOT = "xrgs-store"
_CONFIG = "config.json"
#: The largest file of points that is packed, in bytes: twenty million points.
_MAX_POINTS_BYTES = 1 << 30

#: Contents of files by their paths in the archive, each with the time it was modified.
_Files = dict[str, tuple[bytes, float]]


@dataclass(frozen=True)
class Packed:
    """The content of an archive."""

    cells: int
    variants: int
    sweeps: int
    bytes: int
    """The size of the archive."""
    left_out: tuple[str, ...]
    """A line for each cell, variant and record that could not be packed, with the reason."""

    def __str__(self) -> str:
        parts = (
            counted(self.cells, "cell"),
            counted(self.variants, "variant"),
            counted(self.sweeps, "record") + " of sweeps",
        )
        return ", ".join(parts)


def pack(
    store: Store, cells: Sequence[CellRow], out: Path, here: Path, sweeps: Sequence[str] = ()
) -> Packed:
    """Write an archive of done cells.

    Args:
        store: The store.
        cells: The cells to pack, which are done.
        out: The archive to write or replace, `.tar.xz`; its folder must exist.
        here: Full paths below this folder become relative to it; other paths lose all but their
            last name.
        sweeps: Ids of the sweeps to pack; empty for every sweep with one of the cells.

    Raises:
        StoreError: `out` can't be written.
    """
    left_out: list[str] = []

    def packed(name: str, files: Callable[[], _Files]) -> _Files:
        try:
            return files()
        except (StoreError, OSError) as error:
            left_out.append(for_line(f"{name}: {CellState.of_error(error).reason}"))
            return {}

    found = [(cell, packed(cell.name, partial(_cell, cell, here))) for cell in cells]
    done = [(cell, files) for cell, files in found if files]
    variant_ids = sorted({cell.variant_id for cell, _ in done if cell.variant_id is not None})
    sweep_ids = sorted({*sweeps} or {sweep for cell, _ in done for sweep in cell.sweeps})
    variants = [packed(name, partial(_variant, store, name)) for name in variant_ids]
    records = [packed(name, partial(_record, store, name, here)) for name in sweep_ids]
    with errors_named(out):
        size = _write(out, [*(files for _, files in done), *variants, *records])
    count = [len(of) - of.count({}) for of in (variants, records)]
    return Packed(len(done), count[0], count[1], size, tuple(left_out))


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


def _cell(cell: CellRow, here: Path) -> _Files:
    """Return the files of a done cell as if it were trimmed, with its config's paths relative."""
    folder, status = cell.folder.path, cell.folder.trimmed_status()
    contents = {name: _verified(folder, name, of.sha256) for name, of in status.files.items()}
    config = json_text(_relative(json.loads(contents[_CONFIG]), here)).encode()
    entry = FileEntry(len(config), hashlib.sha256(config).hexdigest())
    status = msgspec.structs.replace(status, files=status.files | {_CONFIG: entry})
    text = json_text(msgspec.to_builtins(status))
    contents |= {_CONFIG: config, cell.folder.status_file.name: text.encode()}
    modified = cell.folder.status_file.stat().st_mtime
    return {f"cells/{cell.id}/{name}": (content, modified) for name, content in contents.items()}


def _verified(folder: Path, name: str, sha256: str) -> bytes:
    content = read_file(folder / name)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise StoreError(f"{folder / name}: it has changed since the cell finished")
    return content


def _variant(store: Store, variant_id: str) -> _Files:
    """Return the files of a variant as if it were trimmed, under a trimmed variant's name."""
    trimmed = trimmed_folder(store.variants, variant_id)
    folder = trimmed if trimmed.is_dir() else store.variants / variant_id
    if damage := trimming.verify_variant(folder):
        raise StoreError("; ".join(damage))
    modified = (folder / frozen.MANIFEST).lstat().st_mtime
    return {
        f"variants/{trimmed.name}/{name}": (read_file(folder / name, _MAX_POINTS_BYTES), modified)
        for name in (frozen.MANIFEST, frozen.POINTS, frozen.REPORT)
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
