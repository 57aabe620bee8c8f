// The Python module xrgs._native. The bindings of each family of kernels are in a separate file.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "activations/bind.h"
#include "densify/bind.h"
#include "isa.h"
#include "loss/bind.h"
#include "memory.h"
#include "optim/bind.h"
#include "output_arrays.h"
#include "raster/bind.h"
#include "raster/frame.h"
#include "resample/bind.h"
#include "simd/array_math.h"
#include "stereo/bind.h"

namespace nb = nanobind;

namespace {

using Vector = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

xrgs::Output exp2_array(Vector x) {
  xrgs::Output y = xrgs::new_array<float>({x.shape(0)});
  XRGS_SELECT(array_math_kernels).exp2(x.data(), static_cast<float*>(y.data()), x.size());
  return y;
}

xrgs::Output log2_array(Vector x) {
  xrgs::Output y = xrgs::new_array<float>({x.shape(0)});
  XRGS_SELECT(array_math_kernels).log2(x.data(), static_cast<float*>(y.data()), x.size());
  return y;
}

xrgs::Output sqrt_upper_bound_array(Vector x) {
  xrgs::Output y = xrgs::new_array<float>({x.shape(0)});
  XRGS_SELECT(array_math_kernels)
      .sqrt_upper_bound(x.data(), static_cast<float*>(y.data()), x.size());
  return y;
}

}  // namespace

NB_MODULE(_native, m) {
  using namespace xrgs;
  // torch keeps graphs, and so frames, alive beyond the end of the interpreter: no leak.
  nb::set_leak_warnings(false);
  m.doc() = "The compiled kernels of xrgs.";
  xrgs::active_isa();  // fails here, at the import, if XRGS_ISA is invalid
  m.def("isa", [] { return isa_name(active_isa()); }, "Return the instruction set in use.");
  m.def("set_isa", &set_isa, nb::arg("name"),
        "Use another instruction set from now on, in the whole process.");
  m.def("available_isas", &available_isas,
        "Return the instruction sets that this machine has, narrowest first.");
  m.def(
      "fused_multiply_add", [] { return XRGS_SELECT(array_math_kernels).fused_multiply_add; },
      "Return whether the instruction set in use has a fused multiply-add: all that have one give "
      "the same bits.");
  m.def("exp2", &exp2_array, nb::arg("x").noconvert(),
        "Return 2^x as the kernels compute it, float32 [N], for -126 <= x <= 127.");
  m.def("log2", &log2_array, nb::arg("x").noconvert(),
        "Return the base-2 logarithm as the kernels compute it, float32 [N], for x >= 2^-126.");
  m.def("sqrt_upper_bound", &sqrt_upper_bound_array, nb::arg("x").noconvert(),
        "Return a bound of the square root as the kernels compute it, float32 [N], for x >= 0.");
  m.def("unused_bytes", &unused_bytes,
        "Return the bytes of released tensors that are kept for the next ones.");
#ifdef XRGS_FAULT_INJECTION
  m.def("fail_allocation", &fail_allocation, nb::arg("number"),
        "Make the number-th allocation of this module from now on fail; 0 stands for none.");
  m.def("allocation_failed", &allocation_failed,
        "Return whether the allocation that was to fail was reached.");
  m.def("delete_unused_frames", &delete_unused_frames,
        "Free the frames and workspaces that wait to be used again.");
#endif
  bind_activations(m);
  bind_densify(m);
  bind_raster(m);
  bind_loss(m);
  bind_optim(m);
  bind_resample(m);
  bind_stereo(m);
}
