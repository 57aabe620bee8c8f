// The kernels of one instruction set, each defined in the file of its name and documented in
// raster_kernels.h.
#pragma once

#include "raster/frame.h"
#include "raster/types.h"

namespace xrgs {
namespace XRGS_NS {

std::int64_t project(const GaussianParameters& parameters, const RenderConfig& config,
                     std::int64_t first, std::int64_t last, Frame& frame, std::uint64_t* sort_keys,
                     std::uint32_t* faults);
std::int64_t intersect_tiles(Frame& frame, std::int64_t* next, std::int64_t last,
                             TileIntersection* intersections, std::int64_t capacity,
                             std::uint32_t* tile_counts);
void composite(Frame& frame, int tile, float* image, float* alpha);
void composite_backward(const Frame& frame, int tile, const float* v_image, const float* v_alpha,
                        float* pair_grads);
bool project_backward(const GaussianParameters& parameters, const Frame& frame,
                      const float* pair_grads, std::int64_t first, std::int64_t last,
                      const ParameterGradients& gradients);

}  // namespace XRGS_NS
}  // namespace xrgs
