// L1 and SSIM of a render against a photograph, and their gradient, in one pass over bands of rows.
#pragma once

#include <cstddef>

#include "isa.h"

namespace xrgs {

constexpr int kWindow = 11;  // side of the SSIM window, px
constexpr int kMapShrink =
    kWindow - 1;  // rows and columns by which the SSIM map is smaller than the image

// The arguments of one evaluation. The gradient is that of
//   l1_slope * sum w |image - target| + ssim_slope * sum w (1 - S),
// where w is the weight of each pixel, and S is the SSIM of each channel in every window that lies
// inside the image. The weight of a window is that of its central pixel.
struct PhotometricJob {
  const float *image, *target;                 // [H, W, 3]
  const float *target_mean, *target_variance;  // [H - 10, W - 10, 3], under the window
  const float* pixel_weight;                   // [H, W]; null weighs all pixels 1
  int height, width;
  float window[kWindow / 2 +
               1];  // weight of the window at each distance from its middle, along one axis
  float l1_slope, ssim_slope;
  double* l1_rows;    // [H] receives the sum of w |image - target| of each row
  double* ssim_rows;  // [H - 10] receives the sum of w (1 - S) of each row
  float* gradient;    // [H, W, 3] receives the gradient; null if only the sums are needed
};

struct PhotometricKernels {
  // Returns the number of floats in the `scratch` of `band`, which must be 64-byte aligned.
  std::size_t (*scratch_size)(const PhotometricJob& job);
  // Computes the sums and the gradient of rows first..last-1 of the image. The result of a row does
  // not depend on its band.
  void (*band)(const PhotometricJob& job, int first, int last, float* scratch);
};

XRGS_DECLARE_TABLE(PhotometricKernels, photometric_kernels)

}  // namespace xrgs
