// The Python bindings of the plane sweep of a dense start.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_stereo(nanobind::module_& m);

}  // namespace xrgs
