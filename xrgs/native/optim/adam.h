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

struct AdamKernels {
  // Values first..last-1 of a group.
  void (*step)(const AdamGroup& group, std::int64_t first, std::int64_t last);
};

XRGS_DECLARE_TABLE(AdamKernels, adam_kernels)

}  // namespace xrgs
