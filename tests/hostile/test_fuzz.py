"""Mutated files: each parser reads them, or refuses them by the error that it documents.

Foreign files (photographs, .ply, poses, weights, archives) and the store's own files are changed at
random, or cut at every place. A parser may not raise another error, take 2 CPU seconds, or need
1 GB. `-m exhaustive` tries two hundred times as many files.
"""

from __future__ import annotations

import io
import json
import pickle
import resource
import shutil
import tarfile
import tempfile
import time
import warnings
import zlib  # pycolmap corrupts the heap where it is imported before zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

import msgspec
import numpy as np
import pillow_heif
import pycolmap
import pytest
import tifffile
import torch

from tests import reference_store
from tests.hostile.mutations import (
    Mutation,
    mutate_bytes,
    mutate_csv,
    mutate_image,
    mutate_json,
    mutate_npz,
)
from tests.photos.made_files import DISPLAY_P3, png, profile
from xrgs import composing
from xrgs.errors import StoreError, XrgsError
from xrgs.evaluation.lpips import weights
from xrgs.formats.files import load_gaussians, save_gaussians
from xrgs.mixture import colmap, poses, saved_variant
from xrgs.mixture.paths import read_failure
from xrgs.mixture.photographs import PhotoCollection, prepare_hr_views
from xrgs.photos import exif, images
from xrgs.photos.scenes import Scene
from xrgs.photos.scenes.rendered import RenderedScene
from xrgs.runtime import lease, progress
from xrgs.safeio import npz
from xrgs.safeio.records import read_struct, read_table
from xrgs.splat.gaussians import PARAMETERS
from xrgs.store.archive import import_store
from xrgs.store.schema import Identity, Provenance, Status, Summary, SweepRecord
from xrgs.store.store import Store
from xrgs.training.checkpoint import Checkpoint

pillow_heif.register_heif_opener()
MAX_CPU_S = 2.0
#: Address space, in bytes, beyond what the process has; a file that needs more gets a MemoryError.
_ADDRESS_SPACE = 1 << 30
#: The most cuts of a file that are tried: at every byte of a small one, evenly spaced in others.
_MAX_CUTS = 25


@dataclass(frozen=True)
class Parser:
    """A function that reads a file, a valid file for it, and how to change that file."""

    valid: Callable[[Path], bytes]
    """Returns a valid content; it is given the folder of the reference store."""
    mutate: Mutation
    parse: Callable[[Path], object]
    errors: tuple[type[Exception], ...] = (XrgsError,)
    count: int = 50


def photograph(form: str) -> Callable[[Path], bytes]:
    def valid(_: Path) -> bytes:
        picture, stream = reference_store.picture(0, 9, 7), io.BytesIO()
        exif = picture.getexif()
        exif[0x0112], exif[0x010F] = 6, "a camera"
        picture.save(stream, form, exif=exif)
        return stream.getvalue()

    return valid


def deep(_: Path) -> bytes:
    """A PNG of 16 bits and alpha, with a profile."""
    samples = np.random.default_rng(0).integers(0, 65536, (7, 9, 4))
    icc = b"P3\0\0" + zlib.compress(profile("P3", 2.2, DISPLAY_P3))
    return png(samples, (b"sBIT", bytes([12] * 4)), (b"iCCP", icc))


def deep_tiff(_: Path) -> bytes:
    """A TIFF of 16 bits, with a profile."""
    stream, samples = io.BytesIO(), np.linspace(0, 65535, 30 * 40 * 3).reshape(30, 40, 3)
    icc = profile("P3", 2.2, DISPLAY_P3)
    tifffile.imwrite(stream, samples.astype(np.uint16), photometric="rgb", iccprofile=icc)
    return stream.getvalue()


def look(file: Path) -> None:
    size, _ = images.size(file), exif.read(file)
    assert images.read(file).shape[1::-1] == size
    with suppress(images.ImageError):
        images.read_png(file)


def finite(file: Path) -> None:
    read = load_gaussians(file).gaussians
    assert all(torch.isfinite(read[name]).all() for name in PARAMETERS)


def of_store(pattern: str) -> Callable[[Path], bytes]:
    return lambda store: next(store.glob(pattern)).read_bytes()


def struct(kind: type) -> Callable[[Path], object]:
    return lambda file: read_struct(file, kind)


def points(_: Path) -> bytes:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    return (header + "end_header\n").encode() + bytes(75)


def gaussians(suffix: str) -> Parser:
    """A file of Gaussians that `xrgs-data export` writes."""

    def valid(store: Path) -> bytes:
        read = load_gaussians(next(store.glob("cells/*/splats.ply")))
        save_gaussians(store / f"splats{suffix}", read.gaussians)
        return (store / f"splats{suffix}").read_bytes()

    return Parser(valid, mutate_bytes, finite)


