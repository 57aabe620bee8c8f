#!/usr/bin/env bash
# The median in polars' describe is not polars' median.
# Version:   polars 2.1.0
# Source:    polars documentation of DataFrame.describe: "The median is included by default as the 50% percentile";
#            its argument `interpolation` is "nearest" unless it is given, that of median is the middle of two.
# Behaviour: with an even number of values the row 50% is one of the two in the middle, here the upper one.
# Guess:     (before the run) the row 50% is the median, as the documentation says and as pandas' describe has it.
# Matters:   a table of medians over 4 replicates or 8 scenes has another value than median() of the same column.
# Seen:      20, 21, 30, 31 dB: 50% is 30.0, the median 25.5
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile polars==2.1.0
"$work/bin/python" - <<'PY'
import sys
import polars as pl

scores = pl.DataFrame({"psnr": [20.0, 21.0, 30.0, 31.0]})
half = scores.describe().filter(pl.col("statistic") == "50%")["psnr"].item()
median = scores["psnr"].median()
print(f"20, 21, 30, 31 dB: 50% is {half}, the median {median}")
sys.exit((half, median) != (30.0, 25.5))
PY
