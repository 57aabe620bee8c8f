"""The plot of a benchmark: rendering time against error."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from matplotlib import style
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_DPI = 150
_MIN_ERROR = 1e-9  # an error of 0 has no logarithm
#: Okabe and Ito's colours, told apart by colour-blind readers.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
_MARKERS = "osD^v"


def time_against_error(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw a point for each scene and method: lower is faster, further left is more exact.

    Args:
        rows: One mapping a measurement, with `method`, `threads`, `gaussians`, `forward_ms`,
            `backward_ms` and `image_mean_error`. Only rows of one thread are drawn; a larger mark
            has more Gaussians.

    Returns:
        The bytes of a PNG.
    """
    names = list(dict.fromkeys(row["method"] for row in rows))
    most = max(row["gaussians"] for row in rows)
    with style.context("default"):
        figure = Figure(figsize=(8.0, 5.5), layout="constrained")
        axes = figure.add_subplot()
        for index, name in enumerate(names):
            points = [row for row in rows if row["method"] == name and row["threads"] == 1]
            axes.scatter(
                [max(row["image_mean_error"], _MIN_ERROR) for row in points],
                [row["forward_ms"] + row["backward_ms"] for row in points],
                s=[20 + 100 * (row["gaussians"] / most) ** 0.5 for row in points],
                c=_COLORS[index % len(_COLORS)],
                # Renderers of the same colour differ by their mark.
                marker=_MARKERS[(index + index // len(_COLORS)) % len(_MARKERS)],
                alpha=0.7,
                label=name,
            )
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="mean error of the image against double precision",
            ylabel="forward + backward, ms (one thread)",
        )
        axes.grid(visible=True, which="major", alpha=0.3)
        axes.legend(fontsize="x-small")
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()
