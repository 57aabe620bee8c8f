#!/usr/bin/env bash
# torch's interpolate with one scale_factor samples two grids: `area` another than `bilinear` and `bicubic`.
# Version:   torch 2.13.0 (its build for the CPU will do)
# Source:    torch/nn/functional.py: interpolate. mode="area" is adaptive average pooling between the two
#            sizes; bilinear and bicubic use the scale_factor as given (recompute_scale_factor is not set).
#            Documentation of interpolate: the note on recompute_scale_factor.
# Behaviour: where the factor does not divide the side, 1/8 of 1015 pixels is 126 pixels. `area` spreads them
#            over all 1015; bilinear, with antialias or not, steps by exactly 8 and leaves 7 pixels out at the
#            right and bottom.
# Guess:     the same factor of the same image gives the same picture, only filtered otherwise.
# Matters:   LR photographs of two degradations don't lie on each other, and the camera that was scaled by the
#            ratio of the sizes fits only one: an error that grows to 6.5 pixels of the HR photograph, 0.8 of
#            the LR one.
# Seen:      the last pixel looks at column 1010.5 by area, at 1004.0 by bilinear with antialias
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from torch.nn.functional import interpolate

side = 1015
columns = (torch.arange(side, dtype=torch.float64) + 0.5).expand(1, 1, side, side)  # each pixel tells its column
last = {
    mode: interpolate(columns, scale_factor=1 / 8, mode=mode, **options)[0, 0, 60, -1].item()
    for mode, options in (("area", {}), ("bilinear", {}), ("bicubic", {"antialias": True}))
}
print("the last pixel looks at column", last)
sys.exit(not (last["area"] - last["bilinear"] > 6 and abs(last["bicubic"] - last["bilinear"]) < 1))
PY
