// The costs of a plane sweep, and their sums along lines in semi-global matching: the bits of the
// numpy code in xrgs/training/dense, which says what is computed.
#pragma once

#include <cstddef>
#include <cstdint>

#include "isa.h"

namespace xrgs {

// Another view, in which the pixel (x, y) of the swept view is at
// (a0 + b0 q, a1 + b1 q) / (a2 + b2 q), px, where q is its inverse depth.
struct OtherView {
  const float* a;  // [3, h, w]
  float b[3];
  const float* image;        // [height + 1, width + 1]; the last row and column are there twice
  const std::uint8_t* used;  // [height, width] 0 outside the mask; null without a mask
  int height, width;
};

struct CostJob {
  // Of the 5 x 5 windows of the swept view [h, w]: the image minus 1/2, one over their number of
  // pixels, their mean, and their variance with the noise.
  const float *image, *share, *mean, *variance;
  int height, width;
  const float* inverse_depths;  // [D, h, w], or [D] where it is the same for all pixels
  bool per_pixel;
  const OtherView* others;
  int count;      // of the other views
  int best;       // this many of the highest correlations are averaged
  float noise;    // of the variances
  float nearest;  // the least depth in another view that counts as before it
  float* costs;   // [D, h, w]
};

struct StereoKernels {
  // Computes one plane's costs.
  void (*costs)(const CostJob& job, int plane, float* scratch);
  // Returns the floats of scratch, on a 64-byte boundary, that a call of `costs` needs.
  std::size_t (*costs_scratch)(const CostJob& job);
  // Adds up costs [n, planes, m] along the first axis, forward and backward, with the penalties of
  // semi-global matching. Needs 2 * planes * m floats of scratch.
  void (*sum_along)(const float* costs, std::size_t n, std::size_t planes, std::size_t m,
                    float jump, float step, float* sums, float* scratch);
};

XRGS_DECLARE_TABLE(StereoKernels, stereo_kernels)

}  // namespace xrgs
