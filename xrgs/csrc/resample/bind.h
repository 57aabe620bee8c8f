// The face of resampling in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_resample(nanobind::module_& m);

}  // namespace xrgs
