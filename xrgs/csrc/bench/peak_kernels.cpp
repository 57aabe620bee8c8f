#include "bench/peak.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Sums that are computed side by side; they must fit into the registers.
constexpr int kSums = kVectorRegisters >= 32 ? 16 : 4;

float multiply_add(std::int64_t rounds) {
  Floats sums[kSums];
  for (int i = 0; i < kSums; ++i) sums[i] = broadcast(static_cast<float>(i));
  const Floats a = broadcast(0.999f), b = broadcast(0.001f);
  for (std::int64_t round = 0; round < rounds * (16 / kSums); ++round) {
#pragma GCC unroll 16
    for (int i = 0; i < kSums; ++i) sums[i] = fma(sums[i], a, b);
  }
  Floats total = broadcast(0.0f);
  for (const Floats& s : sums) total += s;
  return sum_lanes(total);
}

}  // namespace

extern const PeakKernels peak_kernels{multiply_add};

}  // namespace XRGS_NS
}  // namespace xrgs
