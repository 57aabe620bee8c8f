// The forward and the backward pass of one view: all stages of the rasterizer in order.
#pragma once

#include "raster/frame.h"
#include "raster/types.h"

namespace xrgs {

// Renders into image [H, W, 3] and alpha [H, W], and sets frame.rendered. Returns 0, or without a
// render the bits of the faults: kWrongParameter, kTooLarge. Throws std::bad_alloc. If it throws or
// does not return 0, frame.rendered is false, and the frame can be used again.
std::uint32_t render(int threads, const GaussianParameters& parameters, const RenderConfig& config,
                     Frame& frame, float* image, float* alpha);

// Computes the gradients of the parameters from those of image and alpha, and returns whether all
// of them are finite. The parameters must be those of the frame's render. Throws std::bad_alloc;
// then it can be called again.
bool render_backward(int threads, const GaussianParameters& parameters, Frame& frame,
                     const float* v_image, const float* v_alpha,
                     const ParameterGradients& gradients);

}  // namespace xrgs
