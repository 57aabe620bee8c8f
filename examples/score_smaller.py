"""Score cells on their test photographs, reduced to a smaller size.

    python examples/score_smaller.py CELL CELL --store xrgs-store --factor 5

`full` are the scores at the full size. For the others each test photograph is averaged over squares
of pixels: `averaged` compares it with the full-size render, averaged in the same way, and
`rendered` with a render at the smaller size, as a protocol would that degrades test photographs
like training photographs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional

import xrgs
from xrgs.evaluation.metrics import psnr, ssim


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("cells", nargs="+", help="ids of trained cells, or their beginnings")
    parser.add_argument("--store", default="xrgs-store", help="default: %(default)s")
    times = "how many times smaller, per side (default: %(default)s)"
    parser.add_argument("--factor", type=int, default=5, help=times)
    return parser.parse_args(arguments)


def averaged(image: Tensor, factor: int) -> Tensor:
    """Average an image [H, W, 3] over squares of pixels, to [H // factor, W // factor, 3]."""
    size = (image.shape[0] // factor, image.shape[1] // factor)
    return functional.adaptive_avg_pool2d(image.permute(2, 0, 1), size).permute(1, 2, 0)


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> None:
    """Print the mean scores of each cell over its test views."""
    options = parse(arguments)
    rows = {}
    for beginning in options.cells:
        cell = xrgs.Store(options.store).find_cell(beginning)
        gaussians, settings = cell.gaussians(), cell.config().splat.raster
        pairs: dict[str, list[tuple[Tensor, Tensor]]] = {"full": [], "averaged": [], "rendered": []}
        for view in cell.dataset().test:
            photograph = averaged(view.image, options.factor)
            height, width = photograph.shape[:2]
            render, small = (
                xrgs.rasterize(gaussians, camera, settings=settings).image.clamp(0, 1)
                for camera in (view.camera, view.camera.resized(width, height))
            )
            pairs["full"].append((render, view.image))
            pairs["averaged"].append((averaged(render, options.factor), photograph))
            pairs["rendered"].append((small, photograph))
        rows[cell.id] = {
            f"{metric.__name__} {kind}": pd.Series([metric(*pair) for pair in both]).mean()
            for kind, both in pairs.items()
            for metric in (psnr, ssim)
        }
    table = pd.DataFrame.from_dict(rows, orient="index")
    print(table.to_string(float_format="{:,.4f}".format))


if __name__ == "__main__":
    main()
