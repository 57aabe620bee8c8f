#!/usr/bin/env bash
# NumPy ignores zeros at the end of a seed: default_rng([3, 0]) is default_rng(3).
# Version:   numpy 2.4.6
# Source:    numpy/random/bit_generator.pyx: SeedSequence.mix_entropy goes on with zeros where the seed has fewer
#            words than its pool of four. numpy's pull request 16551 keeps spawned children apart from that; lists
#            are as before. The documentation of default_rng says only that a list of integers is accepted.
# Behaviour: [3, 0] and [3, 0, 0] give the numbers of 3. [3, 1] gives others, and so does [0, 3].
# Guess:     (before the run) each list is a stream of its own.
# Matters:   seeds like [replicate, view] or [replicate, scene] are meant to be independent of each other and of
#            the replicate's own generator. Number 0 is not: what is drawn for the first view repeats what the
#            training draws. Two noises on the first photograph are one noise with twice the size.
# Seen:      equal to 3: [3] [3, 0] [3, 0, 0]; noise of seed 3 added to that of view 0: 2.00 standard deviations, of
#            view 1: 1.41
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np

def noise(seed):
    return np.random.default_rng(seed).normal(size=(300, 400, 3))

equal = [seed for seed in ([3], [3, 0], [3, 0, 0], [3, 1], [0, 3]) if np.array_equal(noise(seed), noise(3))]
first, second = ((noise(3) + noise([3, view])).std() for view in (0, 1))
print("equal to 3:", *equal)
print(f"noise of seed 3 added to that of view 0: {first:.2f} standard deviations, of view 1: {second:.2f}")
sys.exit(not (equal == [[3], [3, 0], [3, 0, 0]] and abs(first - 2) < 0.02 and abs(second - 2**0.5) < 0.02))
PY
