// Checks of every operation of simd/simd.h, for each instruction set.
#pragma once

#include "isa.h"

namespace xrgs {

struct SimdChecks {
  // Compares every operation with what simd.h promises, lane by lane, for ordinary and special
  // values. Prints what differs, and returns the number of differences.
  int (*run)();
};

XRGS_DECLARE_TABLE(SimdChecks, simd_checks)

}  // namespace xrgs
