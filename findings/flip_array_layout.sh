#!/usr/bin/env bash
# NVIDIA's FLIP reads an array with an opacity as if its numbers were pixels of three values.
# Version:   flip-evaluator 1.7
# Source:    flip_evaluator/flip_python_api.py: evaluate takes arrays of "HxWxC layout" and hands them to the compiled
#            module, which reads three values a pixel. A file with an opacity is read as it should be.
# Behaviour: of H x W x 4 numbers it takes the first H x W x 3 in a row, three by three: colours are shifted, the
#            opacity is compared as a colour, and the last quarter of the rows is never looked at.
# Guess:     (before the run) the opacity is ignored, or the array refused.
# Matters:   Blender's views and many renderers' pictures have four channels. The error looks plausible and is too
#            small, most of all for what is wrong in the lower part.
# Seen:      noise of 0.05: 0.088 for 0.111; the last fifth of the rows black: 0.000 for 0.197
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile flip-evaluator==1.7 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import flip_evaluator
import numpy as np

def error(reference, test):
    """Return the mean of FLIP's map of errors."""
    return flip_evaluator.evaluate(reference, test, "LDR")[1]

def opaque(picture):
    """Return the picture with a fourth channel of ones."""
    return np.concatenate([picture, np.ones_like(picture[..., :1])], axis=2)

random = np.random.default_rng(0)
reference = random.random((200, 240, 3), dtype=np.float32)
noisy = np.clip(reference + random.normal(0, 0.05, reference.shape), 0, 1).astype(np.float32)
black = reference.copy()
black[160:] = 0
seen = {}
for name, test in (("noisy", noisy), ("black", black)):
    seen[name] = error(reference, test), error(opaque(reference), opaque(test))
    print(f"{name}: three channels {seen[name][0]:.3f}, four {seen[name][1]:.3f}")
right = seen["noisy"][0] > 0.1 and seen["black"][0] > 0.15
sys.exit(not (right and seen["noisy"][1] < 0.095 and seen["black"][1] == 0))
PY
