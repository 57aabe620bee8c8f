// xrgs._native.observe: a step's image-plane gradients into the sums that densification reads.
#include "densify/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

#include "densify/observe.h"
#include "pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Slope = nb::ndarray<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Visible = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Sum = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kBlock = 16384;  // Gaussians of a task

void observe(Slope slope, Visible visible, double scale_x, double scale_y, Sum gradient, Sum seen,
             int threads) {
  const std::size_t count = slope.shape(0);
  if (visible.shape(0) != count || gradient.shape(0) != count || seen.shape(0) != count)
    throw nb::value_error("observe: shapes that do not fit");
  static_assert(sizeof(bool) == 1);
  const Observation job{slope.data(),
                        reinterpret_cast<const std::uint8_t*>(visible.data()),
                        static_cast<float>(scale_x),
                        static_cast<float>(scale_y),
                        gradient.data(),
                        seen.data()};
  const ObserveKernels& kernels = XRGS_PICK(observe_kernels);
  const std::int64_t all = static_cast<std::int64_t>(count);
  nb::gil_scoped_release release;
  parallel_for(threads, (all + kBlock - 1) / kBlock, [&](std::int64_t task) {
    const std::int64_t first = task * kBlock;
    kernels.observe(job, first, first + kBlock < all ? first + kBlock : all);
  });
}

}  // namespace

void bind_densify(nb::module_& m) {
  m.def("observe", &observe, nb::arg("slope"), nb::arg("visible"), nb::arg("scale_x"),
        nb::arg("scale_y"), nb::arg("gradient"), nb::arg("seen"), nb::arg("threads"),
        "Where visible: gradient += |(slope_x scale_x, slope_y scale_y)| and seen += 1, in place.");
}

}  // namespace xrgs
