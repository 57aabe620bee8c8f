// xrgs._native.adam_step and adam_step_sh_rest: one step of Adam, each as one job of the thread
// pool.
#include "optim/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "optim/adam.h"
#include "raster/types.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Values = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using ShCoefficients = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Vectors = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

constexpr std::int64_t kValuesPerTask = 16384;   // in each of four arrays
constexpr std::int64_t kGaussiansPerTask = 512;  // a multiple of 16

struct AdamOptions {
  double beta1, beta2, eps;

  // A group with all constants set, computed in double as torch does.
  AdamGroup group(double lr, double step) const {
    AdamGroup g{};
    g.one_minus_beta1 = static_cast<float>(1 - beta1);
    g.beta2 = static_cast<float>(beta2), g.one_minus_beta2 = static_cast<float>(1 - beta2);
    g.step_size = static_cast<float>(lr / (1 - std::pow(beta1, step)));
    g.inv_sqrt_bias2 = static_cast<float>(1 / std::sqrt(1 - std::pow(beta2, step)));
    g.eps = static_cast<float>(eps);
    return g;
  }
};

// A tensor of a tuple. Nothing is converted, because the step would change the copy. Throws
// TypeError.
Values values_of(const nb::tuple& fields, std::size_t index, const char* name) {
  Values values;
  if (!nb::try_cast(fields[index], values, false))
    throw nb::type_error(("adam_step: " + std::string(name) +
                          " must be float32 [N], contiguous, on the CPU, without a graph")
                             .c_str());
  return values;
}

AdamGroup group_from_tuple(nb::handle tuple, const AdamOptions& options) {
  nb::tuple fields;
  if (!nb::try_cast(tuple, fields) || fields.size() != 6)
    throw nb::type_error(
        "adam_step: groups must be tuples (parameter, gradient, exp_avg, exp_avg_sq, lr, step)");
  const Values parameter = values_of(fields, 0, "parameter");
  const Values gradient = values_of(fields, 1, "gradient");
  const Values exp_avg = values_of(fields, 2, "exp_avg");
  const Values exp_avg_sq = values_of(fields, 3, "exp_avg_sq");
  for (const Values* other : {&gradient, &exp_avg, &exp_avg_sq})
    if (other->shape(0) != parameter.shape(0))
      throw nb::value_error(
          "adam_step: shapes that do not fit: a parameter, its gradient, exp_avg and exp_avg_sq "
          "must"
          " have the same number of elements");
  AdamGroup group = options.group(nb::cast<double>(fields[4]), nb::cast<double>(fields[5]));
  group.parameter = parameter.data(), group.gradient = gradient.data();
  group.exp_avg = exp_avg.data(), group.exp_avg_sq = exp_avg_sq.data();
  group.size = static_cast<std::int64_t>(parameter.shape(0));
  return group;
}

// The values of a group that one task updates.
struct GroupSlice {
  std::size_t group;
  std::int64_t first, last;
};

void adam_step(nb::list tuples, double beta1, double beta2, double eps, int threads) {
  std::vector<AdamGroup> groups;
  std::vector<GroupSlice> slices;
  for (nb::handle tuple : tuples) {
    const AdamGroup group = group_from_tuple(tuple, {beta1, beta2, eps});
    for (std::int64_t first = 0; first < group.size; first += kValuesPerTask)
      slices.push_back({groups.size(), first, std::min(first + kValuesPerTask, group.size)});
    groups.push_back(group);
  }
  nb::gil_scoped_release release;
  const AdamKernels& kernels = XRGS_SELECT(adam_kernels);
  parallel_for(threads, static_cast<std::int64_t>(slices.size()), [&](std::int64_t i) {
    const GroupSlice& slice = slices[static_cast<std::size_t>(i)];
    kernels.step(groups[slice.group], slice.first, slice.last);
  });
}

void adam_step_sh_rest(ShCoefficients parameter, ShCoefficients exp_avg, ShCoefficients exp_avg_sq,
                       Vectors means, Vectors sh0_gradient, std::array<float, 3> camera_position,
                       int sh_degree, double lr, double step, double beta1, double beta2,
                       double eps, int threads) {
  const std::size_t count = parameter.shape(0), rest_count = parameter.shape(1);
  if (means.shape(0) != count || sh0_gradient.shape(0) != count ||
      exp_avg.size() != parameter.size() || exp_avg_sq.size() != parameter.size())
    throw nb::value_error(
        "adam_step_sh_rest: shapes that do not fit: exp_avg and exp_avg_sq must have the shape of "
        "the"
        " parameter, means and sh0_gradient as many rows");
  if (sh_degree < 0 || sh_degree > kMaxShDegree ||
      static_cast<std::size_t>(rest_basis_count(sh_degree)) > rest_count ||
      rest_count > static_cast<std::size_t>(rest_basis_count(kMaxShDegree)))
    throw nb::value_error("adam_step_sh_rest: shN does not have the bands of sh_degree (0 to 3)");
  ShNAdamGroup group{};
  group.adam = AdamOptions{beta1, beta2, eps}.group(lr, step);
  group.adam.parameter = parameter.data(), group.adam.exp_avg = exp_avg.data();
  group.adam.exp_avg_sq = exp_avg_sq.data();
  group.means = means.data(), group.sh0_gradient = sh0_gradient.data();
  std::copy(camera_position.begin(), camera_position.end(), group.camera_position);
  group.rest_count = static_cast<int>(rest_count), group.sh_degree = sh_degree;
  nb::gil_scoped_release release;
  const AdamKernels& kernels = XRGS_SELECT(adam_kernels);
  const auto last = static_cast<std::int64_t>(count);
  parallel_for(threads, (last + kGaussiansPerTask - 1) / kGaussiansPerTask, [&](std::int64_t i) {
    kernels.step_shN(group, i * kGaussiansPerTask, std::min((i + 1) * kGaussiansPerTask, last));
  });
}

}  // namespace

void bind_optim(nb::module_& m) {
  m.def("adam_step", &adam_step, nb::arg("groups"), nb::arg("beta1"), nb::arg("beta2"),
        nb::arg("eps"), nb::arg("threads"),
        "Make one step of Adam in place.\n\n"
        "Each group is a tuple (parameter, gradient, exp_avg, exp_avg_sq, lr, step): four float32 "
        "[N],\n"
        "the learning rate, and the number of this step, from 1.");
  m.def("adam_step_sh_rest", &adam_step_sh_rest, nb::arg("parameter").noconvert(),
        nb::arg("exp_avg").noconvert(), nb::arg("exp_avg_sq").noconvert(),
        nb::arg("means").noconvert(), nb::arg("sh0_gradient").noconvert(),
        nb::arg("camera_position"), nb::arg("sh_degree"), nb::arg("lr"), nb::arg("step"),
        nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"), nb::arg("threads"),
        "Make one step of Adam on shN [N, K - 1, 3] in place.\n\n"
        "Its gradient is computed from sh0_gradient [N, 3]: times the basis functions in the "
        "direction\n"
        "from the camera to the means [N, 3], divided by that of degree 0.");
}

}  // namespace xrgs
