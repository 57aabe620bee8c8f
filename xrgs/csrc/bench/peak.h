// Measures how many fused multiply-adds a machine can do, which xrgs-bench compares the kernels
// with.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct PeakKernels {
  // Does `rounds` times 16 fused multiply-adds of 16 lanes each, which do not depend on one another
  // within a round. The result has no meaning; it keeps the compiler from removing the work.
  float (*multiply_add)(std::int64_t rounds);
};

XRGS_DECLARE_TABLE(PeakKernels, peak_kernels)

}  // namespace xrgs
