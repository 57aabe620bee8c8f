// The face of densification's bookkeeping in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_densify(nanobind::module_& m);

}  // namespace xrgs
