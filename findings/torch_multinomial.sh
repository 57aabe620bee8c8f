#!/usr/bin/env bash
# torch.multinomial never draws small weights that stand far back in a long float32 array.
# Version:   torch 2.13.0, on the CPU
# Source:    pytorch aten/src/ATen/native/cpu/MultinomialKernel.cpp: with replacement, the weights are added one by one
#            to a running sum of the tensor's own type, and an index is found by bisection in these sums.
# Behaviour: a weight below half the last digit of the sum before it adds nothing: its index is drawn never. Which are
#            lost depends on the order of the array. The same weights in float64 are drawn as they should be.
# Guess:     (before the run) each of 4 million weights is drawn in proportion to it, wherever it stands.
# Matters:   MCMC training of Gaussians draws those to copy by their opacity, with replacement (gsplat by this
#            function, on a GPU, which is not tried here). New Gaussians stand last and are faint. Importance sampling
#            of pixels of many views is a longer list still.
# Seen:      the faint half of 4 million, in the second half of the array: 1.10 % expected, 0.00 % of the draws as
#            float32, 1.09 % as float64; in the last quarter of a mixed array: 0.28 % expected, 0.00 %, 0.28 %
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import torch

HALF, DRAWS = 2_000_000, 400_000
torch.manual_seed(0)
opaque, faint = torch.full((HALF,), 0.9), torch.full((HALF,), 0.01)

def share(weights, chosen):
    """Return the share of the draws, in percent, of the indices `chosen`."""
    drawn = torch.multinomial(weights, DRAWS, replacement=True)
    return 100 * chosen[drawn].double().mean().item()

order = torch.randperm(2 * HALF)
last = torch.arange(2 * HALF) >= 1.5 * HALF
seen = {}
for name, weights in (("faint half last", torch.cat([opaque, faint])), ("mixed", torch.cat([opaque, faint])[order])):
    chosen = (weights < 0.5) & ((torch.arange(2 * HALF) >= HALF) if name != "mixed" else last)
    expected = 100 * (weights[chosen].double().sum() / weights.double().sum()).item()
    single, double = share(weights, chosen), share(weights.double(), chosen)
    print(f"{name}: {expected:.3f} % expected, {single:.3f} % as float32, {double:.3f} % as float64")
    seen[name] = expected, single, double
lost = all(single < expected / 10 for expected, single, _ in seen.values())
right = all(abs(double / expected - 1) < 0.1 for expected, _, double in seen.values())
sys.exit(not (lost and right))
PY
