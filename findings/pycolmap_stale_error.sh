#!/usr/bin/env bash
# pycolmap's compute_mean_reprojection_error computes no reprojection.
# Version:   pycolmap 4.2.1
# Source:    colmap src/colmap/scene/reconstruction.cc: Reconstruction::ComputeMeanReprojectionError averages
#            the errors that are stored with the points; UpdatePoint3DErrors projects them.
# Behaviour: after a change of the cameras, poses or points the mean is that from before, in memory and in
#            the files that are written, until update_point_3d_errors is called.
# Guess:     a function named compute, of a model in memory, projects the points: another focal length,
#            another error.
# Matters:   poses that were edited, or cameras that were scaled wrongly, pass a check of their error.
# Seen:      focal length 10 % too long: 0.00 px before the update and read back, 20.19 px after it
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pycolmap==4.2.1
"$work/bin/python" - "$work" <<'PY'
import sys
import pycolmap

pycolmap.set_random_seed(0)
model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions())
for camera in model.cameras.values():
    params = camera.params
    params[0] *= 1.1  # the focal length
    camera.params = params
model.write_text(sys.argv[1])
stale = model.compute_mean_reprojection_error()
written = pycolmap.Reconstruction(sys.argv[1]).compute_mean_reprojection_error()
model.update_point_3d_errors()
true = model.compute_mean_reprojection_error()
print(f"in memory {stale:.2f} px, read back {written:.2f} px, after the update {true:.2f} px")
sys.exit(not (stale < 1e-6 and true > 5))
PY
