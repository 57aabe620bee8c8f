// Sorts the visible Gaussians by depth.
#pragma once

#include "raster/frame.h"

namespace xrgs {

// Sorts frame.order[0..frame.visible_count-1] by the depth key in the upper 32 bits. The sort is
// stable: Gaussians of equal depth keep the order of their indices.
void sort_by_depth(int threads, Frame& frame, Workspace& workspace);

}  // namespace xrgs
