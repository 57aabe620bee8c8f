#!/usr/bin/env bash
# splat-transform's --translate takes from the x and y of a .ply what it is told to add.
# Version:   @playcanvas/splat-transform 3.7.0; Node 20
# Source:    dist/index.mjs: actions work in coordinates of the PlayCanvas engine, and Transform.PLY, for .ply, .splat,
#            .ksplat, .spz and .sog, is half a turn about z. The README's list of actions does not name the axes.
# Behaviour: -t 1,2,3 adds -1, -2, 3. -B and -S choose by -x, -y, z, and -r turns about these axes.
# Guess:     (before the run) the coordinates of the file, which are also those of the file that is written.
# Matters:   a box or an offset that was measured in the .ply, or is that of the cameras of COLMAP, cuts or
#            moves the opposite side of the scene. The result is a valid file, so nothing tells.
# Seen:      (1, 1, 1) with -t 1,2,3: (0, -1, 4); -B 0,0,0,2,2,2 keeps (-1, -1, 1)
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0 > log 2>&1 || { cat log; exit 1; }
cat > scene.py <<'PY'
import struct
import sys

if sys.argv[1] == "write":
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    places = (1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1)
    rows = (struct.pack("<14f", *place, 0, 0, 0, 1, -3, -3, -3, 1, 0, 0, 0) for place in places)
    open("scene.ply", "wb").write(header.encode() + b"".join(rows))
else:
    header, data = open(sys.argv[1], "rb").read().split(b"end_header\n", 1)
    width = header.count(b"property")
    for row in struct.iter_unpack(f"<{width}f", data):
        print(*(round(value) for value in row[:3]))
PY
python3 scene.py write
convert() { npx splat-transform -q -w scene.ply "${@:2}" "$1" > log 2>&1 || { cat log; exit 1; }; }
convert moved.ply -t 1,2,3
convert box.ply -B 0,0,0,2,2,2
moved=$(python3 scene.py moved.ply | head -n 1)
box=$(python3 scene.py box.ply)
echo "(1, 1, 1) moved by 1,2,3: $moved; in the box 0,0,0,2,2,2: $box"
[[ $moved == "0 -1 4" && $box == "-1 -1 1" ]]
