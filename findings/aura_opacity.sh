#!/usr/bin/env bash
# Version:   aura-splat 1.1.0 (PyPI), Python 3.11
# Source:    PyPI; aura/ingest/splats.py, `_sample_from_ply_row`
# Behaviour: the property `opacity` of a 3DGS .ply is a logit. A value between 0 and 1 is taken for the opacity
#            itself, so opacities of 0.5 to 0.73 become 0 to 1, and are not monotonic: a logit of 0 is invisible.
# Guess:     (before the run) logits of -1, 0, 0.5, 1 and 2 are read as opacities of 0.27, 0.50, 0.62, 0.73, 0.88.
# Seen:      0.27 0.00 0.50 1.00 0.88
# Fails if this changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet aura-splat==1.1.0
cat > run.py <<'PY'
from pathlib import Path

from aura.ingest.splats import load_3dgs_ply

names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
logits = [-1, 0, 0.5, 1, 2]
header = ["ply", "format ascii 1.0", f"element vertex {len(logits)}"]
header += [f"property float {name}" for name in names] + ["end_header"]
rows = [f"0 0 1 0 0 0 {logit} -3 -3 -3 1 0 0 0" for logit in logits]
Path("a.ply").write_text("\n".join(header + rows) + "\n")
print(*(f"{sample.opacity:.2f}" for sample in load_3dgs_ply("a.ply")))
PY
venv/bin/python run.py | tee seen
diff seen <(echo '0.27 0.00 0.50 1.00 0.88')
