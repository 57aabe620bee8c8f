#!/usr/bin/env bash
# One p-value that is not a number makes statsmodels' corrections stricter, or empties them.
# Version:   statsmodels 0.15.0 with scipy 1.17.1
# Source:    statsmodels/stats/multitest.py: multipletests sorts the p-values and takes their count with the NaN,
#            which sorts last. The documentation does not mention missing values; pingouin.multicomp leaves them out.
# Behaviour: Holm counts the NaN as one more hypothesis. fdr_bh and fdr_by return corrected values that are all NaN,
#            while their array `reject` still has the verdicts of a family with one more test.
# Guess:     (before the run) the others are corrected as if the missing one was absent.
# Matters:   a comparison without a p-value (one scene, or differences that are all zero) changes the verdicts on the
#            other comparisons of the table.
# Seen:      Holm: 4 rejections become 1; fdr_bh: 4 stay, with corrected values that are all NaN; fdr_by: 4 become 1
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile statsmodels==0.15.0 scipy==1.17.1 numpy==2.4.6 pandas==3.1.1
"$work/bin/python" - <<'PY'
import sys
import numpy as np
from statsmodels.stats.multitest import multipletests

p = np.array([0.001, 0.011, 0.0125, 0.0145, 0.2])
seen = {}
for method in ("holm", "fdr_bh", "fdr_by"):
    whole, whole_p = multipletests(p, method=method)[:2]
    holed, holed_p = multipletests(np.insert(p, 2, np.nan), method=method)[:2]
    seen[method] = (int(whole.sum()), int(holed.sum()), bool(np.isnan(holed_p).all()))
    print(f"{method}: {seen[method][0]} rejections, with one NaN {seen[method][1]}; corrected:", holed_p.round(3))
sys.exit(seen != {"holm": (4, 1, False), "fdr_bh": (4, 4, True), "fdr_by": (4, 1, True)})
PY
