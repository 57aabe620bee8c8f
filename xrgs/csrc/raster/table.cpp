// The table of one instruction set's kernels.
#include "raster/kernels.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {

extern const RasterKernels raster_kernels{project, emit, composite, composite_backward,
                                          project_backward};

}  // namespace XRGS_NS
}  // namespace xrgs
