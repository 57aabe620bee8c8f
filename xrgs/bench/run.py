"""Runs the benchmark and writes its results: a table, two .csv files, a plot and a .json."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from xrgs.bench import (
    against,
    growth,
    instructions,
    loads,
    memory,
    panels,
    rendering,
    scale,
    shortcuts,
    tables,
    training,
)
from xrgs.errors import XrgsError
from xrgs.experiment import provenance
from xrgs.runtime.machine import peak_rss, usable_cores
from xrgs.runtime.progress import progress
from xrgs.safeio.atomic import write_json
from xrgs.safeio.records import table_text
from xrgs.safeio.sanitize import for_csv
from xrgs.splat.backend import resolve_backend

if TYPE_CHECKING:
    from collections.abc import Sequence

    from xrgs.bench.loads import Load
    from xrgs.bench.settings import Settings
    from xrgs.bench.tables import Row


class BenchmarkSizes(NamedTuple):
    """The sizes of what is measured; a load is every number of Gaussians at every image size."""

    gaussians: tuple[int, ...]  # numbers of Gaussians
    sizes: tuple[tuple[int, int], ...]  # width and height, px
    step: tuple[int, int, int]  # Gaussians, width and height of the timed training step
    views: tuple[int, ...]  # numbers of views rendered one after the other
    memory: tuple[int, int, int]  # Gaussians, width and height of the step whose memory is measured
    scene: tuple[int, int, int]  # Gaussians, width and height of the scene of `against`


FULL = BenchmarkSizes(
    gaussians=(10_000, 100_000, 300_000, 1_000_000),
    sizes=((252, 189), (504, 378), (1008, 756)),
    step=(100_000, 504, 378),
    views=(1, 2, 4, 8),
    memory=(300_000, 1008, 756),
    scene=(57_000, 696, 521),
)
SMOKE = BenchmarkSizes(
    gaussians=(200, 400),
    sizes=((32, 24), (48, 36)),
    step=(300, 80, 60),
    views=(1, 2),
    memory=(300, 80, 60),
    scene=(300, 80, 60),
)
_LR_FACTOR = 5
#: Makes 56 Gaussians contribute to a pixel of the scene of `against`, as in a trained scene of
#: llff/fern with as many Gaussians and pixels.
_SCENE_SIZE_PER_SPACING = 1.88


def run(settings: Settings) -> str:
    """Run what the settings choose: the benchmark, `save`, `quality`, `store_cells` or `against`.

    Args:
        settings: The arguments of `xrgs-bench`.

    Returns:
        The text to print.

    Raises:
        XrgsError: An argument is wrong, or a file cannot be read or written.
    """
    if settings.save is not None:
        return _save(settings)
    if settings.quality:
        return _quality(settings)
    if settings.store_cells:
        return _scale(settings)
    if settings.repeats < 1 or settings.threads < 0:
        raise XrgsError("repeats must be at least 1 and threads at least 0")
    counts = sorted({1, settings.threads or usable_cores()})
    if settings.against is not None:
        return _against(settings.against, settings, counts)
    backends = ["native", "torch"] if resolve_backend("auto") == "native" else ["torch"]
    results: dict[str, Any] = {"machine": _machine(backends, counts)}
    if settings.load is not None:
        load = loads.read(Path(settings.load))
        results |= _time_loads([load], settings, counts, backends)
        results["shortcuts"] = _time_shortcuts(load, settings, backends)
    else:
        sizes = SMOKE if settings.smoke else FULL
        chosen = [
            loads.random_load(count, *size, settings.seed)
            for size in sizes.sizes
            for count in sizes.gaussians
        ]
        results |= _time_loads(chosen, settings, counts, backends)
        results |= _time_training(sizes, settings, counts, backends)
        results["memory"] = [memory.measure(*sizes.memory, backends[0], counts[-1], settings.seed)]
    _add_shares_of_peak(results)
    results["peak_rss_bytes"] = peak_rss()
    _write(results, settings)
    return tables.text(results)


def _save(settings: Settings) -> str:
    if settings.save is None or settings.cell is None or settings.view is None:
        raise XrgsError("--save FILE.npz needs --cell FOLDER and --view NAME")
    load = loads.load_from_cell(Path(settings.cell), settings.view)
    loads.write(Path(settings.save), load)
    size = f"{load.camera.width} x {load.camera.height} px"
    return f"{settings.save}: {len(load)} Gaussians, {size}"


def _scale(settings: Settings) -> str:
    result = scale.measure(settings.store_cells, Path(settings.out))
    if settings.json is not None:
        _write_json(settings.json, {"scale": result})
    return scale.text(result)


def _quality(settings: Settings) -> str:
    from xrgs.bench import quality
    from xrgs.bench.timing import use_threads

    if settings.cell is None or settings.steps < 1:
        raise XrgsError("--quality needs --cell FOLDER and --steps of at least 1")
    with use_threads(settings.threads or usable_cores()):
        rows = quality.compare(Path(settings.cell), settings.steps)
    if settings.json is not None:
        _write_json(settings.json, {"quality": rows})
    return tables.quality(rows)


def _against(other: str, settings: Settings, counts: Sequence[int]) -> str:
    sizes, seed = SMOKE if settings.smoke else FULL, settings.seed
    if settings.load is None:
        scene = loads.random_load(*sizes.scene, seed, _SCENE_SIZE_PER_SPACING)
    else:
        scene = loads.read(Path(settings.load))
    step = loads.random_load(*sizes.step, seed)
    views = (step, step.downscaled(_LR_FACTOR))
    result = against.measure(other, scene, views, counts, settings.repeats)
    try:
        Path(settings.out).mkdir(parents=True, exist_ok=True)
        _write_csv(Path(settings.out) / "against.csv", result["rows"])
    except OSError as error:
        raise XrgsError(f"{error.filename}: cannot be written: {error.strerror}") from error
    if settings.json is not None:
        _write_json(settings.json, {"against": result})
    return tables.against(result, scene, step)


def _machine(backends: Sequence[str], counts: Sequence[int]) -> dict[str, Any]:
    machine = provenance.collect(counts[-1], backends[0])
    if "native" in backends:
        from xrgs import _native

        machine["instruction_set"] = _native.isa()
        machine["multiply_adds_per_s"] = {
            str(count): _native.multiply_adds_per_second(count) for count in counts
        }
    return machine


def _time_loads(
    chosen: Sequence[Load], settings: Settings, counts: Sequence[int], backends: Sequence[str]
) -> dict[str, Any]:
    methods = rendering.default_methods(backends)
    rows: list[Row] = []
    for load in progress(chosen, "rendering", "load", len(chosen)):
        error = rendering.errors(load, methods)
        timed = rendering.time_load(load, methods, counts, settings.repeats)
        rows += [row | {"error": error[row["method"]]} for row in timed]
    return {"rows": rows, "methods": [rendering.describe(method) for method in methods]}


def _add_shares_of_peak(results: dict[str, Any]) -> None:
    """Add `ideal_share`, and `multiply_share`, by stage to the rows of the native backend."""
    peaks = results["machine"].get("multiply_adds_per_s", {})
    for row in results["rows"]:
        if row["stages_ms"]:
            shares = instructions.shares_of_peak(row, peaks[str(row["threads"])])
            row["ideal_share"] = {stage: share for stage, (share, _) in shares.items()}
            row["multiply_share"] = {stage: share for stage, (_, share) in shares.items()}


def _time_training(
    sizes: BenchmarkSizes, settings: Settings, counts: Sequence[int], backends: Sequence[str]
) -> dict[str, Any]:
    count, width, height = sizes.step
    load = loads.random_load(count, width, height, settings.seed)
    views = {"HR": load, "LR": load.downscaled(_LR_FACTOR)}
    repeats = settings.repeats
    return {
        "views": rendering.time_views(load, backends[0], sizes.views, repeats),
        "losses": training.time_losses(sizes.sizes[1:], backends, counts, repeats),
        "resizes": training.time_resizes((width, height), _LR_FACTOR, backends, counts, repeats),
        "optimizers": training.time_optimizers(sizes.gaussians[1:3], backends, counts, repeats),
        "steps": training.time_steps(views, backends[0], counts, repeats),
        "shortcuts": _time_shortcuts(load, settings, backends),
    }


def _time_shortcuts(load: Load, settings: Settings, backends: Sequence[str]) -> dict[str, Any]:
    """Time the shortcuts for a view, and for the same view at low resolution."""
    views = (load, load.downscaled(_LR_FACTOR))
    backend, repeats = backends[0], settings.repeats
    return {
        "renders": [
            row for view in views for row in shortcuts.time_renders(view, backend, repeats)
        ],
        "steps": shortcuts.time_steps(load, backend, repeats),
    }


def _write(results: dict[str, Any], settings: Settings) -> None:
    from xrgs.report.bench_plot import draw_panels

    rows = results["rows"]
    usual = rows[0]["method"], rows[0]["threads"]
    results["growth"] = growth.fit_growth(rows, *usual)
    results["growth_lines"] = {
        "gaussians": [line._asdict() for line in growth.growth_by_gaussians(rows, *usual)],
        "pixels": [line._asdict() for line in growth.growth_by_pixels(rows, *usual)],
    }
    flat = [tables.flat(row) for row in rows]
    shortcut_rows = [tables.flat_shortcut(row) for row in results["shortcuts"]["renders"]]
    folder = Path(settings.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_csv(folder / "bench.csv", flat)
        _write_csv(folder / "shortcuts.csv", shortcut_rows + results["shortcuts"]["steps"])
        (folder / "bench.png").write_bytes(draw_panels(panels.panels(results)))
    except OSError as error:
        raise XrgsError(f"{error.filename}: cannot be written: {error.strerror}") from error
    if settings.json is not None:
        _write_json(settings.json, results)


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    safe = [{key: for_csv(value) for key, value in row.items()} for row in rows]
    path.write_text(table_text(safe), encoding="utf-8", newline="")


def _write_json(name: str, results: dict[str, Any]) -> None:
    try:
        write_json(Path(name).absolute(), results)
    except OSError as error:
        raise XrgsError(f"{error.filename}: cannot be written: {error.strerror}") from error
