#!/usr/bin/env bash
# sogpy writes the harmonics of a .sog in the order of the .ply, which is not that of a .sog.
# Version:   sogpy 1.0.2 (PyPI), @playcanvas/splat-transform 3.7.0 as the reader and for comparison; Node 20
# Source:    PyPI; SogPython/sog_writer.py: write_sh puts coefficients 3j, 3j + 1 and 3j + 2 of f_rest into red,
#            green and blue of texel j. f_rest has all of red, then green, then blue, so red of texel j is
#            coefficient j, green j + 15 and blue j + 30.
# Behaviour: positions, shapes and opacities arrive. Harmonics above degree 0 are those of other channels and
#            directions.
# Guess:     (before the run) splat-transform reads from it what was in the .ply, to the 8 bits of the format.
# Matters:   a compressed scene renders with wrong colours in each direction: the cost of the format in PSNR, which
#            is what such a table compares, is a fault of the writer. From the front it still looks like the scene.
# Seen:      coefficient 1 of red comes back as f_rest_15, coefficient 0 of green; correlation of the harmonics of
#            3000 Gaussians before and after: 0.06, by splat-transform's own writer 0.9
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile sogpy==1.0.2 numpy==2.4.6 pillow==12.0.0 scipy==1.17.1
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0 > log 2>&1 || { cat log; exit 1; }
cat > scene.py <<'PY'
import sys
import numpy as np

REST = [f"f_rest_{i}" for i in range(45)]
NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *REST, "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]

def write(path, only=None, count=3000):
    """Write Gaussians; `only` is the one coefficient above degree 0 that is not zero."""
    rng = np.random.default_rng(0)
    values = {name: rng.normal(size=count) for name in NAMES}
    values |= {name: 0.1 * values[name] if only in (None, name) else np.zeros(count) for name in REST}
    values |= {f"scale_{i}": values[f"scale_{i}"] - 4 for i in range(3)}
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    header += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    with open(path, "wb") as file:
        file.write(header.encode() + np.stack(list(values.values()), 1).astype("<f4").tobytes())

def read(path):
    """Return the harmonics [N, 45], sorted by x."""
    header, data = open(path, "rb").read().split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in header.split(b"\n") if line.startswith(b"property")]
    rows = np.frombuffer(data, "<f4").reshape(-1, len(names))
    rows = rows[np.argsort(rows[:, names.index("x")])]
    return rows[:, [names.index(name) for name in REST]]

def correlation(before, after):
    return np.corrcoef(read(before).ravel(), read(after).ravel())[0, 1]

if sys.argv[1] == "write":
    write("one.ply", only="f_rest_1")
    write("all.ply")
else:
    found = REST[read("one_sogpy.ply").std(0).argmax()]
    written, reference = correlation("all.ply", "all_sogpy.ply"), correlation("all.ply", "all_own.ply")
    print(f"f_rest_1 comes back as {found}; correlation {written:.2f}, by splat-transform's writer {reference:.2f}")
    sys.exit(not (found == "f_rest_15" and written < 0.3 and reference > 0.8))
PY
venv/bin/python scene.py write
for scene in one all; do
  venv/bin/sogpy "$scene.ply" "${scene}_sogpy.sog" > log 2>&1 || { cat log; exit 1; }
  node_modules/.bin/splat-transform -q -w "${scene}_sogpy.sog" "${scene}_sogpy.ply"
done
node_modules/.bin/splat-transform -q -w -g cpu all.ply all_own.sog
node_modules/.bin/splat-transform -q -w all_own.sog all_own.ply
venv/bin/python scene.py compare
