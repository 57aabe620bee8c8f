#!/usr/bin/env bash
# OpenCV's recoverPose turns one of two cameras round where the scene is farther than 50 baselines.
# Version:   opencv-python-headless 5.0.0.93
# Source:    opencv, five-point.cpp: recoverPose without distanceThresh calls the overload that has it with 50. A
#            point farther than that fails the check of being in front of the cameras. The documentation names the
#            threshold only for the overload that returns the points.
# Behaviour: of four poses that fit the essential matrix, the one with most points in front wins. Beyond 50 baselines
#            each of them has none, so the choice is arbitrary: 0 inliers and no error. With distanceThresh=1e6 all
#            poses are right.
# Guess:     (before the run) exact matches and the exact essential matrix give the rotation, and all are inliers.
# Matters:   neighbouring frames of a video, and photographs from the air, are such pairs: rotations are wrong by up
#            to half a turn, translations have the opposite sign.
# Seen:      20 baselines away: 0 of 20 poses are wrong; 100 baselines: 16 of 20, with 0 inliers of 300; with
#            distanceThresh: 0 of 20
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import cv2
import numpy as np

K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])

def wrong(depth, **threshold):
    """Return how many of 20 pairs get a wrong pose, and the most inliers, for points at a depth in baselines."""
    rng, count, inliers = np.random.default_rng(0), 0, []
    for _ in range(20):
        turn, shift = rng.normal(0, 0.03, 3), rng.normal(size=3)
        shift /= np.linalg.norm(shift)
        points = np.c_[rng.uniform(-0.5, 0.5, (300, 2)) * depth, depth * rng.uniform(0.9, 1.3, 300)]
        poses = (np.zeros(3), np.zeros(3)), (turn, shift)
        first, second = (cv2.projectPoints(points, *pose, K, None)[0][:, 0] for pose in poses)
        R = cv2.Rodrigues(turn)[0]
        x, y, z = shift
        E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
        found, R_found, t_found = cv2.recoverPose(E, first, second, K, **threshold)[:3]
        inliers.append(found)
        count += not (np.allclose(R_found, R, atol=1e-3) and np.allclose(t_found[:, 0], shift, atol=1e-3))
    return count, max(inliers)

near, far, open_end = wrong(20), wrong(100), wrong(100, distanceThresh=1e6)
print(f"20 baselines away: {near[0]} of 20 poses are wrong; 100 baselines: {far[0]} of 20, with {far[1]} inliers of 300")
print(f"with distanceThresh: {open_end[0]} of 20")
sys.exit(not (near[0] == 0 and far[0] > 5 and far[1] == 0 and open_end[0] == 0))
PY
