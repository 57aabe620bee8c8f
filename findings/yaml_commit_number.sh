#!/usr/bin/env bash
# A commit's abbreviation that PyYAML wrote as text is a number, or infinite, for OmegaConf and ruamel.yaml.
# Version:   pyyaml 6.0.4, omegaconf 2.4.0, ruamel.yaml 0.19.1
# Source:    yaml/resolver.py: a float needs a point (YAML 1.1 as PyYAML has it), so 1234e56 is text and needs no quotes.
#            omegaconf/_yaml.py, get_yaml_loader, and ruamel/yaml/resolver.py for YAML 1.2 take digits, e, digits.
# Behaviour: yaml.safe_dump writes 1234e56 without quotes. PyYAML reads text, the two others 1.234e+59;
#            12e4567 is infinite. What has digits only is quoted and comes back.
# Guess:     (before the run) text that one YAML library writes is the same text in another.
# Matters:   one in fifty abbreviations of seven digits has one e between decimal digits: the
#            provenance of such a run is lost, and runs of two commits are equal where both are infinite.
# Seen:      1234e56 is 1.234e+59, 12e4567 inf, 1234567 '1234567'; 2.0 % of commits
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install --no-compile pyyaml==6.0.4 omegaconf==2.4.0 ruamel.yaml==0.19.1
"$work/bin/python" - <<'PY'
import random
import sys
import yaml
from omegaconf import OmegaConf
from ruamel.yaml import YAML

commits = ["1234e56", "12e4567", "1234567"]
text = yaml.safe_dump({"commits": commits})
readers = {
    "PyYAML": yaml.safe_load(text)["commits"],
    "OmegaConf": list(OmegaConf.create(text).commits),
    "ruamel.yaml": list(YAML(typ="safe").load(text)["commits"]),
}
for name, read in readers.items():
    print(f"{name}:", *(repr(value) for value in read))
rng = random.Random(0)
drawn = ["".join(rng.choices("0123456789abcdef", k=7)) for _ in range(5000)]
share = sum(not isinstance(value, str) for value in OmegaConf.create(yaml.safe_dump(drawn))) / len(drawn)
print(f"{share:.1%} of commits")
numbers = [1.234e59, float("inf"), "1234567"]
expected = {"PyYAML": commits, "OmegaConf": numbers, "ruamel.yaml": numbers}
sys.exit(readers != expected)
PY
