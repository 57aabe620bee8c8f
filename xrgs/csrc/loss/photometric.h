// L1 and SSIM of a render against a photograph, and their gradient, in one pass over bands of rows.
#pragma once

#include <cstddef>

#include "isa.h"

namespace xrgs {

constexpr int kTaps = 11;          // of the SSIM window along each axis
constexpr int kReach = kTaps - 1;  // rows and columns that a map is smaller than its image

// What one call computes. The gradient is of l1_slope * sum |image - target| + ssim_slope * sum S,
// with S the SSIM of each channel where the whole window lies inside the image.
struct Photometric {
  const float *image, *target;   // [H, W, 3]
  const float *mean, *variance;  // [H - 10, W - 10, 3] of the target under the window
  int height, width;
  float taps[kTaps / 2 + 1];  // of the window: taps[|distance from the middle|]
  float l1_slope, ssim_slope;
  double* l1_rows;    // [H] sum of |image - target| over each row
  double* ssim_rows;  // [H - 10] sum of S over each row
  float* gradient;    // [H, W, 3], or null if only the sums are wanted
};

struct PhotometricKernels {
  // Floats of scratch that one call of `band` needs, on a 64-byte boundary.
  std::size_t (*scratch)(int width);
  // Rows first..last-1 of the image: their sums, and their gradient. Each row comes out the same
  // whatever band it is in.
  void (*band)(const Photometric& job, int first, int last, float* scratch);
};

XRGS_DECLARE_TABLE(PhotometricKernels, photometric_kernels)

}  // namespace xrgs
