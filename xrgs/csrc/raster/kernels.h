// The rasterizer's kernels: one table for each instruction set. Each call is one task of a stage;
// tasks of a stage write to places of their own, so any order gives the same result.
#pragma once

#include <cstdint>

#include "isa.h"
#include "raster/types.h"

namespace xrgs {

struct Frame;

struct RasterKernels {
  // Project Gaussians first..last-1 (first a multiple of 16): records and bits of the visible ones,
  // their sort keys from `order` on; returns how many. Sets *good to false where a parameter that
  // was read is not finite or out of range (harmonics are read for visible Gaussians only).
  std::int64_t (*project)(const Parameters& parameters, const View& view, std::int64_t first,
                          std::int64_t last, Frame& frame, std::uint64_t* order, bool* good);

  // Emit the (tile, Gaussian) pairs of order[*next..last-1], counting them by tile and by Gaussian
  // (in frame.slots); returns how many. Stops where `room` (at least 16 pairs a tile) may not hold
  // more: *next says where.
  std::int64_t (*emit)(Frame& frame, std::int64_t* next, std::int64_t last, Pair* pairs,
                       std::int64_t room, std::uint32_t* tile_counts);

  // Composite one tile into image [H, W, 3] and alpha [H, W].
  void (*composite)(Frame& frame, int tile, float* image, float* alpha);

  // The sums of one tile's pairs into sums [pairs, kSlotSize].
  void (*composite_backward)(const Frame& frame, int tile, const float* image_gradient,
                             const float* alpha_gradient, float* sums);

  // The gradients of Gaussians first..last-1 from their pairs' sums.
  void (*project_backward)(const Parameters& parameters, const Frame& frame, const float* sums,
                           std::int64_t first, std::int64_t last, const Gradients& gradients);
};

XRGS_DECLARE_TABLE(RasterKernels, raster_kernels)

}  // namespace xrgs
