#!/usr/bin/env bash
# kapture's importer for Bundler mirrors the keypoints against the cameras that it imports.
# Version:   kapture 1.1.12 (PyPI)
# Source:    tools/kapture_import_bundler.py: half of the height is added to a keypoint's y, whose axis points up in a
#            Bundler file (Bundler's manual, "Output format and scene representation"). Cameras and points get the half
#            turn from y up to y down, keypoints don't.
# Behaviour: a keypoint that is above the middle of the photograph by some pixels is imported as below it by as many.
#            Its point, seen by its camera, lies above.
# Guess:     (before the run) what is imported projects as Bundler's formula says.
# Matters:   each observation disagrees with its camera, so a bundle adjustment or a triangulation that starts from it
#            takes good poses apart, and the reprojection error of a good model is that of a failed one.
# Seen:      four points, 640 x 480: the imported keypoints are 114 to 204 px from their points' projections, and
#            0.00 px after y becomes 480 - y
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile kapture==1.1.12 numpy==2.4.6 pillow==12.0.0 scipy==1.17.1
cat > scene.py <<'PY'
import sys
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

SIZE = np.array([640, 480])
FOCAL, K1, K2 = 500.0, -0.1, 0.03
POINTS = np.array([[0.5, 0.4, 0.1], [-0.3, 0.2, 0.2], [0.1, -0.6, -0.1], [0.2, 0.3, 0.5]])

def write():
    rotation = Rotation.from_euler("xyz", [10, 20, 5], degrees=True).as_matrix()
    shift = np.array([0.1, 0.2, -3.0])
    # Bundler: the camera looks along -z, x points to the right and y up, pixels are counted from the middle.
    seen = POINTS @ rotation.T + shift
    flat = -seen[:, :2] / seen[:, 2:]
    radius = (flat**2).sum(1, keepdims=True)
    pixels = FOCAL * (1 + K1 * radius + K2 * radius**2) * flat
    lines = ["# Bundle file v0.3", f"1 {len(POINTS)}", f"{FOCAL} {K1} {K2}"]
    lines += [" ".join(map(str, row)) for row in [*rotation.tolist(), shift.tolist()]]
    for number, (point, (x, y)) in enumerate(zip(POINTS, pixels)):
        lines += [" ".join(map(str, point)), "255 255 255", f"1 0 {number} {x} {y}"]
    open("bundle.out", "w").write("\n".join(lines) + "\n")
    open("list.txt", "w").write("0.png\n")
    Image.new("RGB", tuple(SIZE)).save("0.png")

def rows(path):
    return [line.strip().split(", ") for line in open(path) if not line.startswith("#")]

def check():
    numbers = [float(value) for value in rows("model/sensors/trajectories.txt")[0][2:]]
    turn = Rotation.from_quat(numbers[:4], scalar_first=True)
    points = np.loadtxt("model/reconstruction/points3d.txt", delimiter=",", ndmin=2)[:, :3]
    seen = turn.apply(points) + numbers[4:]
    flat = seen[:, :2] / seen[:, 2:]
    radius = (flat**2).sum(1, keepdims=True)
    model, *values = rows("model/sensors/sensors.txt")[0][3:]
    focal, x, y, k1, k2 = map(float, values[2:])
    pixels = [x, y] + focal * (1 + k1 * radius + k2 * radius**2) * flat
    keypoints = np.fromfile("model/reconstruction/keypoints/sift/0.png.kpt", np.float32).reshape(-1, 2)
    off = np.linalg.norm(keypoints - pixels, axis=1)
    mirrored = np.linalg.norm(keypoints * [1, -1] + [0, SIZE[1]] - pixels, axis=1).max()
    print(f"{model}: keypoints {off.min():.0f} to {off.max():.0f} px off, mirrored {mirrored:.2f} px")
    sys.exit(not (model == "RADIAL" and off.min() > 100 and mirrored < 0.01))

write() if sys.argv[1] == "write" else check()
PY
venv/bin/python scene.py write
PATH="$work/venv/bin:$PATH" venv/bin/kapture_import_bundler -q -i bundle.out -l list.txt -im . \
  --image_transfer copy --add-reconstruction -o model > log 2>&1 || { cat log; exit 1; }
venv/bin/python scene.py check
