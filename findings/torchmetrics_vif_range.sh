#!/usr/bin/env bash
# torchmetrics' visual information fidelity of images in 0..1 is near 1 whatever they show.
# Version:   torchmetrics 1.9.0 with torch 2.13.0 (its build for the CPU will do)
# Source:    torchmetrics/functional/image/vif.py: visual_information_fidelity has a noise variance
#            sigma_n_sq of 2 and no data_range; small constants of 1e-10 guard its variances.
# Behaviour: the noise variance is meant for values in 0..255. With 0..1, which the other metrics of the same
#            collection take with data_range=1, signals are far below the noise and the ratio goes to 1.
# Guess:     a ratio of information does not depend on the unit of the pixels, or the metric asks for it.
# Matters:   strong noise scores as nearly perfect, and methods can't be told apart.
# Seen:      the same pair, noise of 40 of 255: 0.20 with values in 0..255, 1.00 with values in 0..1
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 torchmetrics==1.9.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from torch.nn.functional import interpolate
from torchmetrics.functional.image import visual_information_fidelity

generator = torch.Generator().manual_seed(0)
coarse = torch.rand(1, 3, 32, 32, generator=generator, dtype=torch.float64)
view = interpolate(coarse, size=(128, 128), mode="bilinear")
render = view + 40 / 255 * torch.randn(view.shape, generator=generator, dtype=torch.float64)
large = visual_information_fidelity(render * 255, view * 255).item()
small = visual_information_fidelity(render, view).item()
print(f"the same pair, noise of 40 of 255: {large:.2f} with values in 0..255, {small:.2f} with values in 0..1")
sys.exit(not small > large + 0.3)
PY
