#!/usr/bin/env bash
# piq's SR-SIM of a view depends on the other views of its batch.
# Version:   piq 0.8.0 with torch 2.13.0; torchvision, which only piq's networks use, is replaced by an empty module
# Source:    piq/srsim.py, `_spectral_residual_visual_saliency`: the saliency map is brought to 0 to 1 by the
#            minimum and the maximum of the whole tensor, not of each picture. The documentation says "for a batch of
#            images" and `reduction` "over samples in batch".
# Behaviour: reduction="none" gives other values than the pictures one by one, since the weights of a view's pixels
#            depend on the others' saliency. FSIM, VSI and SSIM do not change.
# Guess:     each value is that of its picture by itself (seen in a run that was about symmetry).
# Matters:   the score of a view depends on the batch size and on the order of views, and the last, smaller batch is
#            measured otherwise.
# Seen:      two views together 0.9216 and 0.8358, one by one 0.9283 and 0.8215; FSIM, VSI and SSIM as one by one
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
python3 -m pip --quiet --python "$work" install --no-compile --no-deps piq==0.8.0
"$work/bin/python" - <<'PY'
import sys
from unittest.mock import MagicMock
sys.modules |= {f"torchvision{part}": MagicMock() for part in ("", ".models", ".models.vgg", ".transforms")}
import piq
import torch

torch.manual_seed(0)
height, width = 192, 256
views = torch.zeros(2, 3, height, width)
for step in (1, 2, 4, 8, 16, 32):
    coarse = torch.randn(2, 3, height // step, width // step)
    views += step**0.7 * torch.nn.functional.interpolate(coarse, size=(height, width), mode="bicubic")
views = (views - views.min()) / (views.max() - views.min())
views[1] = 0.5 + 0.1 * (views[1] - 0.5)  # a view in fog
renders = (views + 0.05 * torch.randn_like(views)).clamp(0, 1)
seen = {}
for name in ("srsim", "fsim", "vsi", "ssim"):
    metric = getattr(piq, name)
    together = metric(renders, views, reduction="none").flatten()
    single = torch.stack([metric(renders[[i]], views[[i]], reduction="none").flatten()[0] for i in range(2)])
    seen[name] = (together - single).abs().max().item()
    print(name, "together", *(f"{v:.4f}" for v in together), "one by one", *(f"{v:.4f}" for v in single))
sys.exit(not (seen["srsim"] > 0.01 and max(seen["fsim"], seen["vsi"], seen["ssim"]) < 1e-5))
PY
