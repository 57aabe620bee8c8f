#!/usr/bin/env bash
# scikit-image's Poisson noise depends on how many different values the picture has.
# Version:   scikit-image 0.26.0
# Source:    skimage/util/noise.py: random_noise. With mode="poisson" the mean of the draws is the picture times
#            the power of two that follows its number of unique values. A note of the documentation says so.
# Behaviour: a picture of 256 levels gets the noise of 256 photons at white. The same picture in floating point,
#            as it is after a resize or an undistortion, gets that of as many photons as it has different pixels.
# Guess:     (before the run) the noise is that of the pixels' brightness.
# Matters:   photographs with noise for a study: those of 8 bits get the noise, and resized ones almost none. A larger
#            photograph gets less, and views with other contents get other noise.
# Seen:      a ramp of 512x512: standard deviation 0.0442 rounded to 8 bits, 0.0014 not rounded, 0.177 in 16 levels
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile scikit-image==0.26.0 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
from skimage.util import random_noise

ramp = np.linspace(0, 1, 512 * 512).reshape(512, 512)

def noise(picture):
    """Return the standard deviation of what is added."""
    return (random_noise(picture, mode="poisson", rng=0, clip=False) - picture).std()

bits, exact, few = noise(np.round(ramp * 255) / 255), noise(ramp), noise(np.round(ramp * 15) / 15)
print(f"8 bits {bits:.4f}, not rounded {exact:.4f}, 16 levels {few:.4f}")
sys.exit(not (bits > 10 * exact and few > 3 * bits))
PY