def transforms(_: Path) -> bytes:
    frames = []
    for place, name in enumerate("ab"):
        matrix = np.eye(4)
        matrix[0, 3] = place
        frames.append({"file_path": f"{name}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0, "k1": 0.01}
    return json.dumps(lens | {"ply_file_path": "points.ply", "frames": frames}).encode()


def poses_of(file: Path) -> object:
    return poses.read_poses(str(file), photographs(file.parent))


#: A model of COLMAP, of two images and five points.
TEXT_MODEL = {
    "cameras.txt": "1 OPENCV 40 30 50 50 20 15 0.1 0 0.01 0\n",
    "images.txt": "".join(
        f"{i} 1 0 0 0 {i} 0 4 1 {name}.png\n3 4 1 5 6 -1\n" for i, name in enumerate("ab", 1)
    ),
    "points3D.txt": "".join(
        f"{i} {i} 0 1 90 80 70 0.5{' 1 0 2 0' * (i == 1)}\n" for i in range(1, 6)
    ),
}


def model_of(file: Path) -> object:
    """Read the poses of a model, of which one file may be mutated."""
    names = [name.replace(".txt", file.suffix) for name in TEXT_MODEL]
    for name in set(names) - {file.name}:
        if not (file.parent / name).exists():
            (file.parent / name).write_bytes(colmap_file(name)(file.parent))
    return poses.read_poses(str(file.parent), photographs(file.parent))


def colmap_file(name: str) -> Callable[[Path], bytes]:
    def content(_: Path) -> bytes:
        if name in TEXT_MODEL:
            return TEXT_MODEL[name].encode()
        with tempfile.TemporaryDirectory() as folder:
            for text_name, text in TEXT_MODEL.items():
                (Path(folder) / text_name).write_text(text)
            pycolmap.Reconstruction(folder).write_binary(folder)
            return (Path(folder) / name).read_bytes()

    return content


@cache
def photographs(folder: Path) -> PhotoCollection:
    """Two photographs, and the points that `transforms` names."""
    files = {name: folder / f"{name}.png" for name in "ab"}
    for seed, file in enumerate(files.values()):
        reference_store.picture(seed, 40, 30).save(file)
    (folder / "points.ply").write_bytes(points(folder))
    (folder / "work").mkdir()
    changes = ("scene.path=x", "variant.long_side=0", "variant.factor=2")
    conf = composing.compose("scene=folder", *changes).variant
    return prepare_hr_views(Scene("x", "", files), conf, folder / "work")


def pickled(_: Path) -> bytes:
    return pickle.dumps({"a": np.arange(6.0), "b": [1, "c", None]}, protocol=4)


def arrays(_: Path) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, a=np.arange(6.0), b=np.zeros((2, 3), np.float32))
    return stream.getvalue()


def checkpoint(store: Path) -> bytes:
    class State:
        def state_dict(self) -> dict[str, object]:
            return {"means": torch.zeros(4, 3), "step": 3, "group": {"a": torch.ones(2)}}

        def load_state_dict(self, state: dict[str, object]) -> None:
            """Take nothing over."""

    written = Checkpoint(store / "checkpoint.npz", "cell", 1e-9)
    written.register(state=State())
    written.save_if_due(3)
    return (store / "checkpoint.npz").read_bytes()


def archive(store: Path) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as opened:
        for name in ("cells", "sweeps", "variants"):
            opened.add(store / name, name)
    return stream.getvalue()


def import_archive(file: Path) -> None:
    imported = Store(file.with_name("imported"))
    shutil.rmtree(imported.path, ignore_errors=True)
    import_store(file, imported)
    assert all(cell.state().name == "done" for cell in imported.cell_folders())
    assert all(saved_variant.verify(folder) == [] for folder in imported.variants.iterdir())


def read_npz(file: Path) -> object:
    with file.open("rb") as stream:
        return npz.read(stream)


def now(_: Path) -> bytes:
    return msgspec.json.encode(progress.Progress("training", "step", 5, 60, 3.5))


def scene(_: Path) -> bytes:
    return json.dumps({"fingerprint": "a", "files": {"a.png": "b"}}).encode()


def failure(_: Path) -> bytes:
    return b'{"scene": "a", "reason": "b", "registered": 3}'


def owner(store: Path) -> bytes:
    file = store / "owner.0"
    file.unlink(missing_ok=True)
    lease.sign(file)
    return file.read_bytes()


PARSERS = {
    # Foreign files
    **{
        form: Parser(photograph(form), mutate_image, look, (images.ImageError,))
        for form in ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
    },
    "deep.png": Parser(deep, mutate_image, look, (images.ImageError,)),
    "deep.tif": Parser(deep_tiff, mutate_bytes, look, (images.ImageError,)),
    "HEIF": Parser(photograph("HEIF"), mutate_bytes, look, (images.ImageError,)),
    **{f"splats{suffix}": gaussians(suffix) for suffix in (".glb", ".spz")},
    "splats.ply": Parser(of_store("cells/*/splats.ply"), mutate_bytes, finite),
    "points.ply": Parser(points, mutate_bytes, colmap.read_points),
    "transforms.json": Parser(transforms, mutate_json, poses_of),
    **{
        name: Parser(colmap_file(name), mutate_bytes, model_of)
        for text_name in TEXT_MODEL
        for name in (text_name, text_name.replace(".txt", ".bin"))
    },
    "weights.pickle": Parser(
        pickled, mutate_bytes, lambda file: weights.read_pickle(file.read_bytes(), "file")
    ),
    "arrays.npz": Parser(arrays, mutate_npz, read_npz, (OSError, ValueError)),
    "archive.tar": Parser(archive, mutate_bytes, import_archive, (StoreError,), count=10),
    # Files of a store
    "config.json": Parser(of_store("cells/*/config.json"), mutate_json, composing.from_file),
    "scores.csv": Parser(of_store("cells/*/scores.csv"), mutate_csv, read_table, (StoreError,)),
    "checkpoint.npz": Parser(
        checkpoint, mutate_npz, lambda file: Checkpoint(file, "cell").load(), (XrgsError,)
    ),
    "progress.json": Parser(now, mutate_json, lambda file: str(progress.read(file)), ()),
    "owner.0": Parser(owner, mutate_json, lambda file: str(lease.holders(file.parent)), ()),
    "report.json": Parser(failure, mutate_json, lambda file: read_failure(file.parent)),
    "scene.json": Parser(scene, mutate_json, struct(RenderedScene), (StoreError,)),
    **{
        pattern: Parser(of_store(pattern), mutate_json, struct(kind), (StoreError,))
        for pattern, kind in {
            "cells/*/status.json": Status,
            "cells/*/identity.json": Identity,
            "cells/*/summary.json": Summary,
            "cells/*/provenance.json": Provenance,
            "sweeps/*.json": SweepRecord,
            "variants/*/variant.json": saved_variant.Manifest,
        }.items()
    },
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fuzz")
    reference_store.build(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_mutated_and_cut_files_are_read_or_refused(store: Path, tmp_path: Path, name: str) -> None:
    parser = PARSERS[name]
    try_files(name, parser, store, tmp_path, range(parser.count))
    valid = parser.valid(store)
    cuts = range(0, len(valid), max(1, len(valid) // _MAX_CUTS))
    try_contents(name, parser, store, tmp_path, ((f"cut {n}", valid[:n]) for n in cuts))


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("name", PARSERS)
def test_many_mutated_files_are_read_or_refused(store: Path, tmp_path: Path, name: str) -> None:
    try_files(name, PARSERS[name], store, tmp_path, range(200 * PARSERS[name].count))


def test_a_parser_with_another_error_is_found(store: Path, tmp_path: Path) -> None:
    careless = Parser(scene, mutate_json, lambda file: json.loads(file.read_bytes())["files"])
    with pytest.raises(AssertionError, match="seed"):
        try_files("scene.json", careless, store, tmp_path, range(100))


def try_files(name: str, parser: Parser, store: Path, folder: Path, seeds: range) -> None:
    """Fail at the first mutated file that is neither read nor refused; `seed` makes it again."""
    valid = parser.valid(store)
    contents = ((f"seed {seed}", parser.mutate(Random(f"{name} {seed}"), valid)) for seed in seeds)
    try_contents(name, parser, store, folder, contents)


def try_contents(
    name: str, parser: Parser, store: Path, folder: Path, contents: Iterable[tuple[str, bytes]]
) -> None:
    """Fail at the first of the named contents that a parser neither reads nor refuses."""
    file = folder / Path(name).name.replace("*", "x")
    file.write_bytes(parser.valid(store))
    parser.parse(file)
    for how, content in contents:
        file.write_bytes(content)
        began = time.process_time()
        try:
            with warnings.catch_warnings(), bounded_memory():
                warnings.simplefilter("error")
                parser.parse(file)
        except parser.errors:
            pass
        except Exception as error:
            raise AssertionError(f"{how}: {error!r:.200}; {content[:100]!a}") from error
        assert time.process_time() - began < MAX_CPU_S, f"{how}: {content[:100]!a}"


@contextmanager
def bounded_memory() -> Iterator[None]:
    """Let memory beyond what this process has and 1 GB be refused."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(
        resource.RLIMIT_AS, (pages * resource.getpagesize() + _ADDRESS_SPACE, before[1])
    )
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
