// The table of the rasterizer's kernels for one instruction set.
#include "raster/raster_kernels.h"

#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {

extern const RasterKernels raster_kernels{project, intersect_tiles, composite, composite_backward,
                                          project_backward};

}  // namespace XRGS_NS
}  // namespace xrgs
