#!/usr/bin/env bash
# nerfstudio loses the principal point of a camera that OpenDroneMap has calibrated.
# Version:   nerfstudio 1.1.5
# Source:    nerfstudio/process_data/odm_utils.py: cameras2nerfds multiplies the focal length by the longer side of the
#            picture, but adds c_x and c_y to the middle of the picture as they are. OpenSfM, whose cameras
#            OpenDroneMap writes, has all of them in units of the longer side (OpenSfM issue 374).
# Behaviour: a principal point that is 26 px below the middle is written 0.5 px above it. The half pixel comes from
#            (width - 1) / 2, where nerfstudio's pixel centres are at 0.5.
# Guess:     (before the run) the principal point of the calibration, to 0.1 px, as the focal length is.
# Matters:   each photograph is shifted against its pose. A bundle of poses cannot be exact any more: blur and
#            floaters, which a comparison of methods takes for their own.
# Seen:      a DJI FC6310R, c_x = -0.00155 and c_y = 0.00475 of 5472 px: (2735.5, 1823.5) for (2727.5, 1850.0)
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile opencv-python-headless==4.10.0.84 imageio==2.38.1 \
    rich==14.3.4 numpy==2.4.6
python3 -m pip --quiet --python venv install --no-compile --no-deps nerfstudio==1.1.5
cat > cameras.json <<'JSON'
{"drone": {"projection_type": "brown", "width": 5472, "height": 3648, "focal_x": 0.6665, "focal_y": 0.6665,
  "c_x": -0.00155, "c_y": 0.00475, "k1": -0.264, "k2": 0.102, "p1": 0.0007, "p2": 0.0003, "k3": -0.026}}
JSON
cat > shots.geojson <<'JSON'
{"features": [{"properties": {"filename": "first.jpg", "rotation": [0, 0, 0], "translation": [0, 0, 0]}}]}
JSON
venv/bin/python - <<'PY'
import json
import sys
from pathlib import Path
from types import ModuleType

# Modules for point clouds and raw photographs, which no camera needs.
sys.modules |= {name: ModuleType(name) for name in ("open3d", "rawpy")}
from nerfstudio.process_data.odm_utils import cameras2nerfds

inputs = Path("cameras.json"), Path("shots.geojson"), Path("reconstruction.json")
cameras2nerfds({"first": Path("first.jpg")}, *inputs, Path())
camera = json.loads(Path("transforms.json").read_text())["frames"][0]
true = 5472 / 2 - 0.00155 * 5472, 3648 / 2 + 0.00475 * 5472
print(f"focal length {camera['fl_x']:.1f} px for {0.6665 * 5472:.1f}, principal point "
      f"({camera['cx']:.1f}, {camera['cy']:.1f}) for ({true[0]:.1f}, {true[1]:.1f})")
sys.exit(not (abs(camera["fl_x"] - 0.6665 * 5472) < 0.1 and abs(camera["cy"] - true[1]) > 10))
PY
