#include "simd/array_math.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

void exp2_array(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; i += kLanes) {
    const int lanes = count - i < kLanes ? static_cast<int>(count - i) : kLanes;
    store_first(y + i, exp2(load_first(x + i, lanes)), lanes);
  }
}

void log2_array(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; i += kLanes) {
    const int lanes = count - i < kLanes ? static_cast<int>(count - i) : kLanes;
    store_first(y + i, log2(load_first(x + i, lanes)), lanes);
  }
}

void sqrt_upper_bound_array(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; i += kLanes) {
    const int lanes = count - i < kLanes ? static_cast<int>(count - i) : kLanes;
    store_first(y + i, sqrt_upper_bound(load_first(x + i, lanes)), lanes);
  }
}

}  // namespace

extern const ArrayMathKernels array_math_kernels{exp2_array, log2_array, sqrt_upper_bound_array,
                                                 kFusedMultiplyAdd};

}  // namespace XRGS_NS
}  // namespace xrgs
