#!/usr/bin/env bash
# fourdgs converts a sequence of .ply frames into a scene that is nearly transparent at the times of its frames.
# Version:   fourdgs 0.6.0
# Source:    fourdgs/convert.py, convert_ply_sequence: frame k has the slot from k / fps to (k + 1) / fps, and its
#            Gaussians fade from the middle of the slot to 0.05 of their opacity at both ends. A comment calls this
#            "a temporal extent that covers the slot".
# Behaviour: opacities are right in the middle between two frames only, and 0.05 of that at each frame's own time, the
#            first and default time of `fourdgs to-gltf` included. The written file says the same.
# Guess:     (before the run) a conversion keeps the opacities of its .ply.
# Matters:   frames of a dynamic scene that are rendered at k / fps, as they were taken, are nearly empty. At any other
#            rate they flicker between 5 % and 100 % of their opacity.
# Seen:      0.05 of the opacity at 0, 0.1, 0.2 and 0.3 s of 10 frames a second, 1.00 at 0.05, 0.15, 0.25 and 0.35 s
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile fourdgs==0.6.0 numpy==2.4.6
mkdir frames
cat > write.py <<'PY'
import numpy as np

names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
rows = np.random.default_rng(0).normal(size=(200, len(names)))
rows[:, 7:10] -= 3
header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
for frame in range(4):
    rows[:, 0] += 0.01
    open(f"frames/{frame}.ply", "wb").write(header.encode() + rows.astype("<f4").tobytes())
PY
cat > look.py <<'PY'
import sys
import fourdgs
import numpy as np
from fourdgs.convert import convert_ply_sequence, read_ply

opacity = 1 / (1 + np.exp(-read_ply("frames/0.ply").fields["opacity"]))
scene = convert_ply_sequence("frames", fps=10)[0]
file = fourdgs.read("scene.4dgs").gaussians
seen = []
for name, shift in (("at the frames' times", 0.0), ("half a frame later", 0.05)):
    times = [frame / 10 + shift for frame in range(4)]
    parts = [part.state_at(time)["opacity"].sum() / opacity.sum() for part in (scene, file) for time in times]
    texts = [f"{part:.2f}" for part in parts]
    print(f"{name}: {' '.join(texts[:4])} of the opacity, in the file {' '.join(texts[4:])}")
    seen.append(parts)
sys.exit(not (max(seen[0]) < 0.06 and min(seen[1]) > 0.95))
PY
venv/bin/python write.py
venv/bin/fourdgs convert frames -o scene.4dgs --fps 10 --profile fine
venv/bin/python look.py
