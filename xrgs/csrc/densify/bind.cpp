// xrgs._native.accumulate_grad2d: adds the image-plane gradients of a step to the densification
// statistics.
#include "densify/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

#include "densify/grad2d.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Means2dGrad = nb::ndarray<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Visible = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Statistic = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kGaussiansPerTask = 16384;

void accumulate_grad2d(Means2dGrad means2d_grad, Visible visible, double scale_x, double scale_y,
                       Statistic grad2d_sum, Statistic visible_count, int threads) {
  const std::size_t count = means2d_grad.shape(0);
  if (visible.shape(0) != count || grad2d_sum.shape(0) != count || visible_count.shape(0) != count)
    throw nb::value_error(
        "accumulate_grad2d: shapes that do not fit: visible, grad2d_sum and visible_count must have"
        " one element for each row of means2d_grad");
  static_assert(sizeof(bool) == 1);
  const Grad2dJob job{
      means2d_grad.data(),         reinterpret_cast<const std::uint8_t*>(visible.data()),
      static_cast<float>(scale_x), static_cast<float>(scale_y),
      grad2d_sum.data(),           visible_count.data()};
  const Grad2dKernels& kernels = XRGS_SELECT(grad2d_kernels);
  const std::int64_t all = static_cast<std::int64_t>(count);
  nb::gil_scoped_release release;
  parallel_for(threads, (all + kGaussiansPerTask - 1) / kGaussiansPerTask, [&](std::int64_t task) {
    const std::int64_t first = task * kGaussiansPerTask;
    kernels.accumulate(job, first,
                       first + kGaussiansPerTask < all ? first + kGaussiansPerTask : all);
  });
}

}  // namespace

void bind_densify(nb::module_& m) {
  m.def("accumulate_grad2d", &accumulate_grad2d, nb::arg("means2d_grad").noconvert(),
        nb::arg("visible").noconvert(), nb::arg("scale_x"), nb::arg("scale_y"),
        nb::arg("grad2d_sum").noconvert(), nb::arg("visible_count").noconvert(), nb::arg("threads"),
        "Add to the densification statistics of the visible Gaussians, in place.\n\n"
        "grad2d_sum [N] += |(scale_x gx, scale_y gy)| of means2d_grad [N, 2]; visible_count [N] += "
        "1.");
}

}  // namespace xrgs
