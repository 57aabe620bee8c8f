"""Render a .ply of 3D Gaussian Splatting to a PNG, from a camera on an orbit around it.

    python examples/render_ply.py splats.ply image.png --azimuth 30 --elevation 15

The .ply may be a cell's `splats.ply`, or any other trainer's; a .glb or .spz will do too.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import torch
from PIL import Image

import xrgs


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("ply", help="the .ply, .glb or .spz file to render")
    parser.add_argument("png", help="the image to write")
    parser.add_argument("--width", type=int, default=640, help="px (default: %(default)s)")
    parser.add_argument("--height", type=int, default=480, help="px (default: %(default)s)")
    parser.add_argument("--fov", type=float, default=50, help="horizontal field of view, degrees")
    parser.add_argument("--azimuth", type=float, default=0, help="around the up axis, degrees")
    parser.add_argument("--elevation", type=float, default=15, help="above the target, degrees")
    parser.add_argument("--distance", type=float, help="from the target; default: all in view")
    parser.add_argument("--target", type=float, nargs=3, help="x y z; default: the median mean")
    parser.add_argument("--up", choices="xyz", default="z", help="axis of the orbit")
    return parser.parse_args(arguments)


def orbit_camera(gaussians: xrgs.Gaussians, options: argparse.Namespace) -> xrgs.Camera:
    """Return the camera of the options, with defaults that show most of the Gaussians."""
    means = gaussians.means.detach()
    target = means.median(dim=0).values if options.target is None else torch.tensor(options.target)
    radius = (means - target).norm(dim=1).quantile(0.9).item()
    distance = options.distance or radius / math.sin(math.radians(options.fov) / 2)
    azimuth, elevation = math.radians(options.azimuth), math.radians(options.elevation)
    along = math.cos(elevation)
    offset = torch.tensor(
        [along * math.sin(azimuth), -along * math.cos(azimuth), math.sin(elevation)]
    )
    # The orbit is written for z up; another axis takes its place in turn.
    turns = {"z": 0, "x": 1, "y": 2}[options.up]
    position = target + distance * offset.roll(turns)
    up = torch.tensor([0.0, 0.0, 1.0]).roll(turns)
    return xrgs.Camera.look_at(
        position.tolist(),
        target.tolist(),
        width=options.width,
        height=options.height,
        fov=options.fov,
        up=up.tolist(),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Render the .ply of the command line."""
    options = parse(arguments)
    gaussians, antialiased = xrgs.load_gaussians(options.ply)
    settings = xrgs.RasterSettings(antialiased=antialiased)
    with torch.no_grad():
        image = xrgs.rasterize(gaussians, orbit_camera(gaussians, options), settings=settings).image
    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(pixels.numpy()).save(options.png)
    print(f"{options.png}: {len(gaussians)} Gaussians, {options.width} x {options.height} px")


if __name__ == "__main__":
    main()
