// xrgs._native.exp and logistic, the activation functions of raw parameters, and their gradients.
#include "activations/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

#include "activations/activations.h"
#include "output_arrays.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Vector = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kValuesPerTask = 32768;

// Divides 0..count-1 into ranges, and calls body(first, last) for each of them.
template <class Body>
void parallel_ranges(int threads, std::int64_t count, Body&& body) {
  nb::gil_scoped_release release;
  parallel_for(threads, (count + kValuesPerTask - 1) / kValuesPerTask, [&](std::int64_t task) {
    const std::int64_t first = task * kValuesPerTask;
    body(first, first + kValuesPerTask < count ? first + kValuesPerTask : count);
  });
}

using Forward = decltype(ActivationKernels::exp);
using Backward = decltype(ActivationKernels::exp_backward);

template <Forward ActivationKernels::* Kernel>
Output forward(Vector x, int threads) {
  Output y = new_array<float>({x.shape(0)});
  float* out = static_cast<float*>(y.data());
  const Forward kernel = XRGS_SELECT(activation_kernels).*Kernel;
  parallel_ranges(
      threads, static_cast<std::int64_t>(x.shape(0)),
      [&](std::int64_t first, std::int64_t last) { kernel(x.data(), out, first, last); });
  return y;
}

template <Backward ActivationKernels::* Kernel>
Output backward(Vector v_y, Vector y, int threads) {
  if (v_y.shape(0) != y.shape(0))
    throw nb::value_error("shapes that do not fit: v_y and y must have the same length");
  Output v_x = new_array<float>({y.shape(0)});
  float* out = static_cast<float*>(v_x.data());
  const Backward kernel = XRGS_SELECT(activation_kernels).*Kernel;
  parallel_ranges(threads, static_cast<std::int64_t>(y.shape(0)),
                  [&](std::int64_t first, std::int64_t last) {
                    kernel(v_y.data(), y.data(), out, first, last);
                  });
  return v_x;
}

}  // namespace

void bind_activations(nb::module_& m) {
  m.def("exp", &forward<&ActivationKernels::exp>, nb::arg("x").noconvert(), nb::arg("threads"),
        "Return e^x, float32 [N]; 0 where it is below 2^-126.");
  m.def("exp_backward", &backward<&ActivationKernels::exp_backward>, nb::arg("v_y").noconvert(),
        nb::arg("y").noconvert(), nb::arg("threads"),
        "Return the gradient by x of y = exp(x), v_y y, float32 [N].");
  m.def("logistic", &forward<&ActivationKernels::logistic>, nb::arg("x").noconvert(),
        nb::arg("threads"), "Return 1 / (1 + e^-x), float32 [N]; 0 where it is below 2^-126.");
  m.def("logistic_backward", &backward<&ActivationKernels::logistic_backward>,
        nb::arg("v_y").noconvert(), nb::arg("y").noconvert(), nb::arg("threads"),
        "Return the gradient by x of y = logistic(x), v_y y (1 - y), float32 [N].");
}

}  // namespace xrgs
