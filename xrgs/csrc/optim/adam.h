// Adam (Kingma and Ba 2015) over a piece of a parameter, its gradient and its two moments.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct AdamGroup {
  float* parameter;
  const float* gradient;
  float *mean, *square;  // exp_avg and exp_avg_sq
  std::int64_t size;
  // As torch's fused step has them: keep = 1 - beta, rate = lr / (1 - beta1^t),
  // inv_root = 1 / sqrt(1 - beta2^t).
  float keep1, beta2, keep2, rate, inv_root, eps;
};

// The harmonics above band 0, whose gradient is made here of that of band 0, times their basis in
// the direction of view.
struct HarmonicsGroup {
  AdamGroup adam;             // without a gradient; size is count * rest * 3
  const float* means;         // [count, 3] as they were rendered
  const float* sh0_gradient;  // [count, 3]
  float position[3];          // of the camera
  int rest, degree;           // how many there are, and the highest band that is on
};

struct AdamKernels {
  // Values first..last-1 of a group.
  void (*step)(const AdamGroup& group, std::int64_t first, std::int64_t last);
  // Gaussians first..last-1.
  void (*step_harmonics)(const HarmonicsGroup& group, std::int64_t first, std::int64_t last);
};

XRGS_DECLARE_TABLE(AdamKernels, adam_kernels)

}  // namespace xrgs
