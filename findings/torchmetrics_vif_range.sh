#!/usr/bin/env bash
# torchmetrics' visual information fidelity of a noisy picture is 1, that of the reference itself, for values of 0 to 1.
# Version:   torchmetrics 1.9.0 and sewar 0.4.10, the same index
# Source:    torchmetrics src/torchmetrics/functional/image/vif.py: the variance of the eye's noise, sigma_n_sq, is 2,
#            which Sheikh and Bovik's index has for values of 0 to 255. There is no data_range, and no check of it.
# Behaviour: for values of 0 to 1 this noise drowns the picture, and the index becomes about the contrast of the test
#            picture: noise does not lower it. sewar's other metrics take floats for 0 to 1, its vifp does the same.
# Guess:     (before the run) the same value as of the pictures in 0 to 255, as torchmetrics' PSNR, SSIM and LPIPS have.
# Matters:   renders are tensors in 0 to 1. A noisy one gets the value of a perfect one, and a table has the methods in
#            the opposite order.
# Seen:      noise of 0.1: 1.02 in 0 to 1, 0.20 in 0 to 255; a blur of 2 px: 0.57 and 0.63. sewar: the same
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 torchmetrics==1.9.0 sewar==0.4.10 \
    scipy==1.17.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import sewar
import torch
from scipy.ndimage import gaussian_filter
from torchmetrics.functional.image import visual_information_fidelity

random = np.random.default_rng(0)
reference = gaussian_filter(random.random((256, 256, 3)), (3, 3, 0))
reference = (reference - reference.min()) / np.ptp(reference)
tests = {
    "noise": np.clip(reference + random.normal(0, 0.1, reference.shape), 0, 1),
    "blur": gaussian_filter(reference, (2, 2, 0)),
}
seen = {}
for name, test in tests.items():
    for peak in (1, 255):
        tensors = (torch.tensor(peak * picture).permute(2, 0, 1)[None].float() for picture in (test, reference))
        seen[name, peak] = visual_information_fidelity(*tensors).item()
        other = sewar.vifp(peak * reference, peak * test)
        print(f"{name}, 0 to {peak}: torchmetrics {seen[name, peak]:.2f}, sewar {other:.2f}")
        if abs(other - seen[name, peak]) > 0.05:
            sys.exit("the two disagree")
sys.exit(not (seen["noise", 1] > 0.95 > 0.7 > seen["blur", 1] and seen["noise", 255] < 0.3 < 0.5 < seen["blur", 255]))
PY
