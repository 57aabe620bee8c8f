#!/usr/bin/env bash
# torchmetrics averages PSNR in another way than SSIM: over the pixels of all views, not over views.
# Version:   torchmetrics 1.9.0 with torch 2.13.0 (its build for the CPU will do)
# Source:    torchmetrics/image/psnr.py: PeakSignalNoiseRatio.update adds up squared errors where dim is None;
#            compute takes one logarithm at the end. torchmetrics/image/ssim.py averages over images.
# Behaviour: updated view by view, PSNR is that of the mean squared error of all views. Papers of radiance
#            fields give the mean of the views' PSNR, which is never lower. SSIM of the same collection is
#            the mean of views.
# Guess:     the mean of what each update gives, as for SSIM.
# Matters:   one bad view decides the score. Differences of several dB against programs that average over
#            views, and the order of two methods can turn around.
# Seen:      views of 40, 34, 26 and 14 dB: 19.6 dB; their mean: 28.5 dB. SSIM 0.944, mean of views 0.944
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 torchmetrics==1.9.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch
from torchmetrics.image import PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure

generator = torch.Generator().manual_seed(0)
views = [torch.rand(1, 3, 64, 64, generator=generator) for _ in range(4)]
renders = [v + s * torch.randn(v.shape, generator=generator) for v, s in zip(views, (0.01, 0.02, 0.05, 0.2))]
result = {}
for metric in (PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure):
    whole, single = metric(data_range=1.0), []
    for render, view in zip(renders, views):
        whole.update(render, view)
        single.append(metric(data_range=1.0)(render, view).item())
    result[metric] = whole.compute().item(), sum(single) / 4
psnr, mean_psnr = result[PeakSignalNoiseRatio]
ssim, mean_ssim = result[StructuralSimilarityIndexMeasure]
print(f"PSNR {psnr:.1f} dB, mean of views {mean_psnr:.1f} dB; SSIM {ssim:.3f}, mean of views {mean_ssim:.3f}")
sys.exit(not (mean_psnr - psnr > 8 and abs(ssim - mean_ssim) < 1e-4))
PY
