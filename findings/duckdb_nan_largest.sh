#!/usr/bin/env bash
# A score of NaN is the best of all for DuckDB and half so for polars, and it moves their medians without a NaN.
# Version:   duckdb 2.0.1, polars 2.1.0; pandas 3.1.1 and numpy 2.4.6 as the judges
# Source:    DuckDB's documentation of floating-point types, as PostgreSQL: NaN is equal to itself and larger than any
#            number. polars' documentation of top_k and sort: NaN is larger; of max: NaN is not counted.
# Behaviour: DuckDB's max, arg_max, median and ORDER BY ... DESC count NaN as the largest number, polars' sort, top_k
#            and median too, its max and arg_max do not. A median of numbers and one NaN is a number.
# Guess:     (before the run) NaN is left out, as by pandas, or the result is NaN, as by NumPy: it is not the best run.
# Matters:   the best run of a study is the one that diverged, and the median of its scores is too high, as if the
#            diverged run were the best: only a mean would have shown it.
# Seen:      27.1, NaN, 28.4, 9.5: the best is run b, the one with NaN; median 27.75 for 27.1; polars' max 28.4
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile duckdb==2.0.1 polars==2.1.0 pandas==3.1.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import sys
import duckdb
import numpy as np
import pandas as pd
import polars as pl

scores = pd.DataFrame({"run": ["a", "b", "c", "d"], "psnr": [27.1, np.nan, 28.4, 9.5]})
database = duckdb.connect()
database.execute("create table scores (run varchar, psnr double)")
rows = zip(scores["run"], map(float, scores["psnr"]), strict=True)
database.executemany("insert into scores values (?, ?)", list(rows))
best, median = database.execute("select arg_max(run, psnr), median(psnr) from scores").fetchone()
print(f"DuckDB: {best}, median {median:.2f}")
frame = pl.DataFrame({"run": scores["run"].to_list(), "psnr": scores["psnr"].to_numpy()})
top, middle, largest = frame.top_k(1, by="psnr")["run"].item(), frame["psnr"].median(), frame["psnr"].max()
print(f"polars: {top}, median {middle:.2f}, max {largest}")
judge = scores["run"][scores["psnr"].idxmax()], scores["psnr"].median()
print(f"pandas: {judge[0]}, median {judge[1]:.2f}; NumPy: median {np.median(scores['psnr'].to_numpy())}")
sys.exit(not ((best, median) == (top, middle) == ("b", 27.75) and largest == 28.4 and judge == ("c", 27.1)))
PY
