#!/usr/bin/env bash
# Builds the thread pool with ThreadSanitizer and runs it hard, which takes some seconds:
#   tests/csrc/thread_sanitizer.sh
# CXX names the compiler.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${CXX:-c++}" -std=c++17 -O1 -g -fsanitize=thread -Wall -Wextra -Wpedantic -Wshadow -Werror \
  -I "$root/xrgs/csrc" "$root/tests/csrc/thread_pool_stress.cpp" "$root/xrgs/csrc/thread_pool.cpp" \
  -o "$work/stress" -pthread
# Children are forked while the pool's threads sleep, which the sanitizer refuses by default.
TSAN_OPTIONS="halt_on_error=1 die_after_fork=0" "$work/stress"
