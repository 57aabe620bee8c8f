// The activation functions of the raw parameters, and their gradients, on whole arrays.
#pragma once

#include <cstdint>

#include "isa.h"

namespace xrgs {

// Each function computes elements first..last-1 of its output. `y` is the value of the activation
// function, `v_y` the gradient of the loss with respect to y.
struct ActivationKernels {
  // y = e^x: 0 if e^x is below 2^-126, infinite if it is above the largest float, NaN for NaN.
  void (*exp)(const float* x, float* y, std::int64_t first, std::int64_t last);
  // v_x = v_y y
  void (*exp_backward)(const float* v_y, const float* y, float* v_x, std::int64_t first,
                       std::int64_t last);
  // y = 1 / (1 + e^-x): 0 if y is below 2^-126, NaN for NaN.
  void (*logistic)(const float* x, float* y, std::int64_t first, std::int64_t last);
  // v_x = v_y y (1 - y)
  void (*logistic_backward)(const float* v_y, const float* y, float* v_x, std::int64_t first,
                            std::int64_t last);
};

XRGS_DECLARE_TABLE(ActivationKernels, activation_kernels)

}  // namespace xrgs
