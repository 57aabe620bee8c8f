#!/usr/bin/env bash
# nerfbaselines rounds the levels of a rendered picture down before it computes the metrics.
# Version:   nerfbaselines 1.2.12 (PyPI)
# Source:    nerfbaselines/utils.py, convert_image_dtype: a float picture times 255 is cut to uint8. io.save_image, and
#            so the .png from which `nerfbaselines evaluate` and the benchmark's tables come, go through it.
# Behaviour: a picture gets darker by 0.49 of 255 on average. 3DGS and torchvision's save_image round.
# Guess:     (before the run) each level is the nearest, so 8 bits cost a noise of 1 / sqrt(12) of a level and no bias.
# Matters:   the same picture has a lower PSNR than in a paper that rounds, the more the better it is; a gap between two
#            tables is then a gap between two roundings.
# Seen:      PSNR by nerfbaselines, of the float picture, saved, and rounded: 40.10, 39.91, 40.04 dB;
#            46.08, 45.32, 45.86 dB
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile nerfbaselines==1.2.12 numpy==1.26.4 pillow==12.0.0 \
  scikit-image==0.25.2
cd "$work"
bin/python - <<'PY'
import sys
import numpy as np
from nerfbaselines.io import save_image
from nerfbaselines.metrics import psnr
from PIL import Image
from skimage import data

photo = data.astronaut()[:256, :256].astype(np.float32) / 255
same = True
for deviation, gap in ((0.01, 0.1), (0.005, 0.4)):
    noise = np.random.default_rng(0).normal(0, deviation, photo.shape).astype(np.float32)
    view = np.clip(photo + noise, 0, 1)
    with open("view.png", "wb") as file:
        save_image(file, view)
    saved = np.asarray(Image.open("view.png"))
    rounded = np.rint(255 * view)
    values = [float(psnr(np.float32(picture), photo)) for picture in (view, saved / 255, rounded / 255)]
    bias = (saved - 255 * view).mean()
    print("PSNR {:.2f}, saved {:.2f}, rounded {:.2f} dB;".format(*values), f"bias {bias:.2f} of 255")
    same &= np.array_equal(saved, np.floor(255 * view)) and values[2] - values[1] > gap and bias < -0.45
sys.exit(not same)
PY
