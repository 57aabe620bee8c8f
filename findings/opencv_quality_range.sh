#!/usr/bin/env bash
# OpenCV's quality.QualitySSIM and QualityGMSD take any picture for one of 0 to 255.
# Version:   OpenCV 5.0.0 (opencv-contrib-python-headless 5.0.0.93); scikit-image 0.26.0 for comparison
# Source:    opencv_contrib, modules/quality/src/qualityssim.cpp and qualitygmsd.cpp: the constants are those of a peak
#            of 255 (6.5025, 58.5225 and 170). Only QualityPSNR has an argument for the peak. The documentation names no
#            range.
# Behaviour: pictures in 0 to 1, which is what a renderer makes, are compared with constants that are 65025 times too
#            large: whatever they show, SSIM is near 1 and GMSD near 0.
# Guess:     (before the run) the value of the same pictures in 8 bits, to 0.005.
# Matters:   a bad picture scores 0.9998, so all methods are alike to three digits, and a table of them looks precise.
# Seen:      SSIM 0.9998 for 0.324 in 8 bits (scikit-image, Gaussian window: 0.322 of both), GMSD 0.000014 for 0.185
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile opencv-contrib-python-headless==5.0.0.93 \
  scikit-image==0.26.0 numpy==2.4.6 scipy==1.17.1
"$work/bin/python" - <<'PY'
import sys
import cv2
import numpy as np
from skimage import data
from skimage.metrics import structural_similarity

photo = data.astronaut()[:256, :256].astype(np.float32) / 255
noise = np.random.default_rng(0).normal(0, 0.1, photo.shape).astype(np.float32)
views = photo, np.clip(photo + noise, 0, 1)
bits = [np.rint(255 * view).astype(np.uint8) for view in views]

def mean(metric, pair):
    return np.mean(metric(*pair)[0][:3])

ssim, gmsd = cv2.quality.QualitySSIM_compute, cv2.quality.QualityGMSD_compute
settings = dict(channel_axis=2, gaussian_weights=True, use_sample_covariance=False)
truth = [structural_similarity(*pair, data_range=peak, **settings) for pair, peak in ((views, 1), (bits, 255))]
seen = mean(ssim, views), mean(ssim, bits), mean(gmsd, views), mean(gmsd, bits)
print("SSIM {:.4f}, in 8 bits {:.4f}; GMSD {:.6f}, in 8 bits {:.4f}".format(*seen), "scikit-image", np.round(truth, 4))
right = abs(truth[0] - truth[1]) < 0.005 and abs(seen[1] - truth[1]) < 0.01
sys.exit(not (right and seen[0] > 0.999 and seen[2] < 0.001 < 0.1 < seen[3]))
PY
