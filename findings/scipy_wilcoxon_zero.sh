#!/usr/bin/env bash
# SciPy's Wilcoxon test of the same scores changes its verdict between versions where one difference is zero.
# Version:   scipy 1.12.0 (numpy 1.26.4) against scipy 1.17.1 (numpy 2.4.6); Python 3.11 or 3.12
# Source:    scipy/stats/_morestats.py: wilcoxon; in 1.17.1 scipy/stats/_wilcoxon.py: _wilcoxon_nd. It is what
#            method="auto" takes for few pairs with a zero or a tie.
# Behaviour: one zero among the differences made the older version leave the exact distribution for the
#            normal approximation, which is too optimistic for few pairs. The newer one stays exact.
# Guess:     a p-value is a property of the data and the test: the same in both.
# Matters:   five scenes that improve and one that does not change: significant at 5 % with one, not with
#            the other. Rerunning an old study with new libraries contradicts it.
# Seen:      1.12.0: p = 0.0431; 1.17.1: p = 0.0625
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The p-value of six differences: p VERSION VERSION_OF_NUMPY
p() {
  python3 -m venv --clear --without-pip "$work/venv"
  python3 -m pip --quiet --python "$work/venv" install --no-compile "scipy==$1" "numpy==$2"
  "$work/venv/bin/python" -W ignore -c \
    'from scipy.stats import wilcoxon; print(f"{wilcoxon([0, 0.1, 0.2, 0.3, 0.4, 0.5]).pvalue:.4f}")'
}
old=$(p 1.12.0 1.26.4)
new=$(p 1.17.1 2.4.6)
echo "1.12.0: p = $old; 1.17.1: p = $new"
[[ $old == 0.0431 && $new == 0.0625 ]]
