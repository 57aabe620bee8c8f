#!/usr/bin/env bash
# libvips converts 16-bit Display P3 to sRGB with errors of up to 8 of 255.
# Version:   pyvips 3.2.0 with pyvips-binary 8.18.7
# Source:    libvips pull requests 3368 and 3373: icc_transform lets LittleCMS replace a transform by a table
#            (OptimizeByResampling of cmsopt.c), and has no option against it.
# Behaviour: both profiles are a matrix and a curve, and all colours are inside of sRGB, yet 16 bits in and out
#            are interpolated in the table. 8 bits out are off by as much.
# Guess:     16 bits are exact to 0.01 of 255, as with the flag NOOPTIMIZE of LittleCMS.
# Matters:   16-bit photographs of a wide gamut, converted for training, get wrong colours in silence.
# Seen:      16 bits: off by up to 8.37 of 255, 0.18 in the mean; 8 bits out: 8.68, 0.37
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pyvips==3.2.0 pyvips-binary==8.18.7 numpy==2.3.5
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import pyvips

# Linear RGB -> XYZ (D65) of the two spaces, which have the same curve.
P3 = np.array([[0.48657, 0.26567, 0.19822], [0.22897, 0.69174, 0.07929], [0.0, 0.04511, 1.04394]])
SRGB = np.array([[0.41239, 0.35758, 0.18048], [0.21264, 0.71517, 0.07219], [0.01933, 0.11919, 0.95053]])

def linear(value):
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)

def encoded(value):
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 0) ** (1 / 2.4) - 0.055)

srgb = np.random.default_rng(0).uniform(0.02, 0.98, (64, 64, 3))
p3 = encoded(linear(srgb) @ SRGB.T @ np.linalg.inv(P3).T)
image = pyvips.Image.new_from_array(np.rint(65535 * p3).astype(np.uint16)).copy(interpretation="rgb16")
worst = []
for bits in (16, 8):
    converted = image.icc_transform("srgb", input_profile="p3", depth=bits, intent="relative")
    error = 255 * np.abs(converted.numpy() / (2**bits - 1) - srgb)
    print(f"{bits} bits: off by up to {error.max():.2f} of 255, {error.mean():.2f} in the mean")
    worst.append(error.max())
sys.exit(not min(worst) > 5)
PY
