#!/usr/bin/env bash
# pycolmap's interpolate_camera_poses moves a camera that only turns.
# Version:   pycolmap 4.2.1
# Source:    colmap src/colmap/geometry/pose.cc: InterpolateCameraPoses interpolates the quaternion, and linearly the
#            translation of the transform from the world to the camera. The camera's centre is -R' t.
# Behaviour: the path of the centre is a straight line only without a turn. It depends on where the world has its
#            origin, and bends towards it.
# Guess:     (before the run) the centre at t = 0.5 is halfway between the two centres.
# Matters:   views of a smooth path, and poses at the times of a video's frames or of a GPS fix, stand beside the path:
#            by 13 % of the distance to the origin for a turn of 60 degrees. In a model in map coordinates, where
#            the origin is far away, by the size of the scene and more for a turn of some degrees.
# Seen:      10 from the origin, turned by 60 degrees: 1.34 away; 1000 from it, by 5 degrees: 0.95 away;
#            two centres 1 apart, 100 from the origin, by 10 degrees: 0.38 away
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pycolmap==4.2.1 scipy==1.17.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

def pose(centre, degrees):
    turn = Rotation.from_euler("y", degrees, degrees=True)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), -turn.as_matrix() @ np.array(centre, float))

changed = False
for first, second, degrees in (
    ([10, 0, 0], [10, 0, 0], 60),
    ([1000, 0, 0], [1000, 0, 0], 5),
    ([100, 0, 0], [101, 0, 0], 10),
):
    half = pycolmap.interpolate_camera_poses(pose(first, 0), pose(second, degrees), 0.5)
    centre = half.inverse().translation
    away = np.linalg.norm(centre - (np.array(first) + second) / 2)
    print(f"from {first} to {second}, {degrees} degrees: {away:.2f} away from halfway")
    changed |= bool(away < 0.1)
sys.exit(changed)
PY
