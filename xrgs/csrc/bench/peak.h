// How many fused multiply-adds this machine can do: the yardstick of xrgs-bench.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct PeakKernels {
  // `rounds` times 16 fused multiply-adds of 16 lanes each, none waiting for another of its round.
  // The result only keeps the compiler from leaving the work out.
  float (*multiply_add)(std::int64_t rounds);
};

XRGS_DECLARE_TABLE(PeakKernels, peak_kernels)

}  // namespace xrgs
