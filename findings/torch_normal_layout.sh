#!/usr/bin/env bash
# One seed of torch gives other normal numbers for another length, precision or memory order of the tensor.
# Version:   torch 2.13.0 (its build for the CPU will do); issues 79703 and 80202 of pytorch/pytorch
# Source:    aten/src/ATen/native/cpu/DistributionTemplates.h: normal_fill of contiguous tensors of 16 numbers
#            or more, which draws by blocks of 16 and the last 16 anew; a serial draw otherwise.
# Behaviour: randn(20) does not begin with randn(10), nor randn(17) with randn(16); 1000 draws of 3 are not
#            one draw of 1000 x 3; float64 is not float32 with more digits; a transposed tensor gets other
#            numbers. Uniform numbers have none of this.
# Guess:     a seed fixes a sequence, of which a tensor takes the beginning (as in NumPy).
# Matters:   with one more Gaussian, a tensor's `normal_` moves the noise of Gaussians that did not change; a
#            change of precision or layout changes the run as another seed would.
# Seen:      equal numbers: randn(10) in randn(20) 0 of 10; rand 10 of 10; 3 x 1000 singly 0 of 3000
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch

def drawn(make):
    torch.manual_seed(0)
    return make()

def equal(one, other):
    return int((drawn(one) == drawn(other)).sum())

prefix = equal(lambda: torch.randn(10), lambda: torch.randn(20)[:10])
uniform = equal(lambda: torch.rand(10), lambda: torch.rand(20)[:10])
singly = equal(lambda: torch.randn(1000, 3), lambda: torch.cat([torch.randn(1, 3) for _ in range(1000)]))
layout = equal(lambda: torch.empty(100, 3).normal_(), lambda: torch.empty(3, 100).T.normal_())
print(f"equal numbers: randn(10) in randn(20) {prefix} of 10; rand {uniform} of 10; 3 x 1000 singly {singly} of 3000;")
print(f"transposed {layout} of 300")
sys.exit((prefix, uniform, singly, layout) != (0, 10, 0, 0))
PY
