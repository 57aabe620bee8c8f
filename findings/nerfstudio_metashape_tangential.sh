#!/usr/bin/env bash
# nerfstudio takes Metashape's tangential distortion p1, p2 for OpenCV's p1, p2, which are p2, p1.
# Version:   nerfstudio 1.1.5; opencv-python-headless 4.10.0.84 for OpenCV's lens
# Source:    nerfstudio/process_data/metashape_utils.py copies both by name, and cameras/camera_utils.py has OpenCV's
#            lens; nerfstudio issue 3714. Agisoft Metashape manual, "Camera models": x' has P1 (r2 + 2 x2) + 2 P2 x y,
#            where OpenCV has p2 (r2 + 2 x2) + 2 p1 x y.
# Behaviour: the camera of transforms.json has the tangential terms of x in y and of y in x. b1 and b2, the different
#            scale of x and the skew, are left out.
# Guess:     (the issue was read before the run) a point is projected to Metashape's pixel.
# Matters:   photographs bend by up to 26 px towards a corner, in all views alike: blur and floaters there, which a
#            comparison of methods takes for their own.
# Seen:      a calibration of a drone's camera of 8192x5460, p1 = -0.0013, p2 = 0.0008: up to 25.7 px off, 0.0 px with
#            the two exchanged
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile opencv-python-headless==4.10.0.84 imageio==2.38.1 \
    rich==14.3.4 numpy==2.4.6
python3 -m pip --quiet --python venv install --no-compile --no-deps nerfstudio==1.1.5
cat > cameras.xml <<'XML'
<document version="2.0.0"><chunk label="scan"><sensors next_id="1"><sensor id="0" label="drone" type="frame">
<resolution width="8192" height="5460"/>
<calibration type="frame" class="adjusted"><resolution width="8192" height="5460"/><f>8200</f><cx>15</cx><cy>16</cy>
<k1>-0.045</k1><k2>0.021</k2><k3>-0.09</k3><p1>-0.0013</p1><p2>0.0008</p2></calibration></sensor></sensors>
<cameras next_id="1"><camera id="0" sensor_id="0" label="first">
<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk></document>
XML
venv/bin/python - <<'PY'
import json
import sys
from pathlib import Path
from types import ModuleType
import cv2
import numpy as np

# Modules for point clouds and raw photographs, which no camera needs.
sys.modules |= {name: ModuleType(name) for name in ("open3d", "rawpy")}
from nerfstudio.process_data.metashape_utils import metashape_to_json

metashape_to_json({"first": Path("first.jpg")}, Path("cameras.xml"), Path())
camera = json.loads(Path("transforms.json").read_text())["frames"][0]
x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.33, 0.33, 21)))

r2 = x * x + y * y
radial = 1 - 0.045 * r2 + 0.021 * r2**2 - 0.09 * r2**3
p1, p2 = -0.0013, 0.0008
u = 4096 + 15 + 8200 * (x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y)
v = 2730 + 16 + 8200 * (y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y)

def furthest(first, second):
    """Return the largest distance in pixels of OpenCV's projection, with two tangential parameters, to Metashape's."""
    matrix = np.array([[camera["fl_x"], 0, camera["cx"]], [0, camera["fl_y"], camera["cy"]], [0, 0, 1]])
    lens = np.array([camera["k1"], camera["k2"], first, second, camera["k3"]])
    points = np.stack([x, y, np.ones_like(x)], axis=1)
    projected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, lens)
    return np.linalg.norm(projected.reshape(-1, 2) - np.stack([u, v], axis=1), axis=1).max()

written, exchanged = furthest(camera["p1"], camera["p2"]), furthest(camera["p2"], camera["p1"])
print(f"up to {written:.1f} px off as written, {exchanged:.1f} px with p1 and p2 exchanged")
sys.exit(not (written > 2 and exchanged < 0.1))
PY
