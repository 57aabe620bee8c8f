#!/usr/bin/env bash
# pandas reads the column render_time of its own JSON as dates in 1971.
# Version:   pandas 3.1.1
# Source:    documentation of read_json: columns named date, modified, timestamp..., ..._at or ..._time are converted to
#            dates by default; pandas/io/json/_json.py: where all numbers are above 31536000, one year in seconds.
# Behaviour: a column of integers that to_json wrote comes back as datetimes if its numbers are large enough and its
#            name ends so. The same numbers under another name, and smaller ones under this name, stay numbers.
# Guess:     (before the run) numbers stay numbers.
# Matters:   times of frames in nanoseconds become moments: a mean or a quotient of two of them is a date or an error,
#            and as numbers they have another unit.
# Seen:      render_time of 45, 52 and 61 million ns: 1971-06-05 20:00:00 first; render_ns: 45000000
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pandas==3.1.1 numpy==2.4.6
"$work/bin/python" - <<'PY'
import io
import sys
import pandas

times = [45_000_000, 52_000_000, 61_000_000]
table = pandas.DataFrame({"render_time": times, "render_ns": times, "train_time": [1200, 1300, 1400]})
back = pandas.read_json(io.StringIO(table.to_json()))
print("render_time", back.render_time[0], "render_ns", back.render_ns[0], "train_time", back.train_time[0])
dates = pandas.api.types.is_datetime64_any_dtype(back.render_time)
sys.exit(not (dates and list(back.render_ns) == times and list(back.train_time) == [1200, 1300, 1400]))
PY
