"""Trains fern by `splat.backend=gsplat` on a GPU and by `native`, and compares the two.

    python benchmarks/gpu.py LLFF          # baseline and plus, 3,000 steps at 504 px
    python benchmarks/gpu.py LLFF --paper  # baseline, 30,000 steps at 1,008 px, on the GPU only

LLFF is the folder that has `fern` (`xrgs-data download llff fern`). It needs `xrgs[gsplat]`, a GPU
of NVIDIA and nvcc, and `xrgs-data lpips` for LPIPS. The first cell compiles gsplat's kernels, for
some minutes.

It prints a line for each cell: recipe, backend, PSNR, LPIPS, Gaussians, and seconds of training.
With both backends it then prints the difference gsplat - native for each recipe, and ends with code
1 if PSNR differs by more than 0.3 dB or the number of Gaussians by more than 5 %. These bounds are
a guess: nobody has run this on a GPU yet. On the CPU, with `gsplat_api.rasterization` instead of
gsplat, the backends differ only by rounding (tests/training/test_gsplat.py).
"""

from __future__ import annotations

import argparse
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pandas as pd

import xrgs

#: The largest alpha of gsplat 1.5.3's kernels; that of 1.6 is our default.
ALPHA_MAX = "splat.raster.alpha_max=0.999"
#: The largest differences at which the backends count as equal: PSNR, dB; Gaussians, relative.
LARGEST_DB, LARGEST_SHARE = 0.3, 0.05
COLUMNS = ("psnr", "lpips", "gaussians", "training_time_s")


def main() -> None:
    """Parse the command line, train, and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("llff", type=Path, help="the folder that has fern")
    parser.add_argument("--paper", action="store_true", help="30,000 steps at 1,008 px on the GPU")
    parser.add_argument("--store", default="gpu-store", help="default: %(default)s")
    parser.add_argument("--backends", help="default: native,gsplat; with --paper gsplat")
    parser.add_argument("overrides", nargs="*", help="further settings, as train.steps=300")
    options = parser.parse_intermixed_args()
    backends = options.backends or ("gsplat" if options.paper else "native,gsplat")
    preset, recipes = ("paper", []) if options.paper else ("laptop", ["+ablation=plus"])
    settings = [ALPHA_MAX] if importlib.metadata.version("gsplat").startswith("1.5") else []
    settings += [f"preset={preset}", f"data_root={options.llff}", f"store={options.store}"]
    for backend in backends.split(","):
        arms = [*recipes, f"splat.backend={backend}"]  # and the baseline
        command = ["xrgs-sweep", "scene=llff/fern", *arms, *settings, *options.overrides]
        subprocess.run(command, check=True)  # noqa: S603
    cells = read(options.store)
    sys.stdout.write(cells.to_string(float_format="{:.3f}".format) + "\n")
    if {"native", "gsplat"} <= set(backends.split(",")):
        sys.exit(compare(cells))


def read(store: str) -> pd.DataFrame:
    """Return the newest done cell of each recipe and backend, indexed by (label, backend)."""
    home = xrgs.Store(store)
    cells = home.cells().query("state == 'done'")
    folders = [home.cell(cell_id) for cell_id in cells["cell_id"]]
    cells["backend"] = [folder.config().splat.backend for folder in folders]
    cells["ended"] = [folder.status_file.stat().st_mtime for folder in folders]
    newest = cells.sort_values("ended").groupby(["label", "backend"]).tail(1)
    return newest.set_index(["label", "backend"]).sort_index()[list(COLUMNS)]


def compare(cells: pd.DataFrame) -> int:
    """Print gsplat - native for each recipe; return 1 if a difference is too large, else 0."""
    native, gsplat = (cells.xs(name, level="backend") for name in ("native", "gsplat"))
    psnr, share = gsplat["psnr"] - native["psnr"], gsplat["gaussians"] / native["gaussians"] - 1
    for recipe in native.index:
        line = (
            f"{recipe}: gsplat less native: {psnr[recipe]:+.3f} dB, {share[recipe]:+.1%} Gaussians"
        )
        sys.stdout.write(line + "\n")
    return int((psnr.abs() > LARGEST_DB).any() or (share.abs() > LARGEST_SHARE).any())


if __name__ == "__main__":
    main()
