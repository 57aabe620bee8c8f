#!/usr/bin/env bash
# pingouin's intervals are rounded to two decimals, so those of SSIM and LPIPS differences are [0, 0].
# Version:   pingouin 0.7.0
# Source:    pingouin/config.py: `options["round.column.CI95"] = 2`; pingouin/utils.py, `_postprocess_dataframe` rounds
#            the values of the table and not their display. `compute_bootci` has its own `decimals=2`.
# Behaviour: the 95 % interval of `ttest` is rounded, its t and p are not. `options["round.column.CI95"] = None` gives
#            the interval.
# Guess:     (before the run) right to four digits, as the other columns are.
# Matters:   a difference in SSIM of 0.003 with p = 0.0001 has the interval [0, 0]. Others become up to 0.005 wider or
#            narrower, and take in 0 or leave it out by rounding.
# Seen:      ttest: p = 0.00012, CI95 [0.0, 0.0], SciPy's [0.00205, 0.00429]; compute_bootci: [0.0, 0.0]
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pingouin==0.7.0 scipy==1.17.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import numpy as np
import pingouin
from scipy import stats

differences = np.random.default_rng(0).normal(0.003, 0.002, 10)
table = pingouin.ttest(differences, 0).iloc[0]
low, high = stats.ttest_1samp(differences, 0).confidence_interval()
drawn = pingouin.compute_bootci(differences, func="mean", seed=0)
print(f"ttest: p = {table['p_val']:.5f}, CI95 {list(map(float, table['CI95']))}, SciPy's [{low:.5f}, {high:.5f}]")
print(f"compute_bootci: {list(map(float, drawn))}")
sys.exit(not (table["p_val"] < 0.01 and low > 0.001 and not np.any(table["CI95"]) and not np.any(drawn)))
PY
