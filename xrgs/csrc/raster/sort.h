// Sorting Gaussians by depth.
#pragma once

#include "raster/frame.h"

namespace xrgs {

// Sort frame.order[0..frame.seen-1] by its upper half, stably: equal depths stay by index.
void sort_by_depth(int threads, Frame& frame, Workspace& workspace);

}  // namespace xrgs
