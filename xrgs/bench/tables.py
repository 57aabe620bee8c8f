"""Formats the results of the benchmark as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from xrgs.bench.against import HR_SHARE, SIDES
from xrgs.bench.rendering import STAGES
from xrgs.bench.timing import Row
from xrgs.runtime.text import padded

# Columns of each table: heading -> format string for the values of a row.
_LOAD = {"Gaussians": "{gaussians}", "size": "{width}x{height}"}
_SIZES = {"threads": "{threads}", **_LOAD}
_RENDERS = {
    "method": "{method}",
    **_SIZES,
    "forward ms": "{forward_ms:.1f}",
    "backward ms": "{backward_ms:.1f}",
    "speed-up": "{speedup:.2f}x",
    "slower": "{times_slower:.0f}x",
    "alphas/s": "{evaluations_per_s:.2e}",
    "MiB": "{memory_mib:.0f}",
    "mean error": "{image_mean_error:.1e}",
    "max error": "{image_max_error:.1e}",
    "gradient error": "{gradient_error:.1e}",
}
_RENDERS_NOTE = """\
Times: the shortest of the repeats. speed-up: over one thread. slower: time over native's.
alphas/s: evaluations of a Gaussian's alpha at a pixel, while compositing.
MiB: parameters, gradients and buffers.
Errors: against torch in float64, in the middle of the view."""
_GROWTH = {"time grows with": "{grows}", "at": "{at}", "exponent": "{exponent:.2f}"}
_STEPS = {
    "step": "{view}",
    **_SIZES,
    "render": "{render_ms:.2f}",
    "loss": "{loss_ms:.2f}",
    "backward": "{backward_ms:.2f}",
    "optimizer": "{optimizer_ms:.2f}",
    "densify": "{densify_ms:.2f}",
    "all ms": "{step_ms:.2f}",
    "speed-up": "{speedup:.2f}x",
}
_SHORTCUTS = {
    "shortcut": "{shortcut}",
    **_LOAD,
    "forward ms on": "{on_forward_ms:.1f}",
    "forward ms off": "{off_forward_ms:.1f}",
    "backward ms on": "{on_backward_ms:.1f}",
    "backward ms off": "{off_backward_ms:.1f}",
    "off / on": "{times:.2f}x",
    "alphas on": "{on_evaluations:,}",
    "alphas off": "{off_evaluations:,}",
    "error on": "{on_image_mean_error:.1e}",
    "error off": "{off_image_mean_error:.1e}",
    "same bits": "{same_bits}",
}
_STEP_SHORTCUTS = {
    "shortcut": "{shortcut}",
    "part": "{part}",
    **_LOAD,
    "ms on": "{on_ms:.2f}",
    "ms off": "{off_ms:.2f}",
    "off / on": "{times:.2f}x",
}
_MEMORY = {
    "memory": "training step",
    **_SIZES,
    "counted MiB": "{counted_mib:.0f}",
    "growth MiB": "{growth_mib:.0f}",
    "base MiB": "{base_rss_mib:.0f}",
    "peak MiB": "{peak_rss_mib:.0f}",
}
_MEMORY_NOTE = """\
counted: parameters, gradients, Adam's state and the renderer's buffers.
growth: of the process's resident memory, from before training (base) to its peak."""
_AGAINST = {
    "task": "{task}",
    "threads": "{threads}",
    "this ms": "{this_ms:.2f}",
    "other ms": "{other_ms:.2f}",
    "times faster": "{times_faster:.2f}x",
    "quartiles": "{times_faster_low:.2f} to {times_faster_high:.2f}",
    "speed-up": "{this_speedup:.2f}x",
    "other's": "{other_speedup:.2f}x",
}


def text(results: Mapping[str, Any]) -> str:
    """Format the results of `xrgs.bench.run` as tables."""
    machine, rows = results["machine"], results["rows"]
    parts = [
        f"{machine['cpu']}, {machine['cores']} cores, torch {machine['packages']['torch']}",
        f"{table(rows, _RENDERS)}\n{_RENDERS_NOTE}",
    ]
    if stages := [f"{stage}_ms" for stage in STAGES if f"{stage}_ms" in rows[0]]:
        native = [row for row in rows if row["method"] == "native"]
        times = {key.replace("_", " "): f"{{{key}:.2f}}" for key in stages}
        parts.append(table(native, {"stages of": "{method}", **_SIZES, **times}))
    if results["growth"]:
        note = f"{rows[0]['method']}, one thread; 1: twice as many take twice as long."
        parts.append(f"{table(results['growth'], _GROWTH)}\n{note}")
    parts.append(table(results["steps"], _STEPS))
    note = "One thread. Rendering and training run with every shortcut on."
    parts.append(f"{table(results['shortcuts'], _SHORTCUTS)}\n{note}")
    parts.append(table(results["step_shortcuts"], _STEP_SHORTCUTS))
    if "memory" in results:
        parts.append(f"{table([results['memory']], _MEMORY)}\n{_MEMORY_NOTE}")
    return "\n\n".join(parts)


def against(result: Mapping[str, Any]) -> str:
    """Format the result of `xrgs.bench.against.measure`."""
    sides = [f"{side}: {result[side]['package']}, {result[side]['isa']}" for side in SIDES]
    scene, step = (describe(result[key]) for key in ("scene", "step"))
    note = (
        "Medians; the other's time over this one's, repetition by repetition, and its quartiles.\n"
        f"speed-up: over one thread. render: forward and backward, {scene}.\n"
        f"steps: every part of a training step, {step}; mean: {HR_SHARE:.0%} HR, the others LR."
    )
    return "\n".join([*sides, table(result["rows"], _AGAINST), note])


def describe(sizes: Row) -> str:
    """Return the sizes of a load as text."""
    return "{gaussians} Gaussians at {width}x{height}".format(**sizes)


def table(rows: Sequence[Row], columns: Mapping[str, str]) -> str:
    """Align columns of text, the first to the left and the others to the right."""
    cells = [tuple(columns), *(tuple(_cell(of, row) for of in columns.values()) for row in rows)]
    lines, _ = padded(cells, f"l{'r' * (len(columns) - 1)}")
    return "\n".join("  ".join(line).rstrip() for line in lines)


def _cell(form: str, row: Row) -> str:
    try:
        return form.format(**row)
    except KeyError:
        return ""
