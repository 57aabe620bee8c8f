// The Python binding of the measurement of the processor's peak.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_bench(nanobind::module_& m);

}  // namespace xrgs
