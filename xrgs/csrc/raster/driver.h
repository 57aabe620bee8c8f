// The stages in order: a view's forward and backward pass.
#pragma once

#include "raster/frame.h"
#include "raster/types.h"

namespace xrgs {

// Renders into image [H, W, 3] and alpha [H, W]. Returns false, with nothing rendered, where a
// parameter is not finite or out of range. Throws std::bad_alloc.
bool render(int threads, const Parameters& parameters, const View& view, Frame& frame, float* image,
            float* alpha);

// Gradients of the parameters from those of image and alpha; the parameters as they were rendered.
void render_backward(int threads, const Parameters& parameters, Frame& frame,
                     const float* image_gradient, const float* alpha_gradient,
                     const Gradients& gradients);

}  // namespace xrgs
