#!/usr/bin/env bash
# laspy rounds the points of a new cloud to hundredths.
# Version:   laspy 2.7.0
# Source:    laspy/header.py: a new LasHeader has scales of 0.01 and offsets of 0, and coordinates are stored as
#            integers times the scale.
# Behaviour: las.xyz = points keeps two decimals, in memory at once and in the file, whatever the size of the
#            scene, without a warning. A scale of 0.00001 that is set in the header first keeps five.
# Guess:     (before the run) coordinates within -1 to 1 come back to 1e-6.
# Matters:   scenes of COLMAP have any unit. A cloud of size 2, which starts the Gaussians, becomes a grid of 200 steps:
#            neighbours fall together, and the first scales, the distances to the neighbours, become 0.
# Seen:      100000 points within -0.1 to 0.1: off by up to 0.0050, 9249 places; scale 0.00001:
#            0.000005, 100000 places
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile laspy==2.7.0 numpy==2.4.6
venv/bin/python - <<'PY'
import sys
import laspy
import numpy as np

points = np.random.default_rng(0).uniform(-0.1, 0.1, (100_000, 3))

def written(scale=None):
    """Return the largest error and the number of different places in a file."""
    header = laspy.LasHeader(point_format=7, version="1.4")
    if scale:
        header.scales = np.full(3, scale)
    las = laspy.LasData(header)
    las.xyz = points
    las.write("cloud.las")
    back = laspy.read("cloud.las").xyz
    return np.abs(back - points).max(), len(np.unique(back, axis=0))

(error, places), (fine_error, fine_places) = written(), written(0.00001)
print(f"off by up to {error:.4f}, {places} places; scale 0.00001: {fine_error:.6f}, {fine_places} places")
sys.exit(not (error > 0.004 and places < 20_000 and fine_error < 1e-5))
PY
