#!/usr/bin/env bash
# pytheia writes the first coefficient of distortion to COLMAP's cameras.txt twice, and never the second.
# Version:   pytheia 1.2.1; pycolmap 4.2.1 reads what it wrote
# Source:    urbste/pyTheiaSfM, src/theia/io/write_colmap_files.cc: WriteCamerasFile names RADIAL_DISTORTION_1 twice. It
#            is for pytheia's PINHOLE camera, which has k1 and k2 as COLMAP's RADIAL has.
# Behaviour: k2 becomes k1. Poses, focal length and principal point are right, and True is returned.
#            WriteNerfStudio writes k1 and k2 as they are.
# Guess:     (before the run) the same distortion, or an error.
# Matters:   what is trained or undistorted with the model is bent towards the corners of the photographs.
# Seen:      k1 = -0.2, k2 = 0.05 become -0.2, -0.2: 30 px off in the corner of 640 x 480
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pytheia==1.2.1 pycolmap==4.2.1 numpy==2.4.6
cd "$work"
mkdir model
cat > write.py <<'PY'
import numpy as np
import pytheia

prior = pytheia.sfm.CameraIntrinsicsPrior()
prior.image_width, prior.image_height = 640, 480
prior.camera_intrinsics_model_type = "PINHOLE"
settings = {
    "focal_length": [500.0],
    "principal_point": [320.0, 240.0],
    "aspect_ratio": [1.0],
    "radial_distortion": [-0.2, 0.05, 0.0, 0.0],
}
for name, value in settings.items():
    getattr(prior, name).value = value
    getattr(prior, name).is_set = True
scene = pytheia.sfm.Reconstruction()
for number in range(2):
    view = scene.MutableView(scene.AddView(f"{number}.png", 0, float(number)))
    view.SetCameraIntrinsicsPrior(prior)
    view.MutableCamera().SetFromCameraIntrinsicsPriors(prior)
    view.MutableCamera().SetPosition(np.array([number, 0.0, -3.0]))
    view.SetIsEstimated(True)
point = scene.MutableTrack(track := scene.AddTrack())
point.SetPoint(np.array([0.1, 0.2, 0.0, 1.0]))
point.SetIsEstimated(True)
for view in scene.ViewIds():
    pixel = scene.View(view).Camera().ProjectPoint(point.Point())[1]
    scene.AddObservation(view, track, pytheia.sfm.Feature(pixel))
written = pytheia.io.WriteColmapFiles(scene, "model")
nerfstudio = pytheia.io.WriteNerfStudio("images/", scene, 16, "transforms.json")
camera = scene.View(0).Camera()
camera.SetPosition(np.zeros(3))
print(written, nerfstudio, *camera.ProjectPoint(np.array([0.6, 0.45, 1.0, 1.0]))[1])
PY
cat > read.py <<'PY'
import json
import math
import sys
import pycolmap

written, nerfstudio, *theirs = sys.argv[1:]
camera = next(iter(pycolmap.Reconstruction("model").cameras.values()))
distance = math.dist(map(float, theirs), camera.img_from_cam([0.6, 0.45, 1]))
frame = json.load(open("transforms.json"))["frames"][0]
right = [frame["k1"], frame["k2"]]
print(camera.model.name, *camera.params, f"{distance:.0f} px off; transforms.json {right}")
wrong = list(camera.params[3:]) == [-0.2, -0.2] and list(camera.params[:3]) == [500, 320, 240] and distance > 20
sys.exit(not (written == nerfstudio == "True" and right == [-0.2, 0.05] and wrong))
PY
"$work/bin/python" write.py > seen
read -ra seen < seen
"$work/bin/python" read.py "${seen[@]}"
