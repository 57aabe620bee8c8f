"""Writes, verifies and reads the folder of a frozen variant, without importing torch.

The name of the folder is the variant's id. `variant.json` (`Manifest`) lists the views and the
hashes of the other files that affect training: `images/<split>/<view>.png`,
`images/<split>-masks/<view>.png` for views with a mask, and `points.npz` with the SfM points and,
for given poses, the transform from their world. `report.json` has the results of SfM, and
`colmap.log` is COLMAP's log.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from xrgs.errors import StoreError, UnreadableError, XrgsError
from xrgs.mixture.views import MIN_POINTS, Variant, View
from xrgs.safeio import checksums, npz
from xrgs.safeio.atomic import atomic_writer, write_json
from xrgs.safeio.files import sync_name, sync_tree
from xrgs.safeio.hashing import digest
from xrgs.safeio.records import errors_named, read_struct
from xrgs.safeio.sanitize import for_line

MANIFEST, POINTS, REPORT, LOG = "variant.json", "points.npz", "report.json", "colmap.log"
#: Largest coordinate of a point, whose square must fit in float32.
_MAX_COORDINATE = 1e12

_Side = Annotated[int, Meta(ge=1, le=1 << 16)]
_Row3 = Annotated[list[float], Meta(min_length=3, max_length=3)]
_Row4 = Annotated[list[float], Meta(min_length=4, max_length=4)]


class ViewEntry(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A view in `variant.json`; see `xrgs.mixture.views.View`."""

    name: Annotated[str, Meta(min_length=1)]
    split: Literal["train", "test", "original"]
    file: str
    tag: Literal["HR", "LR"]
    width: _Side
    height: _Side
    K: Annotated[list[_Row3], Meta(min_length=3, max_length=3)]
    viewmat: Annotated[list[_Row4], Meta(min_length=4, max_length=4)]
    sampling_rate: Annotated[float, Meta(gt=0, le=1)] = msgspec.field(name="rho")
    mask: str | None = None
    supersampling: Annotated[float, Meta(gt=0)] = msgspec.field(name="need", default=1.0)


class Manifest(Struct, frozen=True, forbid_unknown_fields=True):
    """The content of `variant.json`; see `xrgs.mixture.views.Variant`."""

    key: str
    scene: str
    factor: Annotated[int, Meta(ge=1)]
    held_out: bool
    views: Annotated[tuple[ViewEntry, ...], Meta(min_length=1)]
    files: dict[str, str]
    """Path of a file in the folder, with `/` -> its SHA-256."""
    id: str = ""
    code: dict[str, str] = {}
    """Part of the code that made the variant -> its digest; empty in older variants."""

    def computed_id(self) -> str:
        """Return the id: the key, then a hash of the content that affects training."""
        content = msgspec.to_builtins(self)
        hashed = {k: v for k, v in content.items() if k not in ("id", "scene", "code")}
        return f"{self.key}-{digest(hashed)}"


class CorruptVariant(XrgsError):  # noqa: N818
    """A frozen variant is damaged or was changed; the message names the file."""


def freeze(made: Variant, key: str, folder: Path, variants: Path, code: dict[str, str]) -> Variant:
    """Write a variant's data into the folder of its images, and rename the folder to its id.

    All files are synced to the disk before the folder is renamed. The result is loaded from its
    final folder.

    Args:
        made: The variant; its id is ignored.
        key: The variant's key (`xrgs.mixture.variant.key`).
        folder: The folder of its images, on the same disk as `variants`.
        variants: The parent of the final folder.
        code: Part of the code that made the variant -> its digest.
    """
    with atomic_writer(folder / POINTS, durable=False) as stream:
        if np.array_equal(made.world, np.eye(4)):
            np.savez(stream, points=made.points, colors=made.colors)
        else:
            np.savez(stream, points=made.points, colors=made.colors, world=made.world)
    write_json(folder / REPORT, made.report, durable=False)
    views = tuple(_entry(folder, view) for view in made.views)
    manifest = Manifest(
        key=key,
        scene=made.scene,
        factor=made.factor,
        held_out=made.held_out,
        views=views,
        files=checksums.hashes(folder, [POINTS, *_pictures(views)]),
        code=code,
    )
    manifest = msgspec.structs.replace(manifest, id=manifest.computed_id())
    write_json(folder / MANIFEST, msgspec.to_builtins(manifest), durable=False)
    sync_tree(folder)
    home = variants / manifest.id
    folder.rename(home)
    sync_name(home)
    return load(home)


def load(folder: Path) -> Variant:
    """Verify all hashes of a frozen variant, and load it.

    Raises:
        UnreadableError: A file can't be read at the moment; the variant may be intact.
        CorruptVariant: A file is missing or has changed, or the folder's name is not the variant's
            id.
    """
    with _errors_as_corrupt():
        manifest = read_manifest(folder)
        for error in checksums.changed(folder, manifest.files):
            raise error
        return _assembled(folder, manifest)


