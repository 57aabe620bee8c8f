// The face of the optimizer in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_optim(nanobind::module_& m);

}  // namespace xrgs
