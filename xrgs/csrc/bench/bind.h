// The benchmark's yardstick in Python.
#pragma once

#include <nanobind/nanobind.h>

namespace xrgs {

void bind_bench(nanobind::module_& m);

}  // namespace xrgs
