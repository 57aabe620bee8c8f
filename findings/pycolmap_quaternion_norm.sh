#!/usr/bin/env bash
# pycolmap's Rotation3d of a quaternion whose norm is not 1 is no rotation.
# Version:   pycolmap 4.2.1
# Source:    pycolmap's bindings of Eigen's quaternion: the constructor takes "Quaternion in [x,y,z,w] format" as it is,
#            and matrix() is Eigen's formula for a norm of 1. normalize() is a method of its own.
# Behaviour: points are sheared and turned too far: for a norm of n the part of the turned vector that differs from the
#            vector is n squared times too long.
# Guess:     (before the run) the quaternion is normalised, as SciPy's Rotation.from_quat does, or refused.
# Matters:   quaternions that were optimised, as poses and Gaussians are, drift from a norm of 1 and are normalised
#            when they are used. Poses that are built from them point elsewhere, without an error.
# Seen:      a turn by 60 degrees, norm 1.1: 69.3 degrees and a determinant of 1.25; SciPy 60.0 degrees
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

def turned(matrix):
    """Return by how many degrees a matrix turns the axis of view."""
    view = matrix @ [0, 0, 1]
    return np.degrees(np.arccos(view[2] / np.linalg.norm(view)))

quaternion = 1.1 * Rotation.from_euler("y", 60, degrees=True).as_quat()
ours, theirs = pycolmap.Rotation3d(quaternion).matrix(), Rotation.from_quat(quaternion).as_matrix()
print(f"{turned(ours):.1f} degrees, determinant {np.linalg.det(ours):.2f}; SciPy {turned(theirs):.1f} degrees")
sys.exit(not (turned(ours) > 65 and np.linalg.det(ours) > 1.2 and abs(turned(theirs) - 60) < 1e-6))
PY
