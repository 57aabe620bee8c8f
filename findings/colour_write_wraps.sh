#!/usr/bin/env bash
# colour-science writes values a little above 1 as black and values a little below 0 as white.
# Version:   colour-science 0.4.7
# Source:    colour/io/image.py, `convert_bit_depth`: floats are multiplied by 255 or 65535, rounded and cast to the
#            integer type, without a clip.
# Behaviour: the cast takes the last 8 or 16 bits: 1.05 becomes 268, of which 12 stays. `write_image` goes by it.
# Guess:     (before the run) 255 for 1.05 and 0 for -0.01: values are clipped.
# Matters:   renders and colours that were converted to another space lie outside 0 to 1 in highlights and deep
#            shadows. A few such pixels cost more PSNR than all other errors.
# Seen:      -0.01, 0, 0.5, 1, 1.05 are written as 253, 0, 128, 255, 12; a render with 1 % of its pixels at 1.02: 20 dB
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile colour-science==0.4.7 imageio==2.38.1 numpy==2.4.6
venv/bin/python - <<'PY' 2>/dev/null
import sys
import colour
import numpy as np

def written(picture):
    colour.write_image(picture, "render.png", bit_depth="uint8", method="Imageio")
    return np.round(colour.read_image("render.png", method="Imageio") * 255).astype(int)

row = np.array([-0.01, 0, 0.5, 1, 1.05])
levels = written(np.tile(row[None, :, None], (2, 1, 3)))[0, :, 0]
print("written as", *levels)
render = np.random.default_rng(0).uniform(0, 1, (100, 100, 3))
render[0] = 1.02
error = np.mean((written(render) / 255 - np.clip(render, 0, 1)) ** 2)
print(f"one row of 100 at 1.02: {-10 * np.log10(error):.1f} dB")
sys.exit(not (levels[0] > 200 and levels[-1] < 50 and list(levels[1:4]) == [0, 128, 255] and error > 0.005))
PY
