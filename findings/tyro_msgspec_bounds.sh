#!/usr/bin/env bash
# A command line that tyro makes of a msgspec Struct does not hold the bounds of its fields.
# Version:   tyro 1.0.17 with msgspec 0.22.0
# Source:    msgspec documentation, "Constraints": they are applied when decoding and by msgspec.convert, not
#            by the constructor of a Struct. tyro/constructors/_struct_spec_msgspec.py: Structs are made by their
#            constructor.
# Behaviour: each library works as written, together they drop msgspec.Meta: `--steps -5` passes where the
#            field is Annotated[int, Meta(ge=1)], and the same value in a file is refused.
# Guess:     refused by tyro, which reads the annotations for its help, or by msgspec.
# Matters:   a negative number of steps, or a fraction of LR views above 1, is planned from the command line.
# Seen:      tyro: Settings(steps=-5, hr_fraction=1.5); msgspec.convert: Expected `int` >= 1 - at `$.steps`
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv --without-pip "$work"
python3 -m pip --quiet --python "$work" install tyro==1.0.17 msgspec==0.22.0
cat > "$work/app.py" <<'PY'
import sys
from typing import Annotated
import msgspec
import tyro

class Settings(msgspec.Struct):
    steps: Annotated[int, msgspec.Meta(ge=1)] = 100
    hr_fraction: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.5

settings = tyro.cli(Settings)
print("tyro:", settings)
try:
    msgspec.convert(msgspec.to_builtins(settings), Settings)
except msgspec.ValidationError as error:
    print("msgspec.convert:", error)
    sys.exit(0)
sys.exit("msgspec no longer refuses it")
PY
"$work/bin/python" "$work/app.py" --steps -5 --hr-fraction 1.5
