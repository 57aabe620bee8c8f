// exp2 and log2 over whole arrays: what the tests of vector_math.h call.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct VectorMathKernels {
  void (*exp2)(const float* x, float* y, std::int64_t count);
  void (*log2)(const float* x, float* y, std::int64_t count);
};

XRGS_DECLARE_TABLE(VectorMathKernels, vector_math_kernels)

}  // namespace xrgs
