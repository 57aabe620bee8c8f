#!/usr/bin/env bash
# torch's antialias=True changes bicubic enlargement, where there is nothing to alias.
# Version:   torch 2.13.0 (its build for the CPU will do)
# Source:    aten/src/ATen/native/UpSample.h and cpu/UpSampleKernel.cpp: the bicubic kernel has a = -0.75, and
#            -0.5 with antialias, as Pillow's. Pull request 68819 of pytorch/pytorch says so; the documentation
#            of interpolate does not.
# Behaviour: enlarging by 4 with and without antialias gives two pictures. For bilinear they are the same.
# Guess:     antialias widens the filter when reducing, and does nothing when enlarging.
# Matters:   bicubic is the baseline that super-resolution is compared with, and enlarges LR photographs:
#            which of the two it was is seldom said, and they are 34 dB apart on noise.
# Seen:      bilinear: 325.6 dB apart (rounding); bicubic: 33.9 dB apart
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from torch.nn.functional import interpolate

image = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
apart = {}
for mode in ("bilinear", "bicubic"):
    plain, filtered = (interpolate(image, scale_factor=4, mode=mode, antialias=yes) for yes in (False, True))
    apart[mode] = -10 * torch.log10(((plain - filtered) ** 2).mean() + 1e-40).item()
print("".join(f"{mode}: {psnr:.1f} dB apart; " for mode, psnr in apart.items()))
sys.exit(not (apart["bilinear"] > 200 and apart["bicubic"] < 40))
PY
