"""Scores a render that is stored in a file, by another program for example."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.evaluation.metrics import score_view
from xrgs.photos import images
from xrgs.runtime.machine import single_torch_thread

if TYPE_CHECKING:
    from pathlib import Path

    from xrgs.mixture.views import View


def score_file(render: Path, view: View, *, masked: bool) -> dict[str, float | None]:
    """Score a render, an 8-bit RGB PNG of the view's size, by `xrgs.evaluation.metrics.score_view`.

    Raises:
        ImageError: A file is missing, damaged or of another size or mode; the message names it.
    """
    import torch

    size = view.width, view.height
    image, target = (torch.from_numpy(images.read_png(file, size)) for file in (render, view.file))
    mask = torch.from_numpy(images.read_mask(view.mask, size)) if view.mask else None
    with torch.no_grad(), single_torch_thread():
        return score_view(image, target, mask, masked=masked)
