#!/usr/bin/env bash
# The integer in a pandas time depends on how the time was made.
# Version:   pandas 3.1.1
# Source:    pandas, "What's new in 3.0.0", on the resolution of datetimes, which is now inferred;
#            pandas/core/tools/datetimes.py: to_datetime, pandas/core/tools/timedeltas.py: to_timedelta.
# Behaviour: times read from text are microseconds, durations of float seconds are nanoseconds, and
#            astype("int64") gives whichever it is. Dividing by 1e9, as was right for every time until pandas
#            2, gives durations that are 1000 times too short for the one and right for the other.
# Guess:     nanoseconds, or one unit for all times.
# Matters:   training times that are computed from two time stamps of a log are 1000 times too small,
#            beside right ones from a column of seconds: a method "trains 1000 times faster".
# Seen:      600 s from two time stamps: 0.6; from to_timedelta of float seconds: 600.0
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install pandas==3.1.1
"$work/bin/python" - <<'PY'
import sys
import pandas as pd

stamps = pd.Series(pd.to_datetime(["2026-01-01 00:00:00", "2026-01-01 00:10:00"]))
from_stamps = stamps.diff().astype("int64").iloc[1] / 1e9
from_seconds = pd.Series(pd.to_timedelta([600.0, 1.5], unit="s")).astype("int64").iloc[0] / 1e9
print(f"600 s from two time stamps: {from_stamps}; from to_timedelta of float seconds: {from_seconds}")
sys.exit((from_stamps, from_seconds) != (0.6, 600.0))
PY
