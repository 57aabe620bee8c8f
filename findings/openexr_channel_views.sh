#!/usr/bin/env bash
# OpenEXR's Python module writes the channel picture[..., 0] with the pixels of all channels.
# Version:   openexr 3.5.3
# Source:    openexr src/wrappers/python/PyOpenEXR.cpp: PyPart::writePixels takes the array's pointer and makes the
#            steps from the width and the size of a value; the array's own strides are not read
#            (reported as openexr issue 1929).
# Behaviour: a view of one channel is written as the memory that begins there: R G B R G B ... of the first third of the
#            rows. A cut or transposed picture is mixed likewise. There is no error or warning.
# Guess:     (before the run) the pixels of the view, as with Pillow, OpenCV and imageio.
# Matters:   depth, normals and radiance that are stored channel by channel. The file has the right size and
#            plausible values, so a comparison of two such files shows a small difference, too.
# Seen:      R, G, B = 1, 2, 3 everywhere: the first row of R is 1 2 3 1 2 3; of a contiguous copy 1 1 1 1 1 1
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile openexr==3.5.3 numpy==2.4.6
"$work/bin/python" - "$work/picture.exr" <<'PY'
import sys
import numpy as np
import OpenEXR

path = sys.argv[1]
picture = np.broadcast_to(np.float32([1, 2, 3]), (30, 40, 3)).copy()
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}

def first_row(prepare):
    channels = {name: prepare(picture[..., index]) for index, name in enumerate("RGB")}
    with OpenEXR.File(header, channels) as file:
        file.write(path)
    with OpenEXR.File(path, separate_channels=True) as file:
        return file.channels()["R"].pixels[0, :6].astype(int).tolist()

view, copy = first_row(lambda channel: channel), first_row(np.ascontiguousarray)
print("view:", *view, " contiguous copy:", *copy)
sys.exit((view, copy) != ([1, 2, 3, 1, 2, 3], [1, 1, 1, 1, 1, 1]))
PY
