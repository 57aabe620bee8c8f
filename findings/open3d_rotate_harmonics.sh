#!/usr/bin/env bash
# Open3D's rotate makes the harmonics of Gaussians larger, by the identity too, and turns them about x and y backwards.
# Version:   open3d-cpu 0.20.0, the first release that reads Gaussians
# Source:    Open3D cpp/open3d/t/geometry/PointCloud.cpp: BuildIrRl divides by l (2l - 1) where Ivanic and Ruedenberg
#            have 2l (2l - 1), so the outer columns of each degree are the square root of 2 too large. BuildIrR1
#            orders the axes y, z, x with equal signs; the basis of a .ply is -y, z, -x. PointCloud.h
#            says that rotate turns f_rest.
# Behaviour: f_rest of degrees 2 and 3 grows by each call. Degree 1 turns the right way about z only.
#            Positions, shapes and base colours are right. transform() says in a warning that it leaves them.
# Guess:     (before the run) the colour that is seen from a turned direction stays as it was.
# Matters:   a scene that is levelled or aligned to another has false colours which depend on the view, and
#            four quarter turns are not the scene again.
# Seen:      by the identity: degree 1 1.00, degree 2 1.18, degree 3 1.46 times as large; after four quarter turns 1.00,
#            2.63, 8.82; degree 1, a quarter turn about x: error 1.66 of 1, of the opposite turn 0.00
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile open3d-cpu==0.20.0 numpy==2.4.6
cat > "$work/run.py" <<'PY'
import sys
import numpy as np
import open3d as o3d

path = sys.argv[1]
count = 500
rng = np.random.default_rng(0)
names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity"]
names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
with open(path, "wb") as file:
    file.write(header.encode() + rng.standard_normal((count, len(names))).astype("<f4").tobytes())
cloud = o3d.t.io.read_point_cloud(path)
before = cloud.point["f_rest"].numpy()
directions = rng.standard_normal((count, 3))
directions /= np.linalg.norm(directions, axis=1, keepdims=True)

def rotated(cloud, turn):
    return cloud.clone().rotate(o3d.core.Tensor(turn), o3d.core.Tensor(np.zeros(3)))

def sizes(cloud):
    after = cloud.point["f_rest"].numpy()
    degrees = slice(0, 3), slice(3, 8), slice(8, 15)
    return [np.linalg.norm(after[:, degree]) / np.linalg.norm(before[:, degree]) for degree in degrees]

def colours(rest, directions):
    """Return the part of degree 1, up to a factor: its basis is -y, z, -x."""
    return np.einsum("nb,nbc->nc", directions[:, [1, 2, 0]] * [-1, 1, -1], rest[:, :3])

about_x = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
again = cloud
for _ in range(4):
    again = rotated(again, about_z)
identity, quarters = sizes(rotated(cloud, np.eye(3))), sizes(again)
turned = rotated(cloud, about_x).point["f_rest"].numpy()
true = colours(before, directions)
error = [np.std(colours(turned, directions @ turn) - true) / np.std(true) for turn in (about_x.T, about_x)]
print("identity:", *(f"{size:.2f}" for size in identity), " four quarter turns:", *(f"{size:.2f}" for size in quarters))
print(f"degree 1 about x: error {error[0]:.2f}, of the opposite turn {error[1]:.2f}")
sys.exit(not (identity[1] > 1.1 and identity[2] > 1.3 and error[0] > 1 and error[1] < 1e-5))
PY
"$work/bin/python" "$work/run.py" "$work/scene.ply"
