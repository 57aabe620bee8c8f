"""Gives every parser of foreign files mutated valid files.

    python -m tests.hostile.fuzz_parsers [--parser NAME]... [--seed 0] [--count 10000]

Each input of a parser must be read, or be refused by one of the errors that the parser documents;
where these name the file, the message must. A parser may not take more than 1 CPU second or 256 MB
for an input. Each fault is printed with the seed that makes its input again: `--seed S --count 1`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from random import Random

from xrgs.safeio.confined import ConfinedPath

from tests.hostile import reference
from tests.hostile.mutations import (
    Mutation,
    mutate_bytes,
    mutate_csv,
    mutate_image,
    mutate_json,
    mutate_npz,
)
from xrgs import composing
from xrgs.capture import folders, images, variant
from xrgs.capture.lens import Lens
from xrgs.capture.restore import restore_images
from xrgs.errors import StoreError, XrgsError
from xrgs.experiment.cell_folder import CellFolder
from xrgs.experiment.store import Store
from xrgs.runtime import progress
from xrgs.safeio import npz, records, untrusted
from xrgs.splat.ply import load_ply
from xrgs.sweep import locks
from xrgs.training.checkpoint import Checkpoint

MAX_CPU_S = 1.0
MAX_BYTES = 256 << 20
#: Address space beyond what the process has; an input that wants more gets a MemoryError.
_ADDRESS_SPACE = 3 << 29


@dataclass(frozen=True)
class Parser:
    """A function that reads a file of anybody, and how to break that file."""

    file: Path
    """The file that is mutated and then read; its valid content is the first seed."""
    mutate: Mutation
    parse: Callable[[Path], object]
    errors: tuple[type[Exception], ...] = ()
    """The errors that it documents."""
    names: bool = True
    """Whether these errors name the file or its folder."""
    seeds: list[bytes] = field(default_factory=list)
    """More valid contents."""
    seal: Callable[[Path], object] = lambda _: None
    """Makes other files list the mutated one, so that it is not refused by its hash alone."""


@dataclass(frozen=True)
class Fault:
    """What a parser did wrong on one input."""

    parser: str
    seed: int
    what: str
    head: bytes
    """The begin of the input."""

    def __str__(self) -> str:
        return f"{self.parser} seed {self.seed}: {self.what}; input {self.head!a}"


# --- the parsers --------------------------------------------------------------------------------


def parsers(folder: Path) -> dict[str, Parser]:
    """Make a store and a file of each kind in a new folder, and return the parsers of them."""
    store = folder / "store"
    reference.build(store)
    cell = reference.cell_of(store)
    _add_running_files(cell, store)
    made = _of_cells(cell) | _of_stores(store, cell) | _of_variants(reference.variant_of(store))
    made |= _of_trimmed_variants(folder / "trimmed")
    return made | _of_images(folder / "images") | _of_arrays(folder, cell)


def _add_running_files(cell: Path, store: Path) -> None:
    """Add what a running cell has, and the report of a scene that failed."""
    now = progress.Progress("training", "step", 5, 60, 3.5)
    (cell / "progress.json").write_text(json.dumps(asdict(now)))
    failed = store / "variants" / "failed-0123456789abcdef"
    failed.mkdir()
    (failed / "report.json").write_text('{"scene": "a", "reason": "b", "registered": 3}')
    locks.sign(store / "locks" / f"{cell.name}.0")


def _of_cells(cell: Path) -> dict[str, Parser]:
    folder = CellFolder(cell)
    seal = partial(_seal_cell, cell)
    store_error = (StoreError,)
    return {
        "json": Parser(
            cell / "config.json",
            mutate_json,
            lambda file: untrusted.parse_json(file.read_bytes()),
            (ValueError,),
            names=False,
        ),
        "json-object": Parser(cell / "summary.json", mutate_json, records.read_object, store_error),
        "table": Parser(cell / "scores.csv", mutate_csv, records.read_table, store_error),
        "config": Parser(cell / "config.json", mutate_json, composing.from_file, (XrgsError,)),
        "progress": Parser(
            cell / "progress.json", mutate_json, lambda file: str(progress.read(ConfinedPath(file)))
        ),
        "status": Parser(cell / "status.json", mutate_json, lambda _: str(folder.state())),
        "scores": Parser(cell / "scores.csv", mutate_csv, lambda _: folder.scores(), store_error),
        "scores-sealed": Parser(
            cell / "scores.csv", mutate_csv, lambda _: str(folder.state()), seal=seal
        ),
        "history": Parser(
            cell / "history.csv",
            mutate_csv,
            lambda _: folder.history(),
            (OSError, ValueError, StoreError),
            names=False,
        ),
        "identity": Parser(
            cell / "identity.json", mutate_json, lambda _: folder.identity(), store_error
        ),
    }


def _of_stores(store: Path, cell: Path) -> dict[str, Parser]:
    sweep = reference.sweep_file(store)
    lock = store / "locks" / f"{cell.name}.0"
    seal = partial(_seal_cell, cell)
    table = partial(_table, store)
    return {
        "sweep": Parser(
            sweep, mutate_json, lambda f: Store(store).sweep_record(f.stem), (StoreError,)
        ),
        "sweep-names": Parser(
            sweep, mutate_json, lambda _: str(Store(store).records()), (StoreError,)
        ),
        "lock": Parser(lock, mutate_json, lambda file: str(locks.signature(file))),
        "locks": Parser(
            lock, mutate_json, lambda file: str(locks.holders(ConfinedPath(file.parent)))
        ),
        "cells-identity": Parser(cell / "identity.json", mutate_json, table, seal=seal),
        "cells-config": Parser(cell / "config.json", mutate_json, table, seal=seal),
        "cells-summary": Parser(cell / "summary.json", mutate_json, table, seal=seal),
        "failed-scene": Parser(
            store / "variants" / "failed-0123456789abcdef" / "report.json",
            mutate_json,
            lambda file: folders.failed_scenes(file.parents[1]),
        ),
    }


def _table(store: Path, _: Path) -> str:
    return Store(store).cells().to_csv()


def _seal_cell(cell: Path, _: Path) -> None:
    reference.seal(cell)


def _of_variants(folder: Path) -> dict[str, Parser]:
    def load_sealed(_: Path) -> object:
        sealed = folder
        with suppress(Exception):  # a variant that can't be sealed is tried as it is
            sealed = reference.seal_variant(folder)
        try:
            return variant.load(sealed)
        finally:
            sealed.rename(folder)

    def changed(name: str, mutate: Mutation, *, sealed: bool = True) -> Parser:
        load = load_sealed if sealed else (lambda _: variant.load(folder))
        return Parser(folder / name, mutate, load, (variant.CorruptVariant,))

    return {
        "variant": changed("variant.json", mutate_json),
        "variant-points": changed("points.npz", mutate_npz),
        "variant-report": changed("report.json", mutate_json),
        "variant-image": changed("images/train/left.png", mutate_image),
        "variant-unsealed": changed("variant.json", mutate_json, sealed=False),
    }


def _of_trimmed_variants(folder: Path) -> dict[str, Parser]:
    """A trimmed variant whose images are made again, of two photographs, one of them degraded."""
    photographs, trimmed, work = (folder / name for name in ("photographs", "trimmed", "work"))
    for made in (photographs, trimmed, work):
        made.mkdir(parents=True)
    for seed, name in enumerate(("left", "right")):
        reference.picture(seed, 60, 55).save(photographs / f"{name}.png")
    conf = composing.compose(
        "scene=folder", f"scene.path={photographs}", "variant.long_side=0", "variant.min_hr=1"
    )
    lens = Lens(60, 55, 70.0, 70.0, 30.0, 27.5, 0.01)
    views = [
        {"name": name, "split": split, "K": lens.resized(width, height).undistorted().K.tolist()}
        for name, split, width, height in (
            ("left", "original", 60, 55),
            ("left", "train", 12, 11),
            ("right", "test", 60, 55),
        )
    ]
    (trimmed / "variant.json").write_text(json.dumps({"views": views, "files": {}}))
    (trimmed / "report.json").write_text(json.dumps({"lenses": [repr(lens)]}))

    def restore(_: Path) -> list[str]:
        restored, store = ConfinedPath(trimmed), ConfinedPath(folder)
        restore_images(restored, conf.scene, conf.variant, ConfinedPath(work), store)
        return (restored / "images").names()

    return {
        "trimmed-variant": Parser(trimmed / "variant.json", mutate_json, restore, (XrgsError,)),
        "trimmed-report": Parser(trimmed / "report.json", mutate_json, restore, (XrgsError,)),
    }


def _of_images(folder: Path) -> dict[str, Parser]:
    folder.mkdir()
    picture = reference.picture(0, 9, 7)
    exif = picture.getexif()
    exif[0x0112] = 6
    exif[0x010F] = "a camera"
    contents = []
    for form in ("PNG", "JPEG", "BMP", "TIFF", "WEBP"):
        file = folder / f"image.{form}"
        picture.save(file, form, exif=exif)
        contents.append(file.read_bytes())
    (folder / "image").write_bytes(contents[0])
    looks = {
        "image-header": images.size,
        "image": images.read,
        "exif": images.exif_camera,
    }
    return {
        name: Parser(folder / "image", mutate_image, look, (images.ImageError,), seeds=contents)
        for name, look in looks.items()
    }


def _of_arrays(folder: Path, cell: Path) -> dict[str, Parser]:
    import torch

    class State:
        def state_dict(self) -> dict[str, object]:
            return {"means": torch.zeros(4, 3), "step": 3, "group": {"a": torch.ones(2)}}

        def load_state_dict(self, state: dict[str, object]) -> None:
            """Take nothing over."""

    file = folder / "checkpoint.npz"
    written = Checkpoint(file, "cell", 1e-9)
    written.register(state=State())
    written.save_if_due(3)
    checkpoint = Checkpoint(file, "cell")
    points = folder / "points.npz"
    points.write_bytes(next((folder / "store" / "variants").glob("*/points.npz")).read_bytes())
    return {
        "npz": Parser(points, mutate_npz, _read_npz, (OSError, ValueError), names=False),
        "checkpoint": Parser(file, mutate_npz, lambda _: checkpoint.load(), (XrgsError,)),
        "ply": Parser(cell / "splats.ply", mutate_ply, load_ply, (XrgsError,)),
    }


def _read_npz(file: Path) -> object:
    with file.open("rb") as stream:
        return npz.read(stream)


def mutate_ply(random: Random, content: bytes) -> bytes:
    """Change the lines of the header, or any bytes."""
    end = content.index(b"end_header\n") + len(b"end_header\n")
    if random.random() < 0.3:
        return mutate_bytes(random, content)
    if random.random() < 0.5:
        return mutate_bytes(random, content[:end]) + content[end:]
    lines = content[:end].splitlines(keepends=True)
    for _ in range(random.choice((1, 2, 40))):
        line = random.choice(lines)
        number = random.randrange(len(lines))
        lines[number] = random.choice((line, line + lines[number], b"", b"comment\n"))
    return b"".join(lines) + content[end:]


# --- the oracle ---------------------------------------------------------------------------------


def fuzz(name: str, parser: Parser, seeds: Iterable[int]) -> Iterator[Fault | None]:
    """Yield for each seed what the parser did wrong on its input; None where it did nothing wrong.

    The file is as it was before when the iterator ends.
    """
    valid = parser.file.read_bytes()
    others = {file: file.read_bytes() for file in _listing(parser.file)}
    try:
        for seed in seeds:
            random = Random(f"{name} {seed}")
            content = parser.mutate(random, random.choice([valid, *parser.seeds]))
            parser.file.write_bytes(content)
            parser.seal(parser.file)
            what = _fault(parser)
            for file, text in others.items():
                file.write_bytes(text)
            yield Fault(name, seed, what, content[:100]) if what else None
    finally:
        parser.file.write_bytes(valid)


def _listing(file: Path) -> list[Path]:
    """Return the files that list the hashes of a file."""
    near = (folder / name for folder in file.parents for name in ("status.json", "variant.json"))
    return [listing for listing in near if listing.is_file()]


def _fault(parser: Parser) -> str:
    """Return what is wrong with how a parser reads its file; empty if nothing is."""
    _reset_peak()
    before, started = _peak_rss(), time.process_time()
    what = _wrong_error(parser)
    seconds, grown = time.process_time() - started, _peak_rss() - before
    if seconds > MAX_CPU_S:
        return f"took {seconds:.1f} CPU seconds"
    if grown > MAX_BYTES:
        return f"took {grown >> 20} MB"
    return what


def _wrong_error(parser: Parser) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            parser.parse(parser.file)
    except parser.errors as error:
        if _out_of_memory(error):
            return "wanted more memory than there is"
        named = str(error)
        wanted = (str(parser.file.parent), parser.file.name)
        if parser.names and not any(name in named for name in wanted):
            return f"the message does not name the file: {named!a:.200}"
        return ""
    except Exception as error:
        return f"{type(error).__name__}: {error!s:.200}".encode("ascii", "replace").decode()
    return ""


def _out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _reset_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_rss() -> int:
    with Path("/proc/self/status").open("rb") as status:
        return next(int(line.split()[1]) << 10 for line in status if line.startswith(b"VmHWM"))


@contextmanager
def limited_memory() -> Iterator[None]:
    """Limit the address space of this process, so that a bomb gets a MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + _ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Fuzz the parsers of foreign files.")
    parser.add_argument("--parser", action="append", default=[], help="by default all")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--count", type=int, default=10_000, help="the inputs of each parser")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    kinds: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="xrgs-fuzz-") as folder, limited_memory():
        known = parsers(Path(folder))
        for name in options.parser or known:
            seeds = range(options.seed, options.seed + options.count)
            faults = 0
            for fault in fuzz(name, known[name], seeds):
                if fault is None:
                    continue
                faults += 1
                kind = f"{name}: {re.sub('[0-9]+', 'N', fault.what)[:60]}"
                kinds[kind] += 1
                if kinds[kind] == 1:
                    print(fault, flush=True)  # noqa: T201
            print(f"{name}: {options.count} inputs, {faults} faults", flush=True)  # noqa: T201
    for kind, count in kinds.items():
        print(f"{count:8}  {kind}")  # noqa: T201
    return bool(kinds)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
