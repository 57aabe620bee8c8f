#!/usr/bin/env bash
# NumPy's mean per channel of a float32 photograph of 24 megapixels is 5 % too small.
# Version:   numpy 2.4.6
# Source:    numpy documentation of sum, Notes: with an axis, the precise (partly pairwise) sum is made only along the
#            fast axis in memory; else each number is added to the result. That of mean, Notes: the mean has
#            the precision of its input. The axes (0, 1) of [rows, columns, channels] are the slow
#            ones: each channel has one running sum in float32.
# Behaviour: the sum becomes so large that each addend is rounded away in part. The mean over
#            all axes of the same array is right to 1e-7, and so is mean(axis=0) followed by mean(axis=0).
# Guess:     (before the run) right to 0.01 %, as the mean over all axes is.
# Matters:   squared errors per channel, or a channel's mean brightness, are too small, so a
#            PSNR by channels is 0.25 dB too high for photographs of this size.
# Seen:      mean over (0, 1): 5.5 % too small, +0.25 dB; over all axes: 0.00 %
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np

errors = np.random.default_rng(0).standard_normal((4000, 6000, 3), dtype=np.float32)
errors *= np.float32(0.03)
errors *= errors
exact = errors.mean(dtype=np.float64)
by_channel, whole = errors.mean(axis=(0, 1)).mean(), errors.mean()
gain = 10 * np.log10(exact / by_channel)
print(f"mean over (0, 1): {1 - by_channel / exact:.1%} too small, +{gain:.2f} dB; over all axes: {abs(1 - whole / exact):.2%}")
sys.exit(not (1 - by_channel / exact > 0.03 and abs(1 - whole / exact) < 1e-4))
PY
