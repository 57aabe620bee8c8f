#!/usr/bin/env bash
# Build the native module with AddressSanitizer and UndefinedBehaviorSanitizer and run its tests:
#   tests/csrc/sanitize.sh [FOLDER] [PYTEST ARGUMENTS]
# FOLDER (default build/sanitize) keeps the build. Needs what `pip install .` needs, and the tests'
# dependencies, in the Python that `python` names.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
folder=$(realpath -m "${1:-$root/build/sanitize}")
shift || true
python=$(command -v python)

cmake -S "$root/xrgs/csrc" -B "$folder" -DXRGS_SANITIZE=ON -DCMAKE_BUILD_TYPE=RelWithDebInfo \
  -DPython_EXECUTABLE="$python"
cmake --build "$folder" --parallel "$(getconf _NPROCESSORS_ONLN)"

# The package as it stands, with this module in the place of an installed one.
package=$folder/package/xrgs
rm -rf "$package" && mkdir -p "$package"
for file in "$root"/xrgs/*; do
  case $file in *.so | */csrc) ;; *) ln -s "$file" "$package" ;; esac
done
ln -s "$folder"/_native.*.so "$package"

# Python itself leaks by design, and the memory test's limit leaves no room for shadow memory.
export ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1
export PYTHONSAFEPATH=1 PYTHONPATH=$folder/package
compiler=${CXX:-c++}
cd "$root"
LD_PRELOAD="$("$compiler" -print-file-name=libasan.so) $("$compiler" -print-file-name=libubsan.so)" \
  "$python" -m pytest tests/splat/native -p no:cacheprovider \
  --deselect tests/splat/native/test_rasterizer.py::test_lists_beyond_memory_are_a_clear_error "$@"
