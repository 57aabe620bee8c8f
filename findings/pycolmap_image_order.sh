#!/usr/bin/env bash
# The images of a pycolmap model come neither in the order of ids nor of names.
# Version:   pycolmap 4.2.1
# Source:    colmap src/colmap/scene/reconstruction.h: Reconstruction::Images is a hash map
#            (std::unordered_map), which pycolmap binds as it is.
# Behaviour: `for image in model.images.values()` goes through the buckets of a hash map. For 40 images with
#            the ids 1 to 40 the order is 40 to 30, 13 to 1, 14 to 29 (GNU's library), and the same after
#            the model was written and read.
# Guess:     by id, as the files list them, or by insertion, as a Python dict.
# Matters:   poses that are put beside sorted(photographs) belong to other photographs, and "every 8th image"
#            is another split than that of programs which sort by name.
# Seen:      40 images: 40 of 40 poses are beside another photograph
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pycolmap==4.2.1
"$work/bin/python" - "$work" <<'PY'
import sys
import pycolmap

options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 40, 50
pycolmap.synthesize_dataset(options).write_binary(sys.argv[1])
model = pycolmap.Reconstruction(sys.argv[1])
names = [image.name for image in model.images.values()]
wrong = sum(name != other for name, other in zip(names, sorted(names), strict=True))
print("ids:", *model.images)
print(f"{len(names)} images: {wrong} of {len(names)} poses are beside another photograph")
print("every 8th:", names[::8], "sorted:", sorted(names)[::8])
sys.exit(not wrong)
PY
