"""Acts as OpenSplat for `benchmarks/race.py`: a .ply every N steps of the Gaussians that it knows.

It has the options, the lines and the habits of OpenSplat 1.1.5 that the race relies on. Its
"training" leaves the points of the model as they are, so that the quality of its .ply is known.
"""

from __future__ import annotations

import argparse
import sys
import time
import zlib  # noqa: F401  pycolmap 4.2.1 corrupts the heap where it is imported before zlib
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

Array = NDArray[Any]

SECONDS_A_STEP, SECONDS_A_FILE = 0.002, 0.05
C0 = 0.28209479177387814  # of the spherical harmonics of band 0


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("input", nargs="?", type=Path)
    parser.add_argument("-n", type=int, default=30000)
    parser.add_argument("-o", type=Path)
    parser.add_argument("--save-every", type=int)
    parser.add_argument("--keep-crs", action="store_true")
    parser.add_argument("--version", action="store_true")
    for name in ("resolution-schedule", "sh-degree-interval", "warmup-length"):
        parser.add_argument(f"--{name}", type=int)
    parser.add_argument("--stop-screen-size-at", type=int)
    args = parser.parse_args()
    if args.version:
        say("1.1.5 (stand-in)")
        return
    assert args.keep_crs, "without it the .ply is in another world"
    model = pycolmap.Reconstruction(args.input / "sparse" / "0")
    for image in model.images.values():
        say(f"Loading {args.input / 'images' / image.name}")
        assert (args.input / "images" / image.name).is_file()
    points = list(model.points3D.values())
    table = vertices(np.array([p.xyz for p in points]), np.array([p.color for p in points]))
    for step in range(1, args.n + 1):
        time.sleep(SECONDS_A_STEP)
        say(f"Step {step}: 0.1 ({100 * step // args.n}%)")
        if step % args.save_every == 0:
            save(table, args.o.with_name(f"{args.o.stem}_{step}.ply"))
    say(f"Wrote {args.o.parent / 'cameras.json'}")
    save(table, args.o)


def vertices(means: Array, colors: Array) -> Array:
    """One opaque Gaussian for each point, as large as its distance to the nearest other point."""
    apart = np.linalg.norm(means[:, None] - means[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    columns: dict[str, Any] = dict(zip("xyz", means.T, strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), 0.0)
    sh0 = (colors / 255 - 0.5) / C0
    columns |= {f"f_dc_{channel}": sh0[:, channel] for channel in range(3)}
    columns |= dict.fromkeys((f"f_rest_{number}" for number in range(45)), 0.0)
    columns |= {"opacity": 4.0}
    columns |= {f"scale_{axis}": np.log(apart.min(axis=1)) for axis in range(3)}
    columns |= {"rot_0": 1.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0}
    table = np.zeros(len(means), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def save(table: Array, file: Path) -> None:
    time.sleep(SECONDS_A_FILE)
    PlyData([PlyElement.describe(table, "vertex")]).write(file)
    say(f"Wrote {file}")


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
