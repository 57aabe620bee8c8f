// Builds the list of Gaussians of each tile, front to back.
#pragma once

#include "raster/frame.h"
#include "raster/raster_kernels.h"

namespace xrgs {

// Intersects the Gaussians of frame.order with the tiles, and fills frame.entries, tile_offsets,
// batch_offsets and pair_ranges. Throws std::bad_alloc.
void build_tile_lists(int threads, const RasterKernels& kernels, Frame& frame,
                      Workspace& workspace);

}  // namespace xrgs
