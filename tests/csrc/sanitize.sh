#!/usr/bin/env bash
# Builds the native module with AddressSanitizer and UndefinedBehaviorSanitizer and runs its tests:
#   tests/csrc/sanitize.sh [FOLDER] [PYTEST ARGUMENTS]
# FOLDER (default build/sanitize) keeps the build. The Python that `python` names must have what
# `pip install .` needs, and the dependencies of the tests. An installed xrgs is not used.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
folder=$(realpath -m "${1:-$root/build/sanitize}")
shift || true
python=$(command -v python)

cmake -S "$root/xrgs/csrc" -B "$folder" -DXRGS_SANITIZE=ON -DCMAKE_BUILD_TYPE=RelWithDebInfo \
  -DPython_EXECUTABLE="$python"
cmake --build "$folder" --parallel "$(getconf _NPROCESSORS_ONLN)"

# The package is that of the checkout, with this module in the place of an installed one.
package=$folder/package/xrgs
rm -rf "$folder/package" && mkdir -p "$package"
for file in "$root"/xrgs/*; do
  case $file in *.so | */csrc) ;; *) ln -s "$file" "$package" ;; esac
done
ln -s "$folder"/_native.*.so "$package"
# The import hook of an editable install would come before PYTHONPATH.
cat > "$folder/package/sitecustomize.py" <<'PYTHON'
import sys

sys.meta_path[:] = [finder for finder in sys.meta_path if "ScikitBuild" not in type(finder).__name__]
PYTHON

# Python leaks at exit by design. A limit of memory leaves no room for shadow memory.
export ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1
export PYTHONSAFEPATH=1 PYTHONPATH=$folder/package:$root
compiler=${CXX:-c++}
cd "$root"
LD_PRELOAD="$("$compiler" -print-file-name=libasan.so) $("$compiler" -print-file-name=libubsan.so)"
export LD_PRELOAD
"$python" -c "
from xrgs import _native
assert _native.__file__.startswith('$folder'), f'{_native.__file__} is not the sanitized module'"
"$python" -m tests.splat.native.fuzz_rasterizer --count 1000  # pytest's 10,000 would take too long
"$python" -m pytest tests/splat/native -p no:cacheprovider -k "not beyond_memory and not fuzzing" "$@"
