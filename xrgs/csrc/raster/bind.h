// The Python bindings of the rasterizer.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_raster(nanobind::module_& m);

}  // namespace xrgs
