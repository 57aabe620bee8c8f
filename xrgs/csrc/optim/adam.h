// Adam (Kingma and Ba 2015, Algorithm 1), in the form of torch's fused step.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

// One parameter tensor, its gradient and its moments, all of `size` floats.
struct AdamGroup {
  float* parameter;
  const float* gradient;
  float *exp_avg, *exp_avg_sq;
  std::int64_t size;
  float one_minus_beta1, beta2, one_minus_beta2;
  float step_size;       // lr / (1 - beta1^step)
  float inv_sqrt_bias2;  // 1 / sqrt(1 - beta2^step)
  float eps;
};

// The parameter shN. Its gradient is the gradient of sh0 times the basis functions in the viewing
// direction, divided by the basis function of degree 0 (Eq. 31 of docs/rasterizer.md). It is
// computed during the step and never written to memory.
struct ShNAdamGroup {
  AdamGroup adam;             // gradient is unused; size is count * rest_count * 3
  std::int64_t count;         // Gaussians
  const float* means;         // [count, 3], the values that were rendered
  const float* sh0_gradient;  // [count, 3]
  float camera_position[3];
  int rest_count;  // basis functions above degree 0 that are stored
  int sh_degree;   // the highest degree that was rendered
};

struct AdamKernels {
  // Updates the values first..last-1 of a group.
  void (*step)(const AdamGroup& group, std::int64_t first, std::int64_t last);
  // Updates shN of Gaussians first..last-1.
  void (*step_shN)(const ShNAdamGroup& group, std::int64_t first, std::int64_t last);
};

XRGS_DECLARE_TABLE(AdamKernels, adam_kernels)

}  // namespace xrgs
