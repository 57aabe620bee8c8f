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
        parts += [_kinds("Adam, one step", found["optimizers"]), _steps(found["steps"])]
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
    return _table(["step", "threads", "Gaussians", "size", *names, "all ms"], lines)


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
