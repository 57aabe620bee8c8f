#!/usr/bin/env bash
# pycolmap ignores the poses of images.txt and images.bin where a file of frames lies beside them.
# Version:   pycolmap 4.2.1
# Source:    colmap/colmap, src/colmap/scene/reconstruction_io_binary.cc, ReadImagesBinary: the pose in the file of
#            images is used only where the model has no rigs and no frames, as before COLMAP 3.12. It is always written.
# Behaviour: poses that were changed in the file of images are not read, and no message tells that the two disagree.
#            Without rigs and frames they are read.
# Guess:     (before the run) the changed poses are read, or the disagreement is refused.
# Matters:   tools of the years before frames align, scale, refine or perturb poses there, as does every script that
#            writes images.txt. COLMAP's next step, such as triangulation or undistortion, uses the old poses.
# Seen:      five cameras, moved by 10: 0 with frames.txt beside, 10 without; the same with .bin
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work/venv"
python3 -m pip --quiet --python "$work/venv" install --no-compile pycolmap==4.2.1 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PY'
import struct
import sys
from pathlib import Path
import numpy as np
import pycolmap

def moved(kind):
    """Return how far the cameras of the model in folder KIND have moved, at least and at most."""
    images = pycolmap.Reconstruction(kind).images.values()
    distances = [np.linalg.norm(image.projection_center() - centres[image.name]) for image in images]
    return round(float(min(distances)), 3), round(float(max(distances)), 3)

options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 5, 50
model = pycolmap.synthesize_dataset(options)
centres = {image.name: image.projection_center() for image in model.images.values()}
for kind in ("txt", "bin"):
    Path(kind).mkdir()
model.write_text("txt")
model.write_binary("bin")

# Add 10 to the z of each translation, and leave the rest of the files as it is.
file = Path("txt/images.txt")
lines = file.read_text().splitlines()
heads = [index for index, line in enumerate(lines) if not line.startswith("#")][::2]
for index in heads:
    words = lines[index].split()
    words[7] = repr(float(words[7]) + 10)
    lines[index] = " ".join(words)
file.write_text("\n".join(lines) + "\n")
file = Path("bin/images.bin")
data = bytearray(file.read_bytes())
at = 8
for _ in range(struct.unpack_from("<Q", data)[0]):
    z = at + 4 + 6 * 8
    struct.pack_into("<d", data, z, struct.unpack_from("<d", data, z)[0] + 10)
    end = data.index(b"\0", z + 12) + 1
    at = end + 8 + 24 * struct.unpack_from("<Q", data, end)[0]
file.write_bytes(data)

seen = []
for kind in ("txt", "bin"):
    beside = moved(kind)
    for name in ("rigs", "frames"):
        Path(kind, f"{name}.{kind}").unlink()
    seen.append((beside, moved(kind)))
    print(f"{kind}: moved by {beside} with frames beside, by {seen[-1][1]} without")
sys.exit(seen != [((0, 0), (10, 10))] * 2)
PY
