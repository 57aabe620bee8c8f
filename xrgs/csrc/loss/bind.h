// The Python binding of the photometric loss.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_loss(nanobind::module_& m);

}  // namespace xrgs
