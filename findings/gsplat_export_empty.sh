#!/usr/bin/env bash
# One Gaussian with an opacity of 1 empties the whole file that gsplat's exporter writes.
# Version:   gsplat 1.5.3 with torch 2.13.0 (its build for the CPU will do)
# Source:    gsplat/exporter.py: export_splats. The mask of invalid Gaussians reduces positions, scales,
#            quaternions and harmonics over dim=1, but opacities, which have one dimension, over dim=0: to
#            one value for all Gaussians.
# Behaviour: a single opacity logit that is not finite marks every Gaussian as invalid: the .ply has a valid
#            header and 0 vertices, without an error or warning. A position that is not finite removes one
#            Gaussian, as is meant.
# Guess:     that Gaussian is left out, as one with a bad position is.
# Matters:   torch.logit of an opacity of exactly 1 is infinite, so the conversion of a model that stores
#            opacities loses it whole.
# Seen:      1000 Gaussians: one position nan: 999 written; one opacity 1: 0 written
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 gsplat==1.5.3 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import re
import sys
import torch
from gsplat.exporter import export_splats

def written(means, opacities):
    count, shared = len(means), torch.Generator().manual_seed(1)
    quats = torch.randn(count, 4, generator=shared)
    sh0 = torch.zeros(count, 1, 3)
    data = export_splats(means, torch.zeros(count, 3), quats, torch.logit(opacities), sh0, torch.zeros(count, 0, 3))
    return int(re.search(rb"element vertex (\d+)", data)[1])

generator = torch.Generator().manual_seed(0)
means, opacities = torch.randn(1000, 3, generator=generator), torch.rand(1000, generator=generator) * 0.9 + 0.05
bad = means.clone()
bad[5, 0] = float("nan")
one_position = written(bad, opacities)
opacities[3] = 1.0
one_opacity = written(means, opacities)
print(f"1000 Gaussians: one position nan: {one_position} written; one opacity 1: {one_opacity} written")
sys.exit((one_position, one_opacity) != (999, 0))
PY
