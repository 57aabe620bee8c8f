// The Python bindings of the activation functions.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_activations(nanobind::module_& m);

}  // namespace xrgs
