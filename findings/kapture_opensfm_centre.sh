#!/usr/bin/env bash
# kapture's export to OpenSfM drops the principal point.
# Version:   kapture 1.1.12 (PyPI)
# Source:    kapture/converter/opensfm/export_opensfm.py: a SIMPLE_RADIAL or RADIAL camera becomes OpenSfM's
#            "perspective", which has a focal length, k1 and k2 only. OpenSfM's "brown" has c_x and c_y.
# Behaviour: the camera comes out with its principal point in the middle of the photograph, and nothing is said. An
#            OPENCV camera, which "perspective" can't hold either, is refused with an error.
# Guess:     (before the run) poses and intrinsics are kept.
# Matters:   COLMAP's refined principal point, or that of cropped or undistorted photographs, is lost: all that is
#            projected or triangulated afterwards is off by as much.
# Seen:      RADIAL 510, 300, 252, -0.1, 0.03 of 640 x 480 becomes "perspective" with a focal length of 510 px, k1 and
#            k2: its middle, 320, 240, is 23 px off
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile kapture==1.1.12 numpy==2.4.6 pillow==12.0.0
mkdir model photos
echo '1 RADIAL 640 480 510 300 252 -0.1 0.03' > model/cameras.txt
printf '1 1 0 0 0 0.1 0.2 0.3 1 0.png\n\n' > model/images.txt
: > model/points3D.txt
venv/bin/python -c 'from PIL import Image; Image.new("RGB", (640, 480)).save("photos/0.png")'
PATH="$work/venv/bin:$PATH"
{
  kapture_import_colmap -q -txt model -im photos --image_transfer copy -o kapture
  kapture_export_opensfm -k kapture -o opensfm --transfer copy
} > log 2>&1 || { cat log; exit 1; }
venv/bin/python - <<'PY'
import json
import math
import sys

line = next(line for line in open("kapture/sensors/sensors.txt") if not line.startswith("#"))
model, *values = line.strip().split(", ")[3:]
width, height, focal, x, y, k1, k2 = map(float, values)
(camera,) = json.load(open("opensfm/camera_models.json")).values()
off = math.dist((x, y), (width / 2, height / 2))
print(model, *values, "->", camera, f": {off:.0f} px off")
bare = {"projection_type", "width", "height", "focal", "k1", "k2"}
same = [camera["focal"] * max(width, height), camera["k1"], camera["k2"]] == [focal, k1, k2]
sys.exit(not (set(camera) == bare and camera["projection_type"] == "perspective" and same and off > 20))
PY
