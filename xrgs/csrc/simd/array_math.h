// exp2, log2 and sqrt_upper_bound of simd.h for whole arrays, so that tests can call them, and the
// property of an instruction set's arithmetic.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct ArrayMathKernels {
  void (*exp2)(const float* x, float* y, std::int64_t count);
  void (*log2)(const float* x, float* y, std::int64_t count);
  void (*sqrt_upper_bound)(const float* x, float* y, std::int64_t count);
  bool fused_multiply_add;  // kFusedMultiplyAdd of simd.h
};

XRGS_DECLARE_TABLE(ArrayMathKernels, array_math_kernels)

}  // namespace xrgs
