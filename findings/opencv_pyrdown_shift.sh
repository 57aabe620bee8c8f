#!/usr/bin/env bash
# OpenCV's pyrDown moves the picture by half a pixel against its camera.
# Version:   opencv-python-headless 5.0.0.93
# Source:    documentation of pyrDown: the picture is blurred, and then each second row and column is left out.
# Behaviour: the pixel i of the small picture is the pixel 2i of the large one, not the middle of 2i and 2i + 1, where
#            a camera with half the focal length and half the principal point has it. INTER_AREA, and
#            scikit-image's pyramid_reduce, have it there.
# Guess:     (before the run) the edges of the pictures stay where they are.
# Matters:   a pyramid of photographs beside scaled cameras: each level adds half a pixel of the level above, so
#            three levels shift by 3.5 px of the photograph. No method can render that sharply.
# Seen:      one level -0.50 px of the photograph, three levels -3.50 px; resize with INTER_AREA 0.00 px
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import cv2
import numpy as np

photograph = np.tile(np.arange(512, dtype=np.float32) + 0.5, (512, 1))  # each pixel has the place of its centre

def shift(picture):
    """Return how far the middle of a small picture is from where a scaled camera sees it, in px of the photograph."""
    factor = 512 / picture.shape[1]
    middle = picture.shape[1] // 2
    return picture[middle, middle] - factor * (middle + 0.5)

one = cv2.pyrDown(photograph)
three = cv2.pyrDown(cv2.pyrDown(one))
area = cv2.resize(photograph, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
print(f"one level {shift(one):.2f} px, three levels {shift(three):.2f} px, INTER_AREA {shift(area):.2f} px")
sys.exit(not (shift(one) < -0.4 and shift(three) < -3 and abs(shift(area)) < 0.01))
PY
