#include "optim/adam.h"
#include "raster/sh.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

struct Constants {
  Floats keep1, beta2, keep2, rate, inv_root, eps;
  explicit Constants(const AdamGroup& g)
      : keep1(splat(g.keep1)),
        beta2(splat(g.beta2)),
        keep2(splat(g.keep2)),
        rate(splat(g.rate)),
        inv_root(splat(g.inv_root)),
        eps(splat(g.eps)) {}
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

template <int Degree>
void step_harmonics_degree(const HarmonicsGroup& group, std::int64_t first, std::int64_t last) {
  const AdamGroup& adam = group.adam;
  const Constants k(adam);
  const std::int64_t width = std::int64_t{group.rest} * 3;
  Harmonics gradient;
  for (std::int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    Padded means, slopes;
    Vector3 mean, v;
    load_triples(means.of(group.means, i, lanes, 3), mean.x, mean.y, mean.z);
    load_triples(slopes.of(group.sh0_gradient, i, lanes, 3), v.x, v.y, v.z);
    Floats inv;
    const Vector3 direction = direction_of(mean, group.position, inv);
    harmonics_gradient<Degree>(direction, times(splat(1.0f / kC0), v), group.rest, gradient);
    const std::int64_t begin = i * width, size = lanes * width;
    for (std::int64_t at = 0; at < size; at += kLanes) {
      const int some = size - at < kLanes ? static_cast<int>(size - at) : kLanes;
      const std::int64_t place = begin + at;
      move(k, adam.parameter + place, gradient.rows + at, adam.mean + place, adam.square + place,
           some);
    }
  }
}

void step_harmonics(const HarmonicsGroup& group, std::int64_t first, std::int64_t last) {
  switch (group.degree) {
    case 0:
      return step_harmonics_degree<0>(group, first, last);
    case 1:
      return step_harmonics_degree<1>(group, first, last);
    case 2:
      return step_harmonics_degree<2>(group, first, last);
    default:
      return step_harmonics_degree<3>(group, first, last);
  }
}

}  // namespace

extern const AdamKernels adam_kernels{step, step_harmonics};

}  // namespace XRGS_NS
}  // namespace xrgs
