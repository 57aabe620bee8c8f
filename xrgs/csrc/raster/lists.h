// Binning, second half: from pairs in depth order to a list for each tile.
#pragma once

#include "raster/frame.h"
#include "raster/kernels.h"

namespace xrgs {

// Fills frame.entries, tile_begin, batch_begin and slots. Throws std::bad_alloc.
void make_lists(int threads, const RasterKernels& kernels, Frame& frame, Workspace& workspace);

}  // namespace xrgs
