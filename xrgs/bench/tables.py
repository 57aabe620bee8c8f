"""Formats the results of a benchmark as text tables and as flat rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from xrgs.bench.against import HR_SHARE, SIDES
from xrgs.bench.instructions import STAGES

if TYPE_CHECKING:
    from xrgs.bench.loads import Load

Row = dict[str, Any]


def flat(row: Row) -> Row:
    """Flatten a row of `rendering.time_load` for a .csv: `stages_ms.sort` becomes `sort_ms`.

    Args:
        row: The row, with dictionaries under `stages_ms`, `error`, `ideal_share` and
            `multiply_share`.
    """
    plain: Row = {}
    for key, value in row.items():
        if key == "stages_ms":
            plain |= {f"{stage}_ms": ms for stage, ms in value.items()}
        elif key == "error":
            plain |= {f"{name}_error": error for name, error in value.items()}
        elif key in {"ideal_share", "multiply_share"}:
            plain |= {f"{stage}_{key}": share for stage, share in value.items()}
        else:
            plain[key] = value
    return plain


def flat_shortcut(row: Row) -> Row:
    """Flatten a row of `shortcuts.time_renders`: `on.forward_ms` becomes `on_forward_ms`.

    Args:
        row: The row, with dictionaries under `on` and `off`.
    """
    plain: Row = {}
    for key, value in row.items():
        if isinstance(value, dict):
            plain |= {f"{key}_{name}": inner for name, inner in value.items()}
        else:
            plain[key] = value
    return plain


def text(results: Row) -> str:
    """Format all tables.

    Args:
        results: All results of the benchmark.
    """
    parts = [_machine(results["machine"]), _renders(results), _stages(results["rows"])]
    if any("ideal_share" in row for row in results["rows"]):
        parts += [_shares(results["rows"]), _ideal_instructions()]
    if results.get("growth"):
        parts.append(_growth(results))
    if "views" in results:
        parts += [_views(results["views"]), _kinds("loss, value and gradient", results["losses"])]
        parts += [_kinds("LR view upsampled, value and gradient", results["resizes"])]
        parts += [_kinds("Adam, one step", results["optimizers"]), _steps(results["steps"])]
    parts += [
        _shortcuts(results["shortcuts"]["renders"]),
        _step_shortcuts(results["shortcuts"]["steps"]),
    ]
    if "memory" in results:
        parts.append(_memory(results["memory"]))
    return "\n\n".join(parts)


def _machine(machine: Row) -> str:
    lines = [f"{machine['cpu']}, {machine['cores']} cores, torch {machine['packages']['torch']}"]
    for count, rate in machine.get("multiply_adds_per_s", {}).items():
        lines.append(
            f"peak on {count} thread(s), {machine['instruction_set']}: {rate / 1e9:.1f} G"
            " multiply-adds/s, measured"
        )
    return "\n".join(lines)


def _renders(results: Row) -> str:
    one = {_load_of(row): _total_ms(row) for row in results["rows"] if row["threads"] == 1}
    lines = [
        [
            row["method"],
            str(row["threads"]),
            str(row["gaussians"]),
            f"{row['width']}x{row['height']}",
            f"{row['forward_ms']:.1f}",
            f"{row['backward_ms']:.1f}",
            f"{row['evaluations'] / 1e6:.1f}",
            f"{row['evaluations_per_s'] / 1e9:.3f}",
            f"{one[_load_of(row)] / _total_ms(row):.2f}x",
            f"{row['memory_bytes'] / 2**20:.0f}",
            f"{row['error']['image_mean']:.1e}",
            f"{row['error']['image_max']:.1e}",
            f"{row['error']['gradient']:.1e}",
            f"{row['times_slower']:.0f}x" if "times_slower" in row else "",
        ]
        for row in results["rows"]
    ]
    head = "method|threads|Gaussians|size|forward ms|backward ms|M alphas|G alphas/s|speed-up|MB"
    head += "|mean error|max error|gradient error|slower"
    note = (
        "Times are minima over the repeats. alphas/s: alpha evaluations while compositing;\n"
        "speed-up: over one thread (goal on two: 1.9x);\n"
        "MB: parameters, gradients and buffers; errors: against torch in float64, over the\n"
        "middle of the view; slower: time over that of native, timed in turn"
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def _load_of(row: Row) -> tuple[object, ...]:
    return tuple(row[key] for key in ("method", "load", "gaussians", "width", "height"))


def _total_ms(row: Row) -> float:
    return float(row["forward_ms"] + row["backward_ms"])


def _stages(rows: Sequence[Row]) -> str:
    timed = [row for row in rows if row["stages_ms"] and row["method"] == row["backend"]]
    if not timed:
        return "There are no times by stage, since the native backend was not built."
    names = list(timed[0]["stages_ms"])
    lines = [
        [str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        + [f"{row['stages_ms'][name]:.2f}" for name in names]
        for row in timed
    ]
    return _table(["threads", "Gaussians", "size", *(f"{name} ms" for name in names)], lines)


def _shares(rows: Sequence[Row]) -> str:
    timed = [row for row in rows if "ideal_share" in row and row["method"] == row["backend"]]
    names = list(timed[0]["ideal_share"])
    lines = []
    for row in timed:
        cells = [str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        for name in names:
            shares = (row["ideal_share"][name], row["multiply_share"][name])
            cells.append(" / ".join(f"{100 * share:.0f}" for share in shares))
        lines.append(cells)
    note = (
        "Percentages of a stage's time that its ideal vector instructions take at the measured\n"
        "peak of multiply-adds, one in the place of each: all of them / those that multiply.\n"
        "All of them is what a processor with no other vector units needs at least; one with\n"
        "others can pass 100. Goal of both composite stages: 60"
    )
    head = ["threads", "Gaussians", "size", *(f"{name} %" for name in names)]
    return f"{_table(head, lines)}\n{note}"


def _ideal_instructions() -> str:
    lines = []
    for stage, works in STAGES.items():
        for work in works:
            counts = (work.instructions.total, work.instructions.multiply)
            lines.append([stage, f"{work.per} {work.unit}", *map(str, counts), work.source])
    return _table(["ideal vector instructions", "of", "all", "multiply", "source"], lines)


def _growth(results: Row) -> str:
    method, growth = results["rows"][0]["method"], results["growth"]
    lines = []
    for what, other in (("gaussians", "pixels"), ("pixels", "Gaussians")):
        for line in results["growth_lines"][what]:
            span = f"{line['sizes'][0]} to {line['sizes'][-1]}"
            lines.append([what, span, f"{line['fixed']} {other}", f"{line['exponent']:.2f}"])
        lines.append([what, "all loads", "", f"{growth[what]:.2f}"])
    table = _table(["time grows with", "from", "at", "exponent"], lines)
    return f"{table}\n{method}, one thread; 1 means that twice as many take twice as long"


def _views(rows: Sequence[Row]) -> str:
    lines = [
        [str(row["views"]), f"{row['ms']:.1f}", f"{row['ms'] / row['views']:.1f}"] for row in rows
    ]
    return _table(["views", "forward + backward ms", "per view"], lines)


def _kinds(title: str, rows: Sequence[Row]) -> str:
    """Format rows of alternatives, with their time over that of the first at the same size."""
    first: dict[object, float] = {}
    lines = []
    for row in rows:
        size = str(row["gaussians"]) if "gaussians" in row else f"{row['width']}x{row['height']}"
        base = first.setdefault((size, row["threads"]), row["ms"])
        times = [f"{row['ms']:.2f}", f"{row['median_ms']:.2f}", f"{row['ms'] / base:.2f}x"]
        lines.append([row["kind"], str(row["threads"]), size, *times])
    return _table([title, "threads", "size", "ms", "median", "/ first"], lines)


def _steps(rows: Sequence[Row]) -> str:
    names = list(rows[0]["parts_ms"])
    one = {row["view"]: row["step_ms"] for row in rows if row["threads"] == 1}
    lines = [
        [row["view"], str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        + [f"{row['parts_ms'][name]:.2f}" for name in names]
        + [f"{row['step_ms']:.2f}", f"{one[row['view']] / row['step_ms']:.2f}x"]
        for row in rows
    ]
    head = ["step", "threads", "Gaussians", "size", *names, "all ms", "speed-up"]
    return "\n".join([_table(head, lines), *_lr_shares(rows)])


def _lr_shares(rows: Sequence[Row]) -> list[str]:
    ms = {(row["view"], row["threads"]): row["step_ms"] for row in rows}
    return [
        f"{count} thread(s): an LR view's step takes {ms['LR', count] / ms['HR', count]:.2f} of the"
        " time of an HR view's (goal: below 0.33)"
        for count in sorted({row["threads"] for row in rows})
    ]


def _shortcuts(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        on, off = row["on"], row["off"]
        both = [(on[key], off[key]) for key in ("forward_ms", "backward_ms")]
        lines.append(
            [row["shortcut"], str(row["gaussians"]), f"{row['width']}x{row['height']}"]
            + [f"{value:.1f}" for pair in both for value in pair]
            + [f"{row['times']:.2f}x"]
            + [f"{side['evaluations'] / 1e6:.2f}" for side in (on, off)]
            + [f"{side['image_mean']:.1e}" for side in (on, off)]
            + [f"{side['gradient']:.1e}" for side in (on, off)]
            + ["nothing" if row["same_bits"] else "rounding"]
        )
    head = "shortcut|Gaussians|size|forward ms on|off|backward ms on|off|off / on|M alphas on|off"
    head += "|mean error on|off|gradient error on|off|changes"
    return f"{_table(head.split('|'), lines)}\nOne thread. The program runs with every shortcut on."


def _step_shortcuts(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        load = [str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        times = [f"{row['on_ms']:.2f}", f"{row['off_ms']:.2f}", f"{row['times']:.2f}x"]
        lines.append([row["shortcut"], row["part"], *load, *times, "nothing"])
    head = "shortcut of a step|part|Gaussians|size|ms on|off|off / on|changes"
    return _table(head.split("|"), lines)


def _memory(rows: Sequence[Row]) -> str:
    def megabytes(count: int | None) -> str:
        return "" if count is None else f"{count / 2**20:.0f}"

    keys = ("counted_bytes", "growth_bytes", "base_rss_bytes", "peak_rss_bytes")
    lines = []
    for row in rows:
        load = [str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        lines.append(["training step", *load, *(megabytes(row[key]) for key in keys)])
    head = "memory|threads|Gaussians|size|counted MB|growth MB|base RSS MB|peak RSS MB"
    note = (
        "counted: parameters, gradients, Adam's state and the renderer's buffers; growth: of the\n"
        "process, from once everything is imported to its peak\n"
        "(goal: 300,000 Gaussians at 1008x756 below 1000 MB)"
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def against(result: Row, scene: Load, step: Load) -> str:
    """Format the table of `xrgs.bench.against`.

    Args:
        result: What `against.measure` returned.
        scene: The load that was rendered.
        step: The HR load that was trained.
    """
    lines = []
    for row in result["rows"]:
        times = [f"{row['this_ms']:.2f}", f"{row['other_ms']:.2f}", f"{row['times_faster']:.2f}x"]
        spread = f"{row['times_faster_low']:.2f} to {row['times_faster_high']:.2f}"
        speedups = [f"{row['this_speedup']:.2f}x", f"{row['other_speedup']:.2f}x"]
        lines.append([row["task"], str(row["threads"]), *times, spread, *speedups])
    head = "task|threads|this ms|other ms|times faster|quartiles|this speed-up|other's"
    sides = [f"{side}: {result[side]['package']}, {result[side]['isa']}" for side in SIDES]
    note = (
        "Medians; the other's time over this one's, repetition by repetition, and its quartiles;\n"
        "speed-up: over one thread (goal on two: 1.9x).\n"
        f"render: forward and backward, {_describe_load(scene)};\n"
        f"steps: every part of a training step, {_describe_load(step)};\n"
        f"mean: {HR_SHARE:.0%} HR steps, the others LR"
    )
    return "\n".join([*sides, _table(head.split("|"), lines), note])


def _describe_load(load: Load) -> str:
    return f"{len(load)} Gaussians at {load.camera.width}x{load.camera.height}"


def quality(rows: Sequence[Row]) -> str:
    """Format the table of `xrgs.bench.quality`.

    Args:
        rows: What `quality.compare` returned.
    """
    lines = []
    for row in rows:
        scores = [f"{row['psnr']:.3f}", f"{row['difference']:+.3f}"]
        work = [str(row["gaussians"]), f"{row['evaluations'] / 1e6:.0f}", f"{row['seconds']:.1f}"]
        lines.append([row["change"], str(row["steps"]), *scores, *work])
    head = "trained|steps|PSNR dB|difference|Gaussians|M alphas|seconds"
    note = (
        "Another seed shows what chance does. The shortcuts that xrgs-bench times change nothing\n"
        "but rounding, as the last column of their table says."
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Align columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(head, *lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in [head, *lines]
    )
