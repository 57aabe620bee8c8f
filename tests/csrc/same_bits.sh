#!/usr/bin/env bash
# Checks that the kernels give the results of same_bits.txt, bit for bit, on this machine's
# instruction sets with 1, 2 and 3 threads, and on 64-bit ARM under emulation:
#   tests/csrc/same_bits.sh [FOLDER]
# FOLDER (default build/same_bits) keeps the builds. CXX names the compiler of this machine. ARM needs
# aarch64-linux-gnu-g++ and qemu-aarch64 (Debian's g++-aarch64-linux-gnu and qemu-user); where they
# are missing, the script says so and leaves it out.
set -euo pipefail
export LC_ALL=C  # one order of sorting
root=$(cd "$(dirname "$0")/../.." && pwd)
folder=$(realpath -m "${1:-$root/build/same_bits}")
expected=$root/tests/csrc/same_bits.txt
found=$folder/found.txt
failed=0

build() { # NAME CMAKE-ARGUMENTS...
  cmake -S "$root/xrgs/csrc" -B "$folder/$1" -DXRGS_SAME_BITS=ON "${@:2}" > "$folder/$1.log"
  cmake --build "$folder/$1" --parallel "$(getconf _NPROCESSORS_ONLN)" >> "$folder/$1.log"
}

check() { # LABEL COMMAND...
  local output rounding
  if ! output=$("${@:2}" | sort); then
    echo "$1: failed"
    echo "$output"
    failed=1
    return
  fi
  echo "$output" >> "$found"
  rounding=${output%% *}
  if diff <(grep "^$rounding " "$expected") <(echo "$output") > "$folder/diff.txt"; then
    echo "$1: the same bits"
  else
    echo "$1: differs (< expected, > found)"
    grep '^[<>]' "$folder/diff.txt"
    failed=1
  fi
}

mkdir -p "$folder"
: > "$found"
build here
for isa in $("$folder/here/same_bits"); do
  for threads in 1 2 3; do
    check "$isa, threads: $threads" env XRGS_ISA="$isa" "$folder/here/same_bits" "$threads"
  done
done
if command -v aarch64-linux-gnu-g++ > /dev/null && command -v qemu-aarch64 > /dev/null; then
  build arm64 -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 \
    -DCMAKE_CXX_COMPILER=aarch64-linux-gnu-g++ -DCMAKE_EXE_LINKER_FLAGS=-static
  check "arm64, threads: 2" qemu-aarch64 "$folder/arm64/same_bits" 2
else
  echo "arm64: left out, for want of aarch64-linux-gnu-g++ or qemu-aarch64"
fi

if [ "$failed" = 1 ]; then
  sort -u "$found" -o "$found"
  cat <<TEXT
What differs between instruction sets, compilers or numbers of threads is an error. What all of them
agree on, and same_bits.txt does not, is right only if this change is meant to change results: then
copy $found
to tests/csrc/same_bits.txt, and say in the changelog what changes by how much.
TEXT
  exit 1
fi
