#!/usr/bin/env bash
# wildflow-splat merges two .ply by the place of their columns, not by their names.
# Version:   wildflow-splat 0.1.7, @playcanvas/splat-transform 3.7.0 as a writer; Node 20
# Source:    observed, the module is compiled. gsplat 1.5.3 (gsplat/exporter.py) writes position, f_dc, f_rest, opacity,
#            scales, rotation; splat-transform writes position, rotation, scales, opacity, f_dc, f_rest. A .ply names
#            its columns, so other readers take both.
# Behaviour: merge_ply_files copies the bytes of the second file behind those of the first, under the header of the
#            first. The count is right and the file is valid.
# Guess:     (before the run) all Gaussians, with each column under its name, whatever the order.
# Matters:   of two patches, one trained with gsplat and one cleaned by splat-transform, the second is noise.
# Seen:      100 + 100 Gaussians with harmonics of degree 1: of the second file, x, y and z are right; its rot_0 arrives
#            as f_dc_0, its opacity as f_rest_4
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile wildflow-splat==0.1.7 numpy==2.4.6
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0 > log 2>&1 || { cat log; exit 1; }
cat > scene.py <<'PY'
import sys
import numpy as np

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9)), "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]

def write(path, seed):
    values = np.random.default_rng(seed).normal(size=(100, len(NAMES))).astype("<f4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(values)}\n"
    header += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    open(path, "wb").write(header.encode() + values.tobytes())

def read(path):
    header, data = open(path, "rb").read().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.split(b"\n") if line.startswith(b"property")]
    return dict(zip(names, np.frombuffer(data, "<f4").reshape(-1, len(names)).T))

if sys.argv[1] == "write":
    write("first.ply", seed=0)
    write("gsplat.ply", seed=1)
else:
    from wildflow import splat
    splat.merge_ply_files({"input_files": ["first.ply", "second.ply"], "output_file": "merged.ply"})
    first, second, merged = read("first.ply"), read("second.ply"), read("merged.ply")
    kept = all(np.array_equal(merged[name][:100], first[name]) for name in NAMES)
    right = [name for name in NAMES if np.array_equal(merged[name][100:], second[name])]
    turned = next(name for name in NAMES if np.array_equal(merged[name][100:], second["rot_0"]))
    opacity = next(name for name in NAMES if np.array_equal(merged[name][100:], second["opacity"]))
    print(len(merged["x"]), "Gaussians; right:", *right, f"; rot_0 arrives as {turned}, opacity as {opacity}")
    valid = kept and sorted(second) == sorted(NAMES) and len(merged["x"]) == 200
    sys.exit(not (valid and right == ["x", "y", "z"] and (turned, opacity) == ("f_dc_0", "f_rest_4")))
PY
venv/bin/python scene.py write
node_modules/.bin/splat-transform -q -w gsplat.ply second.ply
venv/bin/python scene.py merge | tail -n 1
