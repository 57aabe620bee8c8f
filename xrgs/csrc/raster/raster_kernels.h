// The kernels of the rasterizer: one table of functions for each instruction set.
//
// Each call is a task of a stage. The tasks of a stage write to disjoint memory, so the result does
// not depend on their order or on the number of threads.
#pragma once

#include <cstdint>

#include "isa.h"
#include "raster/types.h"

namespace xrgs {

struct Frame;

struct RasterKernels {
  // Projects Gaussians first..last-1 (first is a multiple of 16). Writes frame.projected, visible,
  // color_derivatives and pair_ranges (zeros), and the depth sort keys of the visible Gaussians to
  // sort_keys. Sets bits of *faults if a parameter is not finite or out of range (shN is read only
  // for visible Gaussians). Returns the number of visible Gaussians.
  std::int64_t (*project)(const GaussianParameters& parameters, const RenderConfig& config,
                          std::int64_t first, std::int64_t last, Frame& frame,
                          std::uint64_t* sort_keys, std::uint32_t* faults);

  // Writes the (tile, Gaussian) pairs of frame.order[*next..last-1] to `intersections`, adds the
  // number of pairs of each tile to tile_counts, and stores that of each Gaussian in
  // frame.pair_ranges. Stops before the next sixteen Gaussians could exceed `capacity` (at least 16
  // pairs for each tile), and sets *next to the first remaining Gaussian. Returns the number of
  // pairs.
  std::int64_t (*intersect_tiles)(Frame& frame, std::int64_t* next, std::int64_t last,
                                  TileIntersection* intersections, std::int64_t capacity,
                                  std::uint32_t* tile_counts);

  // Composites one tile into image [H, W, 3] and alpha [H, W], and saves its batches in the frame.
  void (*composite)(Frame& frame, int tile, float* image, float* alpha);

  // Writes the rows of pair_grads [pairs, kPairGradStride] of one tile, from the gradients of image
  // [H, W, 3] and alpha [H, W].
  void (*composite_backward)(const Frame& frame, int tile, const float* v_image,
                             const float* v_alpha, float* pair_grads);

  // Writes the parameter gradients of Gaussians first..last-1 (first is a multiple of 16), zeros
  // for Gaussians that are not visible. Returns whether all gradients are finite.
  bool (*project_backward)(const GaussianParameters& parameters, const Frame& frame,
                           const float* pair_grads, std::int64_t first, std::int64_t last,
                           const ParameterGradients& gradients);
};

XRGS_DECLARE_TABLE(RasterKernels, raster_kernels)

}  // namespace xrgs
