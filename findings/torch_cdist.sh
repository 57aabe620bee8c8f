#!/usr/bin/env bash
# torch.cdist loses the distances of neighbours as soon as there are 26 points.
# Version:   torch 2.13.0
# Source:    torch/functional.py: by default the distance is computed by a product of matrices if there are more than
#            25 points, so from |x|^2 + |y|^2 - 2 x y, in float32. The documentation has the rule, not the loss.
# Behaviour: far from the origin the squares are large and their difference is small: distances come out as 0 or
#            in coarse steps. With 25 points, compute_mode="donot_use_mm_for_euclid_dist" or after the mean
#            is taken away they are right.
# Guess:     (before the run) right to 1 %: coordinates of 500 have steps of 0.00003.
# Matters:   the nearest neighbours' distance is the first size of the Gaussians. In a scene in metres of a local map
#            sizes become 0 (log: minus infinity) or double, and a Chamfer distance is wrong.
# Seen:      500 from the origin, each point 0.0500 from its neighbour: 25 points 0.0500 to 0.0500,
#            26 points 0.0000 to 0.1250
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import torch

torch.manual_seed(0)
first = torch.rand(13, 3) * 10 + torch.tensor([500.0, 0, 0])
points = torch.cat([first, first + torch.tensor([0, 0.05, 0])])
seen = {}
for name, count, mode in (
    ("25 points", 25, "use_mm_for_euclid_dist_if_necessary"),
    ("26 points", 26, "use_mm_for_euclid_dist_if_necessary"),
    ("26 points, exact", 26, "donot_use_mm_for_euclid_dist"),
):
    distances = torch.cdist(points[-count:], points[-count:], compute_mode=mode)
    nearest = distances.fill_diagonal_(torch.inf).sort().values[-12:, 0]
    seen[name] = nearest.min().item(), nearest.max().item()
    print(f"{name}: {nearest.min():.4f} to {nearest.max():.4f}")
right = all(abs(value - 0.05) < 0.001 for name in ("25 points", "26 points, exact") for value in seen[name])
low, high = seen["26 points"]
sys.exit(not (right and low < 0.025 and high > 0.075))
PY
