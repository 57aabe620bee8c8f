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
  // Where the gradient and both moments are zero nothing changes, so nothing is written:
  // coefficients of degrees that are not used yet, and Gaussians that no view has shown.
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

template <int Degree>
void step_shN_degree(const ShNAdamGroup& group, std::int64_t first, std::int64_t last) {
  const AdamGroup& adam = group.adam;
  const Constants k(adam);
  const std::int64_t width = std::int64_t{group.rest_count} * 3;
  ShGradientRows gradient;
  for (std::int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    PaddedRows padded_means, padded_gradients;
    Vector3 mean, v_sh0;
    load_triples(padded_means.of(group.means, i, lanes, 3), mean.x, mean.y, mean.z);
    load_triples(padded_gradients.of(group.sh0_gradient, i, lanes, 3), v_sh0.x, v_sh0.y, v_sh0.z);
    Floats inv_distance;
    const Vector3 direction = view_direction(mean, group.camera_position, inv_distance);
    sh_coefficient_gradient<Degree>(direction, times(broadcast(1.0f / kC0), v_sh0),
                                    group.rest_count, gradient);
    const std::int64_t begin = i * width, size = lanes * width;
    for (std::int64_t at = 0; at < size; at += kLanes) {
      const int count = size - at < kLanes ? static_cast<int>(size - at) : kLanes;
      const std::int64_t index = begin + at;
      update(k, adam.parameter + index, gradient.rows + at, adam.exp_avg + index,
             adam.exp_avg_sq + index, count);
    }
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
