#!/usr/bin/env bash
# Hydra's Optuna sweeper reads `range` in two other ways than Hydra's own sweeper.
# Version:   hydra-optuna-sweeper 1.3.0, hydra-core 1.3.8, optuna 2.10.1 (it wants one below 3)
# Source:    hydra_plugins/hydra_optuna_sweeper/_impl.py: create_optuna_distribution_from_override hands
#            start and stop to Optuna's IntUniformDistribution, which includes its high end; the list for
#            the grid sampler has (high - low) // step values. Hydra's documentation of `range` (page
#            "Extended Override syntax", range sweep) excludes the stop.
# Behaviour: range(1,4) means 1, 2, 3 with Hydra's own sweeper, and 1, 2, 3, 4 with Optuna's samplers but
#            the grid. Its grid sampler leaves out the last value where the step does not divide the range:
#            range(0,10,4) means 0, 4 in place of 0, 4, 8.
# Guess:     one grammar, one meaning: the same values with each sweeper and sampler.
# Matters:   a condition of a study is missing, or one that was not asked for is in it, in silence.
# Seen:      basic range(0,10,4): 0 4 8; grid: 0 4; basic range(1,4): 1 2 3; random: 1 2 3 4
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work/venv"
python3 -m pip --quiet --python "$work/venv" install --no-compile hydra-core==1.3.8 hydra-optuna-sweeper==1.3.0 optuna==2.10.1
cd "$work"
cat > app.py <<'PY'
import hydra

@hydra.main(version_base=None, config_path=None)
def main(cfg):
    with open("values", "a") as file:
        file.write(f"{cfg.x}\n")
    return float(cfg.x)

main()
PY
# The values that a sweeper runs, in order, each once: values RANGE OVERRIDE ...
values() {
  rm -f values
  "$work/venv/bin/python" app.py -m "+x=$1" hydra.sweep.dir=out "${@:2}" > log 2>&1 || { cat log; exit 1; }
  sort -nu values | tr '\n' ' '
}
check() {
  echo "$1: $2"
  [[ $2 == "$3" ]] || { echo "no longer so: it was $3"; exit 1; }
}
optuna=(hydra/sweeper=optuna hydra.sweeper.n_trials=40 hydra.sweeper.n_jobs=40)
check "basic range(0,10,4)" "$(values 'range(0,10,4)')" "0 4 8 "
check "grid range(0,10,4)" "$(values 'range(0,10,4)' "${optuna[@]}" hydra/sweeper/sampler=grid)" "0 4 "
check "basic range(1,4)" "$(values 'range(1,4)')" "1 2 3 "
check "random range(1,4)" "$(values 'range(1,4)' "${optuna[@]}" hydra/sweeper/sampler=random hydra.sweeper.sampler.seed=0)" "1 2 3 4 "
