// Mean and variance of a photograph in each SSIM window, for the photometric loss. The results have
// the bits of xrgs.splat.torch.loss.target_moments.
#pragma once

#include "isa.h"
#include "loss/photometric.h"

namespace xrgs {

struct WindowMomentsJob {
  const float* image;  // [H, W, 3]
  int height, width;
  const double* window;    // [11], the weights of the window along one axis
  float *mean, *variance;  // [H - 10, W - 10, 3] receive the moments
};

struct WindowMomentsKernels {
  // Computes rows first..last-1 of the moments.
  void (*rows)(const WindowMomentsJob& job, int first, int last);
};

XRGS_DECLARE_TABLE(WindowMomentsKernels, window_moments_kernels)

}  // namespace xrgs
