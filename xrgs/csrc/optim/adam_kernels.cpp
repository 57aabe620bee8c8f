#include "optim/adam.h"
#include "raster/sh.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// The constants of an AdamGroup in all lanes.
struct Constants {
  Floats one_minus_beta1, beta2, one_minus_beta2, step_size, inv_sqrt_bias2, eps;
  explicit Constants(const AdamGroup& g)
      : one_minus_beta1(broadcast(g.one_minus_beta1)),
        beta2(broadcast(g.beta2)),
        one_minus_beta2(broadcast(g.one_minus_beta2)),
        step_size(broadcast(g.step_size)),
        inv_sqrt_bias2(broadcast(g.inv_sqrt_bias2)),
        eps(broadcast(g.eps)) {}
};

// Updates `lanes` values p with gradients g and moments m (exp_avg) and v (exp_avg_sq).
XRGS_INLINE void update(const Constants& k, float* p, const float* g, float* m, float* v,
                        int lanes) {
  const bool whole = lanes == kLanes;
  const Floats gradient = whole ? load(g) : load_first(g, lanes);
  Floats exp_avg = whole ? load(m) : load_first(m, lanes);
  Floats exp_avg_sq = whole ? load(v) : load_first(v, lanes);
  // If gradient and both moments are zero, nothing changes and nothing is written: for coefficients
  // of degrees that are not used yet, and for Gaussians that no view has shown.
  const Floats zero = broadcast(0.0f);
  if (to_bits((gradient == zero) & (exp_avg == zero) & (exp_avg_sq == zero)) == 0xffffu) return;
  exp_avg = fma(gradient - exp_avg, k.one_minus_beta1, exp_avg);
  exp_avg_sq = fma(exp_avg_sq, k.beta2, k.one_minus_beta2 * gradient * gradient);
  const Floats step = k.step_size * exp_avg / fma(sqrt(exp_avg_sq), k.inv_sqrt_bias2, k.eps);
  if (whole) {
    store(p, load(p) - step);
    store(m, exp_avg);
    store(v, exp_avg_sq);
  } else {
    store_first(p, load_first(p, lanes) - step, lanes);
    store_first(m, exp_avg, lanes);
    store_first(v, exp_avg_sq, lanes);
  }
}

void step(const AdamGroup& group, std::int64_t first, std::int64_t last) {
  const Constants k(group);
  const auto update_at = [&](std::int64_t i, int lanes) {
    update(k, group.parameter + i, group.gradient + i, group.exp_avg + i, group.exp_avg_sq + i,
           lanes);
  };
  std::int64_t i = first;
  for (; i + kLanes <= last; i += kLanes) update_at(i, kLanes);
  if (i < last) update_at(i, static_cast<int>(last - i));
}

// The gradient of a row is computed while previous rows are updated, so that its permutations run
// during the latency of their divisions and roots.
template <int Degree>
void step_shN_degree(const ShNAdamGroup& group, std::int64_t first, std::int64_t last) {
  const AdamGroup& adam = group.adam;
  const Constants k(adam);
  const std::int64_t width = std::int64_t{group.rest_count} * 3;
  ShGradientFactors factors;
  ShGradientRows gradient;
  for (std::int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    PaddedRows padded_means, padded_gradients;
    Vector3 mean;
    load_triples(padded_means.of(group.means, i, lanes, 3), mean.x, mean.y, mean.z);
    Floats inv_distance;
    store_basis<Degree>(view_direction(mean, group.camera_position, inv_distance), factors);
    const float* v_sh0 = padded_gradients.of(group.sh0_gradient, i, lanes, 3);
    for (int at = 0; at < 3 * kLanes; at += kLanes)
      store(factors.v_color + at, broadcast(1.0f / kC0) * load(v_sh0 + at));
    const std::int64_t begin = i * width, size = lanes * width;
    std::int64_t at = 0;
    const auto update_next = [&](int count) {
      const std::int64_t index = begin + at;
      update(k, adam.parameter + index, gradient.rows + at, adam.exp_avg + index,
             adam.exp_avg_sq + index, count);
      at += count;
    };
    for (int row = 0; row < lanes; ++row) {
      store_gradient_row<Degree>(factors, row, width, gradient);
      while (at + kLanes <= row * width) update_next(kLanes);
    }
    while (at + kLanes <= size) update_next(kLanes);
    if (at < size) update_next(static_cast<int>(size - at));
  }
}

void step_shN(const ShNAdamGroup& group, std::int64_t first, std::int64_t last) {
  switch (group.sh_degree) {
    case 0:
      return step_shN_degree<0>(group, first, last);
    case 1:
      return step_shN_degree<1>(group, first, last);
    case 2:
      return step_shN_degree<2>(group, first, last);
    default:
      return step_shN_degree<3>(group, first, last);
  }
}

}  // namespace

extern const AdamKernels adam_kernels{step, step_shN};

}  // namespace XRGS_NS
}  // namespace xrgs
