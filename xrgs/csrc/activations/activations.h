// The activation functions of the raw parameters, and their gradients, over whole arrays.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

// Each function computes the elements first..last-1 of its last argument. `y` is the value of the
// activation and `v_y` the gradient of the loss by it.
struct ActivationKernels {
  // y = e^x: 0 where e^x is below 2^-126, infinite where it is above the largest float, NaN for
  // NaN.
  void (*exp)(const float* x, float* y, std::int64_t first, std::int64_t last);
  // v_x = v_y y
  void (*exp_backward)(const float* v_y, const float* y, float* v_x, std::int64_t first,
                       std::int64_t last);
  // y = 1 / (1 + e^-x): 0 where it is below 2^-126, NaN for NaN.
  void (*logistic)(const float* x, float* y, std::int64_t first, std::int64_t last);
  // v_x = v_y y (1 - y)
  void (*logistic_backward)(const float* v_y, const float* y, float* v_x, std::int64_t first,
                            std::int64_t last);
};

XRGS_DECLARE_TABLE(ActivationKernels, activation_kernels)

}  // namespace xrgs
