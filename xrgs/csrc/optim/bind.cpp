// xrgs._native.adam: one step over several parameters, in one job of the pool.
#include "optim/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "optim/adam.h"
#include "pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Values = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Harmonics = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Vectors = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kPiece = 16384;  // floats of a task, in each of four arrays

// The constants that the kernel wants, in double as torch has them.
struct Betas {
  double beta1, beta2, eps;

  AdamGroup constants(double lr, double step) const {
    AdamGroup g{};
    g.keep1 = static_cast<float>(1 - beta1);
    g.beta2 = static_cast<float>(beta2), g.keep2 = static_cast<float>(1 - beta2);
    g.rate = static_cast<float>(lr / (1 - std::pow(beta1, step)));
    g.inv_root = static_cast<float>(1 / std::sqrt(1 - std::pow(beta2, step)));
    g.eps = static_cast<float>(eps);
    return g;
  }
};

AdamGroup group_of(nb::handle entry, const Betas& betas) {
  const auto fields = nb::cast<nb::tuple>(entry);
  const auto parameter = nb::cast<Values>(fields[0]), gradient = nb::cast<Values>(fields[1]);
  const auto mean = nb::cast<Values>(fields[2]), square = nb::cast<Values>(fields[3]);
  for (const Values* other : {&gradient, &mean, &square})
    if (other->shape(0) != parameter.shape(0))
      throw nb::value_error("adam: shapes that do not fit");
  AdamGroup group = betas.constants(nb::cast<double>(fields[4]), nb::cast<double>(fields[5]));
  group.parameter = parameter.data(), group.gradient = gradient.data();
  group.mean = mean.data(), group.square = square.data();
  group.size = static_cast<std::int64_t>(parameter.shape(0));
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
    const AdamGroup group = group_of(entry, {beta1, beta2, eps});
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

constexpr std::int64_t kGaussians = 512;  // of a task; a multiple of 16

void adam_harmonics(Harmonics parameter, Harmonics mean, Harmonics square, Vectors means,
                    Vectors sh0_gradient, std::array<float, 3> position, int degree, double lr,
                    double step, double beta1, double beta2, double eps, int threads) {
  const std::size_t count = parameter.shape(0), rest = parameter.shape(1);
  if (means.shape(0) != count || sh0_gradient.shape(0) != count ||
      mean.size() != parameter.size() || square.size() != parameter.size())
    throw nb::value_error("adam_harmonics: shapes that do not fit");
  if (degree < 0 || degree > 3 || (degree + 1) * (degree + 1) - 1 > static_cast<int>(rest) ||
      rest > 15)
    throw nb::value_error("adam_harmonics: shN does not have the bands of sh_degree");
  HarmonicsGroup group{};
  group.adam = Betas{beta1, beta2, eps}.constants(lr, step);
  group.adam.parameter = parameter.data(), group.adam.mean = mean.data();
  group.adam.square = square.data();
  group.means = means.data(), group.sh0_gradient = sh0_gradient.data();
  std::copy(position.begin(), position.end(), group.position);
  group.rest = static_cast<int>(rest), group.degree = degree;
  nb::gil_scoped_release release;
  const AdamKernels& kernels = XRGS_PICK(adam_kernels);
  const auto last = static_cast<std::int64_t>(count);
  parallel_for(threads, (last + kGaussians - 1) / kGaussians, [&](std::int64_t i) {
    kernels.step_harmonics(group, i * kGaussians, std::min((i + 1) * kGaussians, last));
  });
}

}  // namespace

void bind_optim(nb::module_& m) {
  m.def("adam", &adam, nb::arg("groups"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"),
        nb::arg("threads"),
        "One step of Adam in place. Each group is (parameter, gradient, exp_avg, exp_avg_sq, lr,\n"
        "step): four float32 [N], the rate, and the number of this step, from 1.");
  m.def(
      "adam_harmonics", &adam_harmonics, nb::arg("parameter"), nb::arg("mean"), nb::arg("square"),
      nb::arg("means"), nb::arg("sh0_gradient"), nb::arg("position"), nb::arg("degree"),
      nb::arg("lr"), nb::arg("step"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"),
      nb::arg("threads"),
      "The same for shN [N, K - 1, 3], its gradient made of sh0's [N, 3]: times the basis in the\n"
      "direction from the camera's position to the means, over that of band 0.");
}

}  // namespace xrgs