def verify(folder: Path) -> list[str]:
    """Return a line for each file of a variant that is missing, changed, unreadable or unlisted."""
    errors: list[XrgsError] = []
    try:
        with _errors_as_corrupt():
            manifest = read_manifest(folder)
            errors += checksums.changed(folder, manifest.files)
            errors += checksums.unlisted(folder, {MANIFEST, REPORT, LOG, *manifest.files})
            if not errors:
                _assembled(folder, manifest)
    except XrgsError as error:
        errors.append(error)
    return [for_line(str(error)) for error in errors]


def read_manifest(folder: Path) -> Manifest:
    """Read and check `variant.json`; StoreError if it is damaged or not of this folder."""
    file = folder / MANIFEST
    manifest = read_struct(file, Manifest)
    if manifest.id != manifest.computed_id():
        raise StoreError(f"{file}: it has changed since it was written")
    names = {(view.split, view.name) for view in manifest.views}
    if len(names) < len(manifest.views):
        raise StoreError(f"damaged: {file}: views: two of a split have one name")
    if manifest.files.keys() != {POINTS, *_pictures(manifest.views)}:
        raise StoreError(f"damaged: {file}: files: they are not the views' files and {POINTS}")
    if missing := {"train", "test"} - {view.split for view in manifest.views}:
        raise StoreError(f"damaged: {file}: views: none is to {min(missing)}")
    # The path may be a link or `.`; the folder of a trimmed variant has a prefix.
    names_of_folder = (folder.name, folder.resolve().name)
    if not any(name.endswith(manifest.id) for name in names_of_folder):
        raise StoreError(f"{folder}: this folder has another name than its variant {manifest.id}")
    return manifest


@contextmanager
def _errors_as_corrupt() -> Iterator[None]:
    """Raise `UnreadableError` for transient errors, and `CorruptVariant` for others."""
    try:
        yield
    except UnreadableError as error:
        raise UnreadableError(f"{error}; try again") from error
    except StoreError as error:
        raise CorruptVariant(str(error)) from error


def _assembled(folder: Path, manifest: Manifest) -> Variant:
    """Read points and report, and build the variant."""
    file = folder / POINTS
    try:
        with errors_named(file), file.open("rb") as stream:
            arrays = npz.read(stream)
        points, colors = arrays["points"], arrays["colors"]
        world = arrays.get("world", np.eye(4))
    except (ValueError, KeyError) as error:
        raise StoreError(
            f"damaged: {file}: not the points of a variant ({error!r:.200})"
        ) from error
    if points.dtype != np.float64 or points.shape != (points.size // 3, 3):
        raise StoreError(
            f"damaged: {file}: points: {points.dtype} {points.shape}, not float64 [P, 3]"
        )
    if len(points) < MIN_POINTS:
        raise StoreError(f"damaged: {file}: points: {len(points)}, at least {MIN_POINTS} needed")
    if colors.dtype != np.uint8 or colors.shape != points.shape:
        raise StoreError(
            f"damaged: {file}: colors: {colors.dtype} {colors.shape}, not uint8 [P, 3]"
        )
    if not (np.abs(points) <= _MAX_COORDINATE).all():
        raise StoreError(f"damaged: {file}: points: not finite, or beyond {_MAX_COORDINATE:g}")
    if world.dtype != np.float64 or world.shape != (4, 4) or not np.isfinite(world).all():
        raise StoreError(f"damaged: {file}: world: {world.dtype} {world.shape}, not float64 [4, 4]")
    return Variant(
        manifest.id,
        folder,
        manifest.scene,
        manifest.factor,
        manifest.held_out,
        tuple(_view(folder, entry) for entry in manifest.views),
        points,
        colors,
        read_struct(folder / REPORT, dict[str, Any]),
        world,
    )


def _pictures(views: Iterable[ViewEntry]) -> list[str]:
    """Return the sorted paths of the views' images and masks in the folder."""
    return sorted({name for view in views for name in (view.file, view.mask) if name is not None})


def _entry(folder: Path, view: View) -> ViewEntry:
    files = {
        key: None if path is None else path.relative_to(folder).as_posix()
        for key, path in (("file", view.file), ("mask", view.mask))
    }
    arrays = {"K": view.K.tolist(), "viewmat": view.viewmat.tolist()}
    return ViewEntry(**(vars(view) | files | arrays))


def _view(folder: Path, entry: ViewEntry) -> View:
    arrays: dict[str, NDArray[np.float64]] = {
        "K": np.array(entry.K, dtype=np.float64),
        "viewmat": np.array(entry.viewmat, dtype=np.float64),
    }
    files = {"file": folder / entry.file, "mask": entry.mask and folder / entry.mask}
    return View(**(msgspec.structs.asdict(entry) | files | arrays))
