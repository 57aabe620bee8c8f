// xrgs._native.adam: one step over several parameters, in one job of the pool.
#include "optim/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "optim/adam.h"
#include "pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Values = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kPiece = 16384;  // floats of a task, in each of four arrays

// A group and the constants that the kernel wants, in double as torch has them.
AdamGroup group_of(nb::handle entry, double beta1, double beta2, double eps) {
  const auto fields = nb::cast<nb::tuple>(entry);
  const auto parameter = nb::cast<Values>(fields[0]), gradient = nb::cast<Values>(fields[1]);
  const auto mean = nb::cast<Values>(fields[2]), square = nb::cast<Values>(fields[3]);
  for (const Values* other : {&gradient, &mean, &square})
    if (other->shape(0) != parameter.shape(0))
      throw nb::value_error("adam: shapes that do not fit");
  const double lr = nb::cast<double>(fields[4]), step = nb::cast<double>(fields[5]);
  AdamGroup group{};
  group.parameter = parameter.data(), group.gradient = gradient.data();
  group.mean = mean.data(), group.square = square.data();
  group.size = static_cast<std::int64_t>(parameter.shape(0));
  group.keep1 = static_cast<float>(1 - beta1);
  group.beta2 = static_cast<float>(beta2), group.keep2 = static_cast<float>(1 - beta2);
  group.rate = static_cast<float>(lr / (1 - std::pow(beta1, step)));
  group.inv_root = static_cast<float>(1 / std::sqrt(1 - std::pow(beta2, step)));
  group.eps = static_cast<float>(eps);
  return group;
}

struct Piece {
  std::size_t group;
  std::int64_t first, last;
};

void adam(nb::list entries, double beta1, double beta2, double eps, int threads) {
  std::vector<AdamGroup> groups;
  std::vector<Piece> pieces;
  for (nb::handle entry : entries) {
    const AdamGroup group = group_of(entry, beta1, beta2, eps);
    for (std::int64_t first = 0; first < group.size; first += kPiece)
      pieces.push_back({groups.size(), first, std::min(first + kPiece, group.size)});
    groups.push_back(group);
  }
  nb::gil_scoped_release release;
  const AdamKernels& kernels = XRGS_PICK(adam_kernels);
  parallel_for(threads, static_cast<std::int64_t>(pieces.size()), [&](std::int64_t i) {
    const Piece& piece = pieces[static_cast<std::size_t>(i)];
    kernels.step(groups[piece.group], piece.first, piece.last);
  });
}

}  // namespace

void bind_optim(nb::module_& m) {
  m.def("adam", &adam, nb::arg("groups"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"),
        nb::arg("threads"),
        "One step of Adam in place. Each group is (parameter, gradient, exp_avg, exp_avg_sq, lr,\n"
        "step): four float32 [N], the rate, and the number of this step, from 1.");
}

}  // namespace xrgs
