#include "optim/adam.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

struct Constants {
  Floats keep1, beta2, keep2, rate, inv_root, eps;
  explicit Constants(const AdamGroup& g)
      : keep1(splat(g.keep1)), beta2(splat(g.beta2)), keep2(splat(g.keep2)), rate(splat(g.rate)),
        inv_root(splat(g.inv_root)), eps(splat(g.eps)) {}
};

XRGS_INLINE void move(const Constants& k, float* p, const float* g, float* m, float* v, int lanes) {
  const bool whole = lanes == kLanes;
  const Floats gradient = whole ? load(g) : load_first(g, lanes);
  Floats mean = whole ? load(m) : load_first(m, lanes);
  Floats square = whole ? load(v) : load_first(v, lanes);
  // Harmonics that are not on yet, Gaussians that no view has seen: what stays as it is need not be
  // read and written.
  const Floats zero = splat(0.0f);
  if (bits((gradient == zero) & (mean == zero) & (square == zero)) == 0xffffu) return;
  mean = fma(gradient - mean, k.keep1, mean);
  square = fma(square, k.beta2, k.keep2 * gradient * gradient);
  const Floats step = k.rate * mean / fma(sqrt(square), k.inv_root, k.eps);
  if (whole) {
    store(p, load(p) - step);
    store(m, mean);
    store(v, square);
  } else {
    store_first(p, load_first(p, lanes) - step, lanes);
    store_first(m, mean, lanes);
    store_first(v, square, lanes);
  }
}

void step(const AdamGroup& group, std::int64_t first, std::int64_t last) {
  const Constants k(group);
  const auto at = [&](std::int64_t i, int lanes) {
    move(k, group.parameter + i, group.gradient + i, group.mean + i, group.square + i, lanes);
  };
  std::int64_t i = first;
  for (; i + kLanes <= last; i += kLanes) at(i, kLanes);
  if (i < last) at(i, static_cast<int>(last - i));
}

}  // namespace

extern const AdamKernels adam_kernels{step};

}  // namespace XRGS_NS
}  // namespace xrgs
