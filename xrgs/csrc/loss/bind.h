// The face of the photometric loss in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_loss(nanobind::module_& m);

}  // namespace xrgs
