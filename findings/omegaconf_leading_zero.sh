#!/usr/bin/env bash
# A number with a leading zero is octal in a YAML file of Hydra, and text on its command line.
# Version:   hydra-core 1.3.8 with omegaconf 2.3.1; omegaconf 2.4.0 alike
# Source:    omegaconf/_utils.py: get_yaml_loader keeps PyYAML's integers, which are YAML 1.1's: 024 is octal.
#            hydra/grammar/OverrideLexer.g4: INT has no leading zero, so 024 is an unquoted string.
# Behaviour: `scan: 024` is the number 20, `scan=024` is the text "024". 069 has a digit that octal lacks:
#            it is text in both.
# Guess:     24, or at least the same on the command line and in the file.
# Matters:   scans of DTU, sequences of KITTI and frames have such names. A list of scans in a YAML file
#            names other scans, all of which may exist.
# Seen:      [024, 037, 040, 055, 063, 069] is [20, 31, 32, 45, 51, '069']
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for version in 2.3.1 2.4.0; do
  python3 -m venv --clear --without-pip "$work/venv"
  # hydra-core 1.3.8 wants omegaconf below 2.4: its parser is tried with the version that it wants.
  python3 -m pip --quiet --python "$work/venv" install "omegaconf==$version" $([[ $version == 2.3.1 ]] && echo hydra-core==1.3.8)
  "$work/venv/bin/python" - <<'PY'
import importlib.util
import sys
import omegaconf
from omegaconf import OmegaConf

scans = OmegaConf.to_object(OmegaConf.create("scan: [024, 037, 040, 055, 063, 069]").scan)
print(f"omegaconf {omegaconf.__version__}: [024, 037, 040, 055, 063, 069] is {scans}")
if importlib.util.find_spec("hydra"):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    value = OverridesParser.create().parse_override("scan=024").value()
    print(f"command line: scan=024 is {value!r}")
    if value != "024":
        sys.exit("no longer so")
sys.exit(scans != [20, 31, 32, 45, 51, "069"])
PY
done
