// The Python binding of the densification statistics.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_densify(nanobind::module_& m);

}  // namespace xrgs
