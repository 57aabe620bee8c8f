"""The figures of a benchmark as text and as flat rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Row = dict[str, Any]


def flat(row: Row) -> Row:
    """A row without dictionaries in it: `stages_ms.sort` becomes `sort_ms`, as a .csv wants it."""
    plain: Row = {}
    for key, value in row.items():
        if key == "stages_ms":
            plain |= {f"{stage}_ms": ms for stage, ms in value.items()}
        elif key == "error":
            plain |= {f"{name}_error": error for name, error in value.items()}
        else:
            plain[key] = value
    return plain


def flat_skip(row: Row) -> Row:
    """A row of `skips.time_renders` without dictionaries: `on.forward_ms` to `on_forward_ms`."""
    plain: Row = {}
    for key, value in row.items():
        if isinstance(value, dict):
            plain |= {f"{key}_{name}": inner for name, inner in value.items()}
        else:
            plain[key] = value
    return plain


def skip_points(found: Row) -> list[Row]:
    """What the plot needs of each skip switched off."""
    return [
        {
            "way": f"{row['backend']} without skipping {row['skip']}",
            "threads": row["threads"],
            "gaussians": row["gaussians"],
            "forward_ms": row["off"]["forward_ms"],
            "backward_ms": row["off"]["backward_ms"],
            "image_mean_error": row["off"]["image_mean"],
        }
        for row in found["skips"]["renders"]
    ]


def text(found: Row) -> str:
    """All tables, the widest first."""
    parts = [_machine(found["machine"]), _renders(found), _stages(found["rows"])]
    if found.get("growth"):
        way, growth = found["rows"][0]["way"], found["growth"]
        parts.append(
            f"time grows with Gaussians^{growth['gaussians']:.2f} and pixels^{growth['pixels']:.2f}"
            f" ({way}, one thread)"
        )
    if "views" in found:
        parts += [_views(found["views"]), _kinds("loss, value and gradient", found["losses"])]
        parts += [_kinds("phi, up and the gradient back", found["resizes"])]
        parts += [_kinds("Adam, one step", found["optimizers"]), _steps(found["steps"])]
    parts += [_skips(found["skips"]["renders"]), _step_skips(found["skips"]["steps"])]
    if "memory" in found:
        parts.append(_memory(found["memory"]))
    return "\n\n".join(parts)


def _machine(machine: Row) -> str:
    lines = [f"{machine['cpu']}, {machine['cores']} cores, torch {machine['packages']['torch']}"]
    for count, rate in machine.get("multiply_adds_per_s", {}).items():
        lines.append(
            f"peak on {count} thread(s), {machine['instruction_set']}: {rate / 1e9:.1f} G"
            " multiply-adds/s, measured"
        )
    return "\n".join(lines)


def _renders(found: Row) -> str:
    peaks = found["machine"].get("multiply_adds_per_s", {})
    lines = []
    for row in found["rows"]:
        peak = peaks.get(str(row["threads"]))
        share = peak / row["evaluations_per_s"] if peak and row["backend"] == "native" else None
        lines.append(
            [
                row["way"],
                str(row["threads"]),
                str(row["gaussians"]),
                f"{row['width']}x{row['height']}",
                f"{row['forward_ms']:.1f}",
                f"{row['backward_ms']:.1f}",
                f"{row['evaluations'] / 1e6:.1f}",
                f"{row['evaluations_per_s'] / 1e9:.3f}",
                "" if share is None else f"{share:.0f}",
                f"{row['memory_bytes'] / 2**20:.0f}",
                f"{row['error']['image_mean']:.1e}",
                f"{row['error']['image_max']:.1e}",
                f"{row['error']['gradient']:.1e}",
                f"{row['times_slower']:.0f}x" if "times_slower" in row else "",
            ]
        )
    head = "way|threads|Gaussians|size|forward ms|backward ms|M alphas|G alphas/s|FMA/alpha|MB"
    head += "|mean error|max error|gradient error|slower"
    note = (
        "least of the repeats; alphas/s of compositing alone, FMA/alpha: multiply-adds that the\n"
        "measured peak has time for in one; MB: parameters, gradients and buffers; errors against\n"
        "the torch backend in double, over the middle of the view; slower: than native, in turn"
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def _stages(rows: Sequence[Row]) -> str:
    timed = [row for row in rows if row["stages_ms"] and row["way"] == row["backend"]]
    if not timed:
        return "no stages: the native backend was not built"
    names = list(timed[0]["stages_ms"])
    lines = [
        [str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        + [f"{row['stages_ms'][name]:.2f}" for name in names]
        for row in timed
    ]
    return _table(["threads", "Gaussians", "size", *(f"{name} ms" for name in names)], lines)


def _views(rows: Sequence[Row]) -> str:
    lines = [
        [str(row["views"]), f"{row['ms']:.1f}", f"{row['ms'] / row['views']:.1f}"] for row in rows
    ]
    return _table(["views", "forward + backward ms", "a view"], lines)


def _kinds(title: str, rows: Sequence[Row]) -> str:
    """Rows of a `kind` each, beside how much longer it took than the first at the same size."""
    first: dict[object, float] = {}
    lines = []
    for row in rows:
        size = str(row["gaussians"]) if "gaussians" in row else f"{row['width']}x{row['height']}"
        base = first.setdefault((size, row["threads"]), row["ms"])
        times = [f"{row['ms']:.2f}", f"{row['median_ms']:.2f}", f"{row['ms'] / base:.2f}x"]
        lines.append([row["kind"], str(row["threads"]), size, *times])
    return _table([title, "threads", "size", "ms", "median", "to the first"], lines)


def _steps(rows: Sequence[Row]) -> str:
    names = list(rows[0]["parts_ms"])
    lines = [
        [row["view"], str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        + [f"{row['parts_ms'][name]:.2f}" for name in names]
        + [f"{row['step_ms']:.2f}"]
        for row in rows
    ]
    table = _table(["step", "threads", "Gaussians", "size", *names, "all ms"], lines)
    return "\n".join([table, *_lr_shares(rows)])


def _lr_shares(rows: Sequence[Row]) -> list[str]:
    ms = {(row["view"], row["threads"]): row["step_ms"] for row in rows}
    return [
        f"{count} thread(s): an LR view's step takes {ms['LR', count] / ms['HR', count]:.2f} of an"
        " HR view's (bar: below 0.33)"
        for count in sorted({row["threads"] for row in rows})
    ]


def _skips(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        on, off = row["on"], row["off"]
        both = [(on[key], off[key]) for key in ("forward_ms", "backward_ms")]
        lines.append(
            [row["skip"], str(row["gaussians"]), f"{row['width']}x{row['height']}"]
            + [f"{value:.1f}" for pair in both for value in pair]
            + [f"{row['times']:.2f}x"]
            + [f"{side['evaluations'] / 1e6:.2f}" for side in (on, off)]
            + [f"{side['image_mean']:.1e}" for side in (on, off)]
            + [f"{side['gradient']:.1e}" for side in (on, off)]
            + ["no bit" if row["same_bits"] else "rounding or cuts"]
        )
    head = "skipped|Gaussians|size|forward ms on|off|backward ms on|off|off / on|M alphas on|off"
    head += "|mean error on|off|gradient error on|off|changes"
    return f"{_table(head.split('|'), lines)}\none thread; on: skipped, as the program is"


def _step_skips(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        load = [str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        times = [f"{row['on_ms']:.2f}", f"{row['off_ms']:.2f}", f"{row['times']:.2f}x"]
        lines.append([row["skip"], row["part"], *load, *times, "no bit"])
    head = "skipped in a step|part|Gaussians|size|ms on|off|off / on|changes"
    return _table(head.split("|"), lines)


def _memory(rows: Sequence[Row]) -> str:
    def megabytes(count: int | None) -> str:
        return "" if count is None else f"{count / 2**20:.0f}"

    keys = ("counted_bytes", "growth_bytes", "base_rss_bytes", "peak_rss_bytes")
    lines = []
    for row in rows:
        load = [str(row["threads"]), str(row["gaussians"]), f"{row['width']}x{row['height']}"]
        lines.append(["training step", *load, *(megabytes(row[key]) for key in keys)])
    head = "memory|threads|Gaussians|size|counted MB|process grew MB|from|to"
    note = (
        "counted: parameters, gradients, Adam's state, the renderer's buffers; grew: resident at\n"
        "its highest, less what torch and the program take once loaded\n"
        "(bar: 300,000 Gaussians at 1008x756 below 1000 MB)"
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def quality(rows: Sequence[Row]) -> str:
    """The table of `xrgs.bench.quality`."""
    lines = []
    for row in rows:
        picture = [f"{row['psnr']:.3f}", f"{row['difference']:+.3f}"]
        work = [str(row["gaussians"]), f"{row['evaluations'] / 1e6:.0f}", f"{row['seconds']:.1f}"]
        lines.append([row["change"], str(row["steps"]), *picture, *work])
    head = "trained|steps|PSNR dB|difference|Gaussians|M alphas|seconds"
    note = (
        "another seed: what chance does; skips that are not here change no bit, or rounding at a\n"
        "cut, as the last column of their table says"
    )
    return f"{_table(head.split('|'), lines)}\n{note}"


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Columns, the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(head, *lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if place == 0 else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in [head, *lines]
    )
