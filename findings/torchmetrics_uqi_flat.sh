#!/usr/bin/env bash
# torchmetrics' universal image quality index of a picture with itself is 0 where the picture is flat.
# Version:   torchmetrics 1.9.0; sewar 0.4.10, the same index
# Source:    torchmetrics src/torchmetrics/functional/image/uqi.py, `_uqi_compute`: the variance is a factor of the
#            numerator, and of the denominator up to a machine epsilon that keeps it from being 0.
# Behaviour: where both pictures are constant, 0 is divided by the epsilon: such windows count as 0, the worst, though
#            they are equal. sewar takes the quotient of the means there, as the index has it in its limit.
# Guess:     (before the run) 1 for a picture with itself, with a black background or without.
# Matters:   the value is about the share of the picture that is not background. Renders of single objects on black or
#            white, and clipped skies, rank by their background and not by their quality.
# Seen:      a picture with itself: 1.00 without a background, 0.27 where 84 % is black; sewar: 1.00 and 1.00
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 torchmetrics==1.9.0 sewar==0.4.10 \
    numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import sewar
import torch
from torchmetrics.functional.image import universal_image_quality_index as torchmetrics_uqi

full = np.random.default_rng(0).integers(0, 256, (100, 100, 3), dtype=np.uint8)
single = np.zeros_like(full)
single[30:70, 30:70] = full[30:70, 30:70]
seen = {}
for name, picture in (("no background", full), ("84 % black", single)):
    tensor = torch.tensor(picture / 255).permute(2, 0, 1)[None].float()
    seen[name] = torchmetrics_uqi(tensor, tensor).item(), sewar.uqi(picture, picture)
    print(f"{name}: torchmetrics {seen[name][0]:.2f}, sewar {seen[name][1]:.2f}")
(whole, sewar_whole), (part, sewar_part) = seen.values()
sys.exit(not (whole > 0.99 and min(sewar_whole, sewar_part) > 0.99 and part < 0.5))
PY
