"""The plot of a benchmark: time against error."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from matplotlib import style
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_DPI = 150
_LEAST_ERROR = 1e-9  # an error of 0 has no logarithm
#: Okabe and Ito's colours, told apart by colour-blind readers.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
_MARKERS = "osD^v"


def time_against_error(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw each load rendered with each method as a point: lower is faster, left is more exact.

    Args:
        rows: With `method`, `threads`, `gaussians`, `forward_ms`, `backward_ms` and
            `image_mean_error`; only those of one thread are drawn, larger marks for more Gaussians.

    Returns:
        A .png.
    """
    names = list(dict.fromkeys(row["method"] for row in rows))
    most = max(row["gaussians"] for row in rows)
    with style.context("default"):
        figure = Figure(figsize=(8.0, 5.5), layout="constrained")
        axes = figure.add_subplot()
        for place, name in enumerate(names):
            used = [row for row in rows if row["method"] == name and row["threads"] == 1]
            axes.scatter(
                [max(row["image_mean_error"], _LEAST_ERROR) for row in used],
                [row["forward_ms"] + row["backward_ms"] for row in used],
                s=[20 + 100 * (row["gaussians"] / most) ** 0.5 for row in used],
                c=_COLORS[place % len(_COLORS)],
                # Ways of the same colour differ by their mark.
                marker=_MARKERS[(place + place // len(_COLORS)) % len(_MARKERS)],
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
