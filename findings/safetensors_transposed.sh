#!/usr/bin/env bash
# safetensors 0.8 writes a transposed NumPy array with its values in another order.
# Version:   safetensors 0.8.0; 0.7.0 is right
# Source:    safetensors/numpy.py of 0.8.0: _flatten gives the serializer the array's pointer and shape, not its strides
#            (safetensors issue 825; the repository copies such arrays since). The docstring asks for contiguous
#            tensors and nothing tests it; safetensors.torch refuses such a tensor.
# Behaviour: the file has the memory's order with the shape of the view, without an error or warning.
# Guess:     (before the run) the values come back, as from numpy.save, or an error as for torch.
# Matters:   pictures as [channels, rows, columns] by transpose, features of scikit-learn's PCA, matrices from
#            Eigen: a cache of them has the right shape, range and mean, with the values in wrong places.
# Seen:      correlation of what was read with what was written: 0.7.0 1.00; 0.8.0 0.00
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for version in 0.7.0 0.8.0; do
  python3 -m venv --clear --without-pip "$work/venv"
  python3 -m pip --quiet --python "$work/venv" install --no-compile "safetensors==$version" numpy==2.4.6
  "$work/venv/bin/python" - "$work/picture.safetensors" "$version" <<'PY'
import sys
import numpy as np
from safetensors.numpy import load_file, save_file

path, version = sys.argv[1:]
picture = np.random.default_rng(0).random((60, 80, 3), dtype=np.float32).transpose(2, 0, 1)
save_file({"picture": picture}, path)
read = load_file(path)["picture"]
correlation = float(np.corrcoef(read.ravel(), picture.ravel())[0, 1])
print(f"{version}: {correlation:.2f}, mean {picture.mean():.4f} and {read.mean():.4f}")
sys.exit(abs(correlation) > 0.1 if version == "0.8.0" else not np.array_equal(read, picture))
PY
done
