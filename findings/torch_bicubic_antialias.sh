#!/usr/bin/env bash
# torch's bicubic interpolation with antialias=True has another kernel, also where it enlarges.
# Version:   torch 2.13.0 (its build for the CPU will do), scikit-image 0.26.0 for its photograph
# Source:    pytorch aten/src/ATen/native/cpu/UpSampleKernel.cpp: the antialiased bicubic filter has the
#            coefficient -0.5, as Pillow; the other one -0.75, as OpenCV. The documentation of interpolate says
#            that antialias matches Pillow "for downsampling operation".
# Behaviour: antialias=True enlarges by a softer kernel than antialias=False. Bilinear interpolation enlarges to
#            the same values with both.
# Guess:     (before the run) there is nothing to filter away when an image is enlarged: the same values.
# Matters:   the bicubic baseline of super-resolution, and LR photographs that are enlarged for a loss, change by
#            an option that is about something else. As large as differences between methods.
# Seen:      LR photograph enlarged 4 times: 25.60 dB without antialias, 25.41 dB with it; bilinear: equal
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 scikit-image==0.26.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from skimage.data import astronaut
from torch.nn.functional import interpolate

photograph = torch.tensor(astronaut()).permute(2, 0, 1)[None].double() / 255
small = interpolate(photograph, scale_factor=1 / 4, mode="bicubic", antialias=True)

def enlarged(mode, antialias):
    return interpolate(small, scale_factor=4, mode=mode, antialias=antialias)

def psnr(image):
    return -10 * (image.clamp(0, 1) - photograph).square().mean().log10().item()

without, with_it = (psnr(enlarged("bicubic", antialias)) for antialias in (False, True))
bilinear = (enlarged("bilinear", True) - enlarged("bilinear", False)).abs().max().item()
print(f"without antialias {without:.2f} dB, with it {with_it:.2f} dB; bilinear: {bilinear:.0e} between the two")
sys.exit(not (0.1 < without - with_it < 0.4 and bilinear < 1e-9))
PY
