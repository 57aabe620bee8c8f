#!/usr/bin/env bash
# torch's generator on the CPU takes seeds of 64 bits and uses 32 of them.
# Version:   torch 2.13.0 (its build for the CPU will do)
# Source:    pytorch aten/src/ATen/core/MT19937RNGEngine.h: init_with_uint32 gets 64 bits and puts the lower 32
#            into the state. The documentation of manual_seed gives the range -2^63 to 2^64 - 1; that of Generator
#            adds that any 32-bit integer is valid, not that the rest is ignored.
# Behaviour: seeds that are equal in the lower 32 bits give the same numbers, and `initial_seed` returns all 64.
# Guess:     (before the run) each of the 64-bit seeds that are accepted gives other numbers.
# Matters:   (replicate << 32) + view, or a seed whose upper half is the varied part, trains every replicate with
#            the same numbers: a spread of zero over replicates, and an interval without width. CUDA's generator
#            uses all 64 bits, so the same script is right on a GPU.
# Seen:      five replicates of one scene: 5 seeds, 1 set of numbers; seeds 0 to 4: 5 sets
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile torch==2.13.0 numpy==2.4.6
"$work/bin/python" -W ignore - <<'PY'
import sys
import torch

view = 7

def draw(seed):
    """Return the seed that torch reports, and its first numbers."""
    generator = torch.Generator().manual_seed(seed)
    return generator.initial_seed(), tuple(torch.randn(32, generator=generator).tolist())

packed = [draw((replicate << 32) + view) for replicate in range(5)]
plain = [draw(replicate) for replicate in range(5)]
count = len({seed for seed, _ in packed}), len({numbers for _, numbers in packed}), len({n for _, n in plain})
print(f"five replicates of one scene: {count[0]} seeds, {count[1]} set of numbers; seeds 0 to 4: {count[2]} sets")
sys.exit(count != (5, 1, 5))
PY
