#!/usr/bin/env bash
# gtsam 4.3's Python class for Bundler's camera leaves the distortion out of uncalibrate and calibrate.
# Version:   gtsam 4.3.0 (PyPI); 4.2.1 is right
# Source:    the help of gtsam.Cal3Bundler.uncalibrate and calibrate in 4.3.0: both are methods of gtsam.Cal3f, the new
#            class that it inherits from, which has a focal length and a principal point only.
# Behaviour: Cal3Bundler(f, k1, k2, u0, v0).uncalibrate(p) is u0 + f p, whatever k1 and k2, and calibrate is its
#            inverse. A PinholeCameraCal3Bundler of the same object distorts, and so do the factors of the graph.
#            Cal3DS2 with the same coefficients is right.
# Guess:     (before the run) the pixels of the formula with k1 and k2, as COLMAP's RADIAL.
# Matters:   points that are projected, or pixels that are made rays, by the calibration of a bundle adjustment are not
#            those that the adjustment had. A round trip through both methods is exact, so a test of it does not tell.
# Seen:      (0.5, 0.4) by f = 500, k1 = -0.1, k2 = 0.03: 570.0 440.0 by uncalibrate, 561.0 432.8 by the camera: 11.5 px
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile gtsam==4.3.0 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import gtsam
import numpy as np

focal, k1, k2, middle = 500.0, -0.1, 0.03, np.array([320.0, 240.0])
point = np.array([0.5, 0.4])
radius = point @ point
truth = middle + focal * (1 + k1 * radius + k2 * radius**2) * point
bundler = gtsam.Cal3Bundler(focal, k1, k2, *middle)
wrong = bundler.uncalibrate(point)
camera = gtsam.PinholeCameraCal3Bundler(gtsam.Pose3(), bundler).project(np.array([*point, 1.0]))
other = gtsam.Cal3DS2(focal, focal, 0.0, *middle, k1, k2).uncalibrate(point)
inverse = bundler.calibrate(truth)
off = np.linalg.norm(wrong - camera)
print(f"uncalibrate {wrong.round(1)}, the camera {camera.round(1)}: {off:.1f} px; its inverse {inverse.round(3)}")
right = np.allclose(camera, truth) and np.allclose(other, truth)
unbent = np.allclose(wrong, middle + focal * point) and np.allclose(inverse, (truth - middle) / focal)
sys.exit(not (right and unbent and off > 10))
PY
