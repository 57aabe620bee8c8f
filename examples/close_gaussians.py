"""Score a cell's test views with and without the Gaussians close to the camera.

    python examples/close_gaussians.py CELL --store xrgs-store --image with-and-without.png

Gaussians that hang between the cameras and the scene ("floaters") are seen by few training views,
and hide the scene in test views. Here a Gaussian is close if its depth is at most a share of the
median depth of the SfM points in front of the camera; a larger near plane leaves it out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import pandas as pd
import torch
from PIL import Image

import xrgs
from xrgs.evaluation.protocol import mean_scores


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("cell", help="the id of a trained cell, or the beginning of one")
    parser.add_argument("--store", default="xrgs-store", help="default: %(default)s")
    share = "of the points' median depth, within which a Gaussian is close (default: %(default)s)"
    parser.add_argument("--share", type=float, default=0.25, help=share)
    parser.add_argument("--image", help="PNG of the view that gains most, with and without them")
    return parser.parse_args(arguments)


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> None:
    """Print the scores of each test view of the cell, and their means."""
    options = parse(arguments)
    cell = xrgs.Store(options.store).find_cell(options.cell)
    data, gaussians, conf = cell.dataset(), cell.gaussians(), cell.config().splat
    rows: dict[str, dict[str, float | None]] = {}
    settings = {}
    for view in data.test:
        points = view.camera.to_camera(data.points)[2]
        near = options.share * points[points > 0].median().item()
        without = replace(conf, raster=replace(conf.raster, near=near))
        depths = view.camera.to_camera(gaussians.means)[2]
        close = ((depths > conf.raster.near) & (depths <= near)).sum().item()
        before, after = (mean_scores(gaussians, [view], of) for of in (conf, without))
        names = ("psnr", "lpips")
        rows[view.name] = {
            "close": close,
            **{name: before[name] for name in names},
            **{f"{name} without": after[name] for name in names},
        }
        settings[view.name] = (view.camera, (conf.raster, without.raster))
    table = pd.DataFrame.from_dict(rows, orient="index", dtype=float)
    best = (table["psnr without"] - table["psnr"]).idxmax()
    table.loc["mean"] = table.mean()
    print(table.to_string(float_format="{:,.3f}".format, formatters={"close": "{:,.0f}".format}))
    if options.image:
        camera, both = settings[str(best)]
        pair = [xrgs.rasterize(gaussians, camera, settings=of).image for of in both]
        pixels = (torch.cat(pair, dim=1).clamp(0, 1) * 255).round().to(torch.uint8)
        Image.fromarray(pixels.numpy()).save(options.image)


if __name__ == "__main__":
    main()
