#!/usr/bin/env bash
# Hydra's `range` of fractions has its stop or not, and other values than those that were written.
# Version:   hydra-core 1.3.8, with its basic sweeper
# Source:    hydra/core/override_parser/types.py: FloatRange adds Decimal(step), the exact value of the binary fraction,
#            to Decimal(start), and compares with Decimal(stop). The docstring of `range`, in grammar_functions.py,
#            says r[i] = start + step*i < stop, "integer or floating-point values".
# Behaviour: the sum of the steps is below or above the stop by their rounding. range(0.1,0.4,0.1) has 0.4 and
#            range(0.1,0.9,0.1) has no 0.9. Other values are the nearest to a sum, as 0.30000000000000004.
# Guess:     (before the run) the stop is left out, and the values are those of the decimals: 0.3.
# Matters:   a sweep has one condition more than was planned. A run at 0.30000000000000004 has another id, folder and
#            group in a table than a run at 0.3 from the command line, so replicates are not paired.
# Seen:      range(0.1,0.4,0.1): 0.1 0.2 0.30000000000000004 0.4; range(0.1,0.9,0.1): 8 values to 0.8
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work/venv"
python3 -m pip --quiet --python "$work/venv" install --no-compile hydra-core==1.3.8 omegaconf==2.3.1
cd "$work"
cat > job.py <<'PY'
import hydra

@hydra.main(version_base="1.3", config_path=None)
def job(conf):
    with open("values", "a") as file:
        file.write(f"{conf.share!r}\n")

job()
PY
for stop in 0.4 0.9; do
  venv/bin/python job.py -m "+share=range(0.1,$stop,0.1)" "hydra.sweep.dir=$stop" > /dev/null
  echo "range(0.1,$stop,0.1):" $(cat values | tee "values_$stop")
  rm values
done
[[ $(echo $(cat values_0.4)) == "0.1 0.2 0.30000000000000004 0.4" ]]
[[ $(wc -l < values_0.9) == 8 && $(tail -n 1 values_0.9) == 0.8 ]]
