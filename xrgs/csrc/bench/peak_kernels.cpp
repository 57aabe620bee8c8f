#include "bench/peak.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

#if defined(__AVX512F__)
constexpr int kSums = 16;
#else
constexpr int kSums = 4;  // each is two registers or more, of sixteen
#endif

float multiply_add(std::int64_t rounds) {
  Floats sums[kSums];
  for (int i = 0; i < kSums; ++i) sums[i] = splat(static_cast<float>(i));
  const Floats a = splat(0.999f), b = splat(0.001f);
  for (std::int64_t round = 0; round < rounds * (16 / kSums); ++round) {
#pragma GCC unroll 16
    for (int i = 0; i < kSums; ++i) sums[i] = fma(sums[i], a, b);
  }
  Floats total = splat(0.0f);
  for (const Floats& s : sums) total += s;
  return sum(total);
}

}  // namespace

extern const PeakKernels peak_kernels{multiply_add};

}  // namespace XRGS_NS
}  // namespace xrgs
