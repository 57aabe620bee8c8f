// Adds the image-plane gradients of one step to the densification statistics, in one pass over
// memory.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct Grad2dJob {
  const float* means2d_grad;    // [N, 2] dL/d(projected means), per px
  const std::uint8_t* visible;  // [N] 0 or 1
  float scale_x, scale_y;       // convert the gradient to the units of the sum
  float* grad2d_sum;            // [N] sum of the norms of the scaled gradients, updated in place
  float* visible_count;  // [N] number of steps in which the Gaussian was visible, updated in place
};

struct Grad2dKernels {
  // Updates Gaussians first..last-1.
  void (*accumulate)(const Grad2dJob& job, std::int64_t first, std::int64_t last);
};

XRGS_DECLARE_TABLE(Grad2dKernels, grad2d_kernels)

}  // namespace xrgs
