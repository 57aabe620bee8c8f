#!/usr/bin/env bash
# OpenImageIO gives the colours of a transparent .png multiplied by their opacity.
# Version:   openimageio 3.2.2.0, pillow 13.0.0
# Source:    OpenImageIO src/png.imageio/pnginput.cpp: colours are converted to associated alpha unless the hint
#            oiio:UnassociatedAlpha is given. By default that is done on the coded values, not on linear light
#            (png:linear_premult, pull request 4585).
# Behaviour: 200 100 50 with half the opacity is read as 100 50 25. Pillow, imageio and OpenCV give what is in
#            the file. ImageBuf does as ImageInput.
# Guess:     (before the run) the colours that are in the file.
# Matters:   the photographs of Blender's synthetic scenes are such files. The usual composite, colour times
#            opacity plus background, then multiplies twice: edges get a dark rim on white, at half
#            opacity a quarter of full brightness.
# Seen:      read 100 50 25 128 for 200 100 50 128; on white 177 152 140 for 227 177 152; with the hint as stored
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile openimageio==3.2.2.0 pillow==13.0.0 numpy==2.4.6
"$work/bin/python" - "$work/view.png" <<'PY'
import sys
import numpy as np
import OpenImageIO as oiio
from PIL import Image

path = sys.argv[1]
Image.fromarray(np.full((8, 8, 4), (200, 100, 50, 128), np.uint8)).save(path)
hint = oiio.ImageSpec()
hint["oiio:UnassociatedAlpha"] = 1
pixels = {
    "Pillow": np.array(Image.open(path))[0, 0],
    "ImageInput": oiio.ImageInput.open(path).read_image("uint8")[0, 0],
    "ImageBuf": oiio.ImageBuf(path).get_pixels(oiio.UINT8)[0, 0],
    "with the hint": oiio.ImageInput.open(path, hint).read_image("uint8")[0, 0],
}
for name, pixel in pixels.items():
    opacity = pixel[3] / 255
    white = (pixel[:3] * opacity + 255 * (1 - opacity)).round().astype(int)
    print(f"{name}:", *pixel, " on white:", *white)
stored = [200, 100, 50, 128]
expected = {"Pillow": stored, "ImageInput": [100, 50, 25, 128], "ImageBuf": [100, 50, 25, 128], "with the hint": stored}
sys.exit({name: pixel.tolist() for name, pixel in pixels.items()} != expected)
PY
