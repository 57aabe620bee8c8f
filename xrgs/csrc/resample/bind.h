// The Python binding of the resampling of images.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_resample(nanobind::module_& m);

}  // namespace xrgs
