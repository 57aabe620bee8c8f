#!/usr/bin/env bash
# poselib ignores options that it does not know, so a threshold may not be the one that was given.
# Version:   poselib 2.0.5
# Source:    PoseLib pybind/helpers.h: `update` takes the names of RansacOptions from the dict, one by one, and looks
#            at no others. The threshold of relative poses is max_epipolar_error, 1 px by default, that of absolute
#            poses max_reproj_error, 12 px.
# Behaviour: max_reproj_error for a relative pose, max_epipolar_error for an absolute one, and any misspelled name,
#            leave the default threshold, without a warning.
# Guess:     (before the run) an unknown or misspelled option raises.
# Matters:   a study of thresholds has one and the same result for all of them, and one of two methods "with equal
#            thresholds" compares 1 px with 12 px.
# Seen:      210 right matches with 3 px of noise, 90 wrong ones; inliers of the relative pose for max_epipolar_error
#            of 1, 4, 12: 63, 177, 210; for max_reproj_error or max_error of 1, 4, 12: 63 each time
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile poselib==2.0.5 scipy==1.17.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

rng = np.random.default_rng(0)
points = rng.uniform([-2, -2, 4], [2, 2, 6], (300, 3))
camera = {"model": "SIMPLE_PINHOLE", "width": 1000, "height": 1000, "params": [800.0, 500, 500]}

def pixels(seen):
    return 800 * seen[:, :2] / seen[:, 2:] + 500 + rng.normal(0, 3, (300, 2))

first, second = pixels(points), pixels(Rotation.from_rotvec([0, 0.2, 0]).apply(points) + [1, 0, 0])
second[:90] = rng.uniform(0, 1000, (90, 2))
inliers = {}
for name in ("max_epipolar_error", "max_reproj_error", "max_error"):
    options = [{name: threshold} for threshold in (1.0, 4.0, 12.0)]
    results = [poselib.estimate_relative_pose(first, second, camera, camera, option, {}) for option in options]
    inliers[name] = [found["num_inliers"] for _, found in results]
    print(f"{name} of 1, 4, 12 px: {inliers[name]} inliers")
known = inliers.pop("max_epipolar_error")
sys.exit(not (known[0] < known[1] < known[2] and all(found == known[:1] * 3 for found in inliers.values())))
PY
