// The Python bindings of the optimizer.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_optim(nanobind::module_& m);

}  // namespace xrgs
