// The kernels of one instruction set, each in the file of its name; see kernels.h.
#pragma once

#include "raster/frame.h"
#include "raster/types.h"

namespace xrgs {
namespace XRGS_NS {

std::int64_t project(const Parameters& parameters, const View& view, std::int64_t first,
                     std::int64_t last, Frame& frame, std::uint64_t* order, bool* good);
std::int64_t emit(Frame& frame, std::int64_t* next, std::int64_t last, Pair* pairs,
                  std::int64_t room, std::uint32_t* tile_counts);
void composite(Frame& frame, int tile, float* image, float* alpha);
void composite_backward(const Frame& frame, int tile, const float* image_gradient,
                        const float* alpha_gradient, float* sums);
void project_backward(const Parameters& parameters, const Frame& frame, const float* sums,
                      std::int64_t first, std::int64_t last, const Gradients& gradients);

}  // namespace XRGS_NS
}  // namespace xrgs
