#!/usr/bin/env bash
# hydra-zen's multirun gives a job the text "None" for the value None, and the number 1020 for the text "10_20".
# Version:   hydra-zen 0.17.2, hydra-core 1.3.8, omegaconf 2.3.1
# Source:    hydra_zen/_launch.py: `str` of each value of multirun becomes a part of Hydra's command line, which Hydra
#            parses again. There None is spelt null, underscores divide digits, and a comma parts two jobs. The types in
#            the same file allow None and text in multirun.
# Behaviour: in launch(..., multirun=True), None arrives as "None", which is true; the text "24" as a number, "10_20" as
#            1020; and "day,night" is two jobs. Without multirun, None is None.
# Guess:     (before the run) each job has the value and the type that were given in Python.
# Matters:   a condition without something (mask=None, appearance=None) runs with it, or with a file of that name; the
#            scene 2024_05_01 becomes 20240501. What was given had types, so no one looks for it.
# Seen:      None -> 'None', '10_20' -> 1020, 'day,night' -> 'day' and 'night'; a single launch: None
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile hydra-zen==0.17.2 hydra-core==1.3.8 omegaconf==2.3.1
cd "$work"
bin/python - <<'PY'
import sys
from hydra_zen import launch, make_config, multirun

def given(config):
    return config.value

config = make_config(value="mask.png")
(jobs,) = launch(
    config, given, overrides={"value": multirun([None, "10_20", "day,night"])}, multirun=True, version_base="1.3"
)
values = [job.return_value for job in jobs]
single = launch(config, given, overrides={"value": None}, version_base="1.3").return_value
print(values, single)
sys.exit(not (values == ["None", 1020, "day", "night"] and single is None))
PY
