#!/usr/bin/env bash
# torchmetrics' SSIM is wrong inside torch.autocast: 0.59 for 0.96.
# Version:   torchmetrics 1.9.0, kornia 0.9.0 with torch 2.13.0 (its build for the CPU will do), scikit-image
#            0.26.0 for its photograph
# Source:    torchmetrics/functional/image/ssim.py: the window is applied by conv2d, which autocast runs in
#            bfloat16 or float16. A variance is a mean of squares minus a squared mean, and the rounding of both is
#            larger than the variance of a smooth region. kornia/metrics/ssim.py turns autocast off there.
# Behaviour: float32 images give another SSIM inside autocast than outside. kornia's does not change.
# Guess:     (before the run) a difference below 0.01, as the images are float32 and the result is a mean.
# Matters:   metrics are often computed in the block of the training step, which is under autocast when training
#            is of mixed precision. The loss 1 - SSIM has the same error.
# Seen:      blurred photograph: 0.963 in float32; inside autocast 0.586 with bfloat16, 0.876 with float16;
#            kornia: 0.963 in all three
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 torchmetrics==1.9.0 kornia==0.9.0 \
  scikit-image==0.26.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from kornia.metrics import ssim
from scipy.ndimage import gaussian_filter
from skimage.data import astronaut
from torchmetrics.functional.image import structural_similarity_index_measure

def tensor(image):
    return torch.tensor(image).permute(2, 0, 1)[None].float()

photograph = astronaut() / 255
views = tensor(photograph), tensor(gaussian_filter(photograph, (0.7, 0.7, 0)))
metrics = {
    "torchmetrics": lambda a, b: structural_similarity_index_measure(a, b, data_range=1.0),
    "kornia": lambda a, b: ssim(a, b, 11).mean(),
}
seen = {}
for name, metric in metrics.items():
    seen[name] = [metric(*views).item()]
    for dtype in (torch.bfloat16, torch.float16):
        with torch.autocast("cpu", dtype=dtype):
            seen[name].append(metric(*views).item())
    print(f"{name}: float32 {seen[name][0]:.3f}, in bfloat16 {seen[name][1]:.3f}, in float16 {seen[name][2]:.3f}")
full, bfloat, half = seen["torchmetrics"]
sys.exit(not (full - bfloat > 0.2 and full - half > 0.04 and max(seen["kornia"]) - min(seen["kornia"]) < 1e-5))
PY
