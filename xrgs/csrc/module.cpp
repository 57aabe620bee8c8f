// The Python module xrgs._native. Each family of kernels binds itself in a file of its own.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "arrays.h"
#include "bench/bind.h"
#include "densify/bind.h"
#include "isa.h"
#include "loss/bind.h"
#include "optim/bind.h"
#include "raster/bind.h"
#include "resample/bind.h"
#include "vector_math_kernels.h"

namespace nb = nanobind;

namespace {

using Vector = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

xrgs::Output exp2_of(Vector x) {
  xrgs::Output y = xrgs::new_array<float>({x.shape(0)});
  XRGS_PICK(vector_math_kernels).exp2(x.data(), static_cast<float*>(y.data()), x.size());
  return y;
}

xrgs::Output log2_of(Vector x) {
  xrgs::Output y = xrgs::new_array<float>({x.shape(0)});
  XRGS_PICK(vector_math_kernels).log2(x.data(), static_cast<float*>(y.data()), x.size());
  return y;
}

}  // namespace

NB_MODULE(_native, m) {
  using namespace xrgs;
  // torch keeps graphs alive past the end of the interpreter, and with them frames.
  nb::set_leak_warnings(false);
  m.doc() = "The compiled kernels of xrgs.";
  xrgs::active_isa();  // a wrong XRGS_ISA fails here, at the import
  m.def("isa", [] { return isa_name(active_isa()); }, "The instruction set in use.");
  m.def("set_isa", &set_isa, nb::arg("name"), "Use another instruction set from now on.");
  m.def("available_isas", &available_isas, "What this machine can run, narrowest first.");
  m.def("exp2", &exp2_of, nb::arg("x"), "2^x, float32 [N], by the kernels' polynomial.");
  m.def("log2", &log2_of, nb::arg("x"), "Base-2 logarithm, float32 [N], by the kernels' series.");
  bind_densify(m);
  bind_raster(m);
  bind_loss(m);
  bind_optim(m);
  bind_resample(m);
  bind_bench(m);
}
