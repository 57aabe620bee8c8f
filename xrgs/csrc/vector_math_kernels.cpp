#include "vector_math_kernels.h"

#include "vector_math.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

void exp2_all(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; i += kLanes) {
    const int lanes = count - i < kLanes ? static_cast<int>(count - i) : kLanes;
    store_first(y + i, exp2(load_first(x + i, lanes)), lanes);
  }
}

void log2_all(const float* x, float* y, std::int64_t count) {
  for (std::int64_t i = 0; i < count; i += kLanes) {
    const int lanes = count - i < kLanes ? static_cast<int>(count - i) : kLanes;
    store_first(y + i, log2(load_first(x + i, lanes)), lanes);
  }
}

}  // namespace

extern const VectorMathKernels vector_math_kernels{exp2_all, log2_all};

}  // namespace XRGS_NS
}  // namespace xrgs
