#!/usr/bin/env bash
# One negative pixel of the reference adds 6.02 dB to scikit-image's PSNR.
# Version:   scikit-image 0.26.0
# Source:    skimage/metrics/simple_metrics.py: peak_signal_noise_ratio. Without data_range, the range of
#            float images is 1 where the reference has no negative value, and 2 otherwise.
# Behaviour: a reference that undershoots by 1e-6 in one channel of one pixel, as bicubic resampling, colour
#            conversion or denoising leave it, is scored with a peak of 2 in place of 1. An overshoot above 1
#            is refused with an error; an undershoot is not.
# Guess:     a peak of 1 for floats, or an error as structural_similarity raises without data_range.
# Matters:   the views whose photographs were resampled get 6 dB more than the others, in silence.
# Seen:      30.65 dB with a pixel of 0, 36.67 dB with -1e-6
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile scikit-image==0.26.0
"$work/bin/python" - <<'PY'
import sys
import numpy as np
from skimage.metrics import peak_signal_noise_ratio

rng = np.random.default_rng(0)
reference = rng.random((64, 64, 3))
reference[0, 0, 0] = 0
render = np.clip(reference + rng.normal(0, 0.03, reference.shape), 0, 1)
before = peak_signal_noise_ratio(reference, render)
reference[0, 0, 0] = -1e-6
after = peak_signal_noise_ratio(reference, render)
print(f"{before:.2f} dB with a pixel of 0, {after:.2f} dB with -1e-6")
sys.exit(not abs(after - before - 20 * np.log10(2)) < 1e-3)
PY
