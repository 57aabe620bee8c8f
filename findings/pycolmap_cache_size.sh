#!/usr/bin/env bash
# pycolmap places a camera elsewhere on a processor with another size of the first-level data cache.
# Version:   pycolmap 4.2.1 (Linux, x86-64)
# Source:    Eigen Eigen/src/Core/products/GeneralBlockPanelKernel.h: evaluateProductBlockingSizesHeuristic
#            cuts the sums of a matrix product where a block fills the L1 cache, whose size the processor
#            tells (queryCacheSizes): every 504 terms or fewer with 32 KB, 760 with 48 KB. colmap
#            src/colmap/estimators/solvers/absolute_pose.cc: EPnP sums over three rows for each point.
# Behaviour: from 169 points on, estimate_absolute_pose has other last digits with 32 KB of L1 (AMD up to
#            Zen 4, Intel up to Cascade Lake) than with 48 KB (Zen 5, Ice Lake and later). No setting
#            changes it. Instruction sets, the other caches and the number of threads do not matter.
# Guess:     builds for baseline x86-64 give the same bits on every x86-64 processor; where results differ,
#            it is by instruction sets (AVX2, AVX-512), and a variable of the environment pins them.
# Matters:   SfM registers each image by it. Later draws and thresholds can turn last digits into other
#            points and cameras: the same photographs, program and seed give another reconstruction.
# Seen:      1000 points: the pose differs by up to 8.7e-15 between 32 and 48 KB
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pycolmap==4.2.1
"$work/bin/python" - <<'PY'
import ctypes
import sys
import zlib  # noqa: F401  before pycolmap 4.2.1, which corrupts the heap otherwise
from pathlib import Path

import numpy as np
import pycolmap

rng = np.random.default_rng(0)
points = rng.uniform(-2, 2, (1000, 3)) + [0, 0, 6]
pixels = 800 * points[:, :2] / points[:, 2:] + 500 + rng.normal(0, 0.5, (1000, 2))
camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1000, height=1000, params=[800, 500, 500])


def pose():
    pycolmap.set_random_seed(0)
    return pycolmap.estimate_absolute_pose(pixels, points, camera)["cam_from_world"].matrix()


def addresses_of(*numbers):
    """Where pycolmap's own variables hold these 64-bit integers one after the other."""
    wanted, addresses, end = np.array(numbers, "<i8").tobytes(), [], 0
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, mode, *rest = line.split(maxsplit=5)
        first, stop = (int(number, 16) for number in span.split("-"))
        ours = "pycolmap/_core" in rest[-1] or (first == end and len(rest) == 3)  # .bss is nameless
        end = stop if ours else 0
        if ours and mode.startswith("rw"):
            memory = ctypes.string_at(first, stop - first)
            addresses += [first + i for i in range(0, len(memory), 8) if memory.startswith(wanted, i)]
    return addresses


# Eigen asks the processor at the first product, and keeps the sizes of its caches in a variable. To see
# what a processor with another cache computes, write that size there.
own = pose()
caches = [Path(f"/sys/devices/system/cpu/cpu0/cache/index{i}/size").read_text() for i in (0, 2)]
(l1,) = addresses_of(*(int(size.strip().removesuffix("K")) * 1024 for size in caches))
poses = {}
for size in (32, 48):
    ctypes.c_int64.from_address(l1).value = size * 1024
    poses[size] = pose()
    print(f"L1 of {size} KB: this processor's bits: {np.array_equal(poses[size], own)}")
difference = np.abs(poses[32] - poses[48]).max()
print(f"1000 points: the pose differs by up to {difference:.1e} between 32 and 48 KB")
sys.exit(not 0 < difference < 1e-12)
PY
