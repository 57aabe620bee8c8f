"""Runs the benchmark, and writes the results: text, two .csv files, a plot and a .json file."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from xrgs.bench import against, loads, plot, rendering, tables, training
from xrgs.errors import XrgsError
from xrgs.report.figures import png
from xrgs.runtime.machine import usable_cores
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import atomic_writer, write_json
from xrgs.safeio.files import check_writable
from xrgs.safeio.records import table_text
from xrgs.safeio.sanitize import for_csv
from xrgs.splat.backend import resolve_backend
from xrgs.splat.settings import outside_limits
from xrgs.store import provenance

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from xrgs.bench.loads import Load
    from xrgs.bench.settings import Settings
    from xrgs.bench.timing import Row


class BenchmarkSizes(NamedTuple):
    """The sizes of the random loads: numbers of Gaussians, and widths and heights in px."""

    gaussians: tuple[int, ...]
    """Numbers of Gaussians; each is rendered at each of the image sizes."""
    images: tuple[tuple[int, int], ...]
    step: tuple[int, int, int]
    """Load of the training step and of the shortcuts."""
    memory: tuple[int, int, int]
    """Load of the training step for the measurement of memory."""
    scene: tuple[int, int, int]
    """Load that `against` renders."""


FULL = BenchmarkSizes(
    gaussians=(10_000, 100_000, 300_000, 1_000_000),
    images=((252, 189), (504, 378), (1008, 756)),
    step=(100_000, 504, 378),
    memory=(300_000, 1008, 756),
    scene=(57_000, 696, 521),
)
SMOKE = BenchmarkSizes(
    gaussians=(200, 400),
    images=((32, 24), (48, 36)),
    step=(300, 80, 60),
    memory=(20_000, 64, 48),
    scene=(300, 80, 60),
)
#: `size_per_spacing` of the random scene of `against`: 56 Gaussians contribute to a pixel, as in a
#: trained scene of llff/fern with the same numbers of Gaussians and pixels.
SCENE_SIZE_PER_SPACING = 1.88
_LR_FACTOR = 5


def run(settings: Settings) -> str:
    """Run the benchmark, or instead `save` or `against`, if set.

    Returns:
        The text to print.

    Raises:
        XrgsError: An argument is wrong, or a file cannot be read or written.
    """
    for message in outside_limits(settings):
        raise XrgsError(message)
    if settings.save is not None:
        return _save(settings.save, settings)
    if settings.cell is not None or settings.view is not None:
        raise XrgsError("--cell and --view are for --save FILE.npz, whose file --load measures")
    counts = sorted({1, settings.threads or usable_cores()})
    sizes = SMOKE if settings.smoke else FULL
    load = None if settings.load is None else loads.read(settings.load)
    _check_writable(settings)  # before minutes of measurements
    if settings.against is not None:
        return _compare(settings.against, load, sizes, counts, settings)
    results = _measure(load, sizes, counts, settings)
    files = {
        "bench.csv": _csv(results["rows"]),
        "shortcuts.csv": _csv(results["shortcuts"] + results["step_shortcuts"]),
        "bench.png": png(plot.draw(results)),
    }
    _write(files, results, settings)
    return tables.text(results)


def _save(file: Path, settings: Settings) -> str:
    if settings.cell is None or settings.view is None:
        raise XrgsError("--save FILE.npz needs --cell FOLDER and --view NAME")
    load = loads.load_from_cell(settings.cell, settings.view)
    loads.write(file, load)
    return f"{file}: {tables.describe(load.sizes)}"


def _compare(
    python: Path,
    load: Load | None,
    sizes: BenchmarkSizes,
    counts: Sequence[int],
    settings: Settings,
) -> str:
    scene, step = load, loads.random_load(*sizes.step, settings.seed)
    if scene is None:
        scene = loads.random_load(*sizes.scene, settings.seed, SCENE_SIZE_PER_SPACING)
    views = (step, step.downscaled(_LR_FACTOR))
    result = against.measure(python, scene, views, counts, settings.repeats)
    _write({"against.csv": _csv(result["rows"])}, result, settings)
    return tables.against(result)


def _measure(
    load: Load | None, sizes: BenchmarkSizes, counts: Sequence[int], settings: Settings
) -> dict[str, Any]:
    """Return name -> result: a list of rows, or a single row."""
    backends = ["native", "torch"] if resolve_backend("auto") == "native" else ["torch"]
    backend, repeats = backends[0], settings.repeats
    if load is None:
        step = loads.random_load(*sizes.step, settings.seed)
        rendered = [
            loads.random_load(count, *size, settings.seed)
            for size in sizes.images
            for count in sizes.gaussians
        ]
    else:
        step, rendered = load, [load]
    methods = rendering.default_methods(backends)
    rows: list[Row] = []
    for one in progress(rendered, "rendering", "load", len(rendered)):
        rows += rendering.time_load(one, methods, counts, repeats)
    if not rows:
        raise XrgsError(
            f"--load {settings.load}: too large to time the torch backend on; build the native one"
        )
    views = {"HR": step, "LR": step.downscaled(_LR_FACTOR)}
    shortcuts: list[Row] = []
    for view in views.values():
        shortcuts += rendering.time_shortcuts(view, backend, repeats)
    results = {
        "machine": msgspec.to_builtins(provenance.collect(counts[-1], backend)),
        "rows": rows,
        "growth": rendering.fit_growth(rows),
        "steps": training.time_steps(views, backend, counts, repeats),
        "shortcuts": shortcuts,
        "step_shortcuts": training.time_shortcuts(step, backend, repeats),
    }
    if load is None:
        results["memory"] = training.measure_memory(backend, *sizes.memory, counts[-1])
    return results


def _csv(rows: Sequence[Row]) -> bytes:
    safe = [{key: for_csv(value) for key, value in row.items()} for row in rows]
    return table_text(safe).encode()


def _check_writable(settings: Settings) -> None:
    """Make the folders of the results, and check that files can be written there."""
    files = [settings.out / "bench.csv", *filter(None, [settings.json])]
    with _writing():
        for file in files:
            file.parent.mkdir(parents=True, exist_ok=True)
            check_writable(file.parent)


def _write(files: Mapping[str, bytes], results: dict[str, Any], settings: Settings) -> None:
    with _writing():
        for name, content in files.items():
            with atomic_writer(settings.out / name) as stream:
                stream.write(content)
        if settings.json is not None:
            write_json(settings.json, results)


@contextmanager
def _writing() -> Iterator[None]:
    """Turn errors of writing into an error that names the file."""
    try:
        yield
    except OSError as error:
        raise XrgsError(f"{error.filename}: cannot be written: {error.strerror}") from error
