"""Scores a render that is a file: another program's, for example."""

from __future__ import annotations

from typing import TYPE_CHECKING

from xrgs.capture import images
from xrgs.evaluation.metrics import VIEW_METRICS
from xrgs.runtime.machine import single_torch_thread

if TYPE_CHECKING:
    from pathlib import Path


def score_files(render: Path, photograph: Path, size: tuple[int, int]) -> dict[str, float | None]:
    """Score a render against its photograph, both 8-bit RGB PNGs of `size` (width, height), px.

    Returns:
        Each score by its metric's name; None where it can't be computed on this machine.

    Raises:
        ImageError: A file is missing, damaged or of another size or mode; the message names it.
    """
    import torch

    image, target = (torch.from_numpy(images.read_png(file, size)) for file in (render, photograph))
    with torch.no_grad(), single_torch_thread():
        return {name: score(image, target) for name, score in VIEW_METRICS.items()}
