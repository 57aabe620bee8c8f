#!/usr/bin/env bash
# fourdgs turns the Gaussians of a compressed .ply: it takes w of their quaternions for x.
# Version:   fourdgs 0.6.0; @playcanvas/splat-transform 3.7.0 writes the compressed .ply and reads it back; Node 20
# Source:    fourdgs/compressed_ply.py, `_decode_rotation`: without the columns for time "the static layout indexes
#            it in XYZW". splat-transform packs rot_0 to rot_3, which are w, x, y, z.
# Behaviour: w, x, y, z come back as x, y, z, w. Places, sizes, colours, opacities and harmonics are right, and the file
#            passes `fourdgs validate`.
# Guess:     (before the run) the same rotations, to the 10 bits of the format.
# Matters:   a scene that goes through .4dgs to glTF or USD has the right colours in the right places and every long
#            Gaussian across its surface. Scores of the renders fall, and the method gets the blame.
# Seen:      half of 500 Gaussians turned by more than 151 degrees, three quarters by more than 120; splat-transform 0.2
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0 > log 2>&1 || { cat log; exit 1; }
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile fourdgs==0.6.0 numpy==2.4.6 scipy==1.17.1
cat > write.py <<'PY'
import numpy as np

names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
rows = np.random.default_rng(0).normal(size=(500, len(names)))
rows[:, 7:10] -= 3
rows[:, 10:] /= np.linalg.norm(rows[:, 10:], axis=1, keepdims=True)
header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
open("scene.ply", "wb").write(header.encode() + rows.astype("<f4").tobytes())
PY
cat > compare.py <<'PY'
import sys
import fourdgs
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

def read(file):
    """Return the places and the rotations (x, y, z, w) of a plain .ply."""
    header, data = open(file, "rb").read().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names))
    columns = [[names.index(name) for name in text.split()] for text in ("x y z", "rot_1 rot_2 rot_3 rot_0")]
    return rows[:, columns[0]], rows[:, columns[1]]

def degrees(places, rotations):
    """Return by how many degrees each Gaussian of the scene has been turned."""
    distance, same = cKDTree(places).query(right_places)
    assert distance.max() < 0.01
    return np.degrees((Rotation.from_quat(rotations[same]) * Rotation.from_quat(right).inv()).magnitude())

right_places, right = read("scene.ply")
scene = fourdgs.read_compressed_ply("scene.compressed.ply")
theirs = degrees(scene["positions"], scene["rotations"])
theirs_wxyz = degrees(scene["positions"], scene["rotations"][:, [1, 2, 3, 0]])
control = degrees(*read("back.ply"))
print(f"fourdgs: median {np.median(theirs):.0f} degrees, lower quartile {np.percentile(theirs, 25):.0f};", end=" ")
print(f"taken as w, x, y, z at most {theirs_wxyz.max():.1f}; splat-transform at most {control.max():.1f}")
sys.exit(not (np.median(theirs) > 90 and theirs_wxyz.max() < 1 and control.max() < 1))
PY
venv/bin/python write.py
npx splat-transform -q -w scene.ply scene.compressed.ply > log 2>&1 || { cat log; exit 1; }
npx splat-transform -q -w scene.compressed.ply back.ply > log 2>&1 || { cat log; exit 1; }
venv/bin/python compare.py
