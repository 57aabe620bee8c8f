#!/usr/bin/env bash
# image-similarity-measures scores photographs of 8 bits with the peak of 12 bits: 24.1 dB too much.
# Version:   image-similarity-measures 0.3.6
# Source:    PyPI; image_similarity_measures/quality_metrics.py: psnr and ssim have max_p=4095, and evaluate.py:
#            evaluation (the command line) reads two image files and calls them without another peak.
# Behaviour: two files of 8 bits get a PSNR that is 20 log10(4095 / 255) = 24.1 dB too high. SSIM, with constants for
#            the larger peak, is near 1. Neither the type of the pixels nor of the file matters.
# Guess:     (before the run) scikit-image's PSNR, with a peak of 255, for two files of 8 bits.
# Matters:   a noisy render of 28 dB is reported as 52 dB, an SSIM of 0.65 as 0.99.
# Seen:      PSNR 52.7 for 28.6 dB, SSIM 0.993 for 0.650
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile image-similarity-measures==0.3.6
"$work/bin/python" -W ignore - "$work" <<'PY'
import sys
import cv2
import numpy as np
from image_similarity_measures.evaluate import evaluation
from skimage.data import astronaut
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

photograph = astronaut()
render = (photograph + np.random.default_rng(0).normal(0, 10, photograph.shape)).clip(0, 255).round().astype(np.uint8)
files = [f"{sys.argv[1]}/{name}.png" for name in ("photograph", "render")]
for file, image in zip(files, (photograph, render)):
    cv2.imwrite(file, image)
seen = evaluation(*files, ["psnr", "ssim"])
psnr = peak_signal_noise_ratio(photograph, render)
ssim = structural_similarity(photograph, render, channel_axis=-1)
print(f"PSNR {seen['psnr']:.1f} for {psnr:.1f} dB, SSIM {seen['ssim']:.3f} for {ssim:.3f}")
sys.exit(not (abs(seen["psnr"] - psnr - 24.1) < 0.1 and seen["ssim"] > 0.98 and ssim < 0.7))
PY
