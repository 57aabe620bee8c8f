// What densification notes of a step: one pass over the Gaussians.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

struct Observation {
  const float* slope;           // [N, 2] of the loss by the projected means, per px
  const std::uint8_t* visible;  // [N] 0 or 1
  float scale_x, scale_y;       // px to the units of the sum
  float* gradient;              // [N] sum of the slopes' norms
  float* seen;                  // [N] how many they are
};

struct ObserveKernels {
  // Gaussians first..last-1.
  void (*observe)(const Observation& job, std::int64_t first, std::int64_t last);
};

XRGS_DECLARE_TABLE(ObserveKernels, observe_kernels)

}  // namespace xrgs
