// xrgs._native.adam_step: one step of Adam on all parameters.
#include "optim/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "optim/adam.h"
#include "raster/types.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Values = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ShCoefficients = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Vectors = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using ShGradient = nb::ndarray<const float, nb::shape<-1, 1, 3>, nb::c_contig, nb::device::cpu>;

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

// Returns a tensor of a tuple, without conversion, because the step would update the converted
// copy. Throws TypeError.
template <class Array>
Array tensor_of(const nb::tuple& fields, std::size_t index, const char* name) {
  Array values;
  if (!nb::try_cast(fields[index], values, false))
    throw nb::type_error(("adam_step: " + std::string(name) +
                          " must be float32 of its shape, contiguous, on the CPU, without a graph")
                             .c_str());
  return values;
}

nb::tuple fields_of(nb::handle tuple, std::size_t count, const char* expected) {
  nb::tuple fields;
  if (!nb::try_cast(tuple, fields) || fields.size() != count)
    throw nb::type_error(("adam_step: " + std::string(expected)).c_str());
  return fields;
}

AdamGroup group_from_tuple(nb::handle tuple, const AdamOptions& options) {
  const nb::tuple fields = fields_of(
      tuple, 6, "groups must be tuples (parameter, gradient, exp_avg, exp_avg_sq, lr, step)");
  const auto parameter = tensor_of<Values>(fields, 0, "parameter");
  const auto gradient = tensor_of<Values>(fields, 1, "gradient");
  const auto exp_avg = tensor_of<Values>(fields, 2, "exp_avg");
  const auto exp_avg_sq = tensor_of<Values>(fields, 3, "exp_avg_sq");
  for (const Values* other : {&gradient, &exp_avg, &exp_avg_sq})
    if (other->size() != parameter.size())
      throw nb::value_error(
          "adam_step: shapes that do not fit: a parameter, its gradient, exp_avg and exp_avg_sq "
          "must"
          " have the same number of elements");
  AdamGroup group = options.group(nb::cast<double>(fields[4]), nb::cast<double>(fields[5]));
  group.parameter = parameter.data(), group.gradient = gradient.data();
  group.exp_avg = exp_avg.data(), group.exp_avg_sq = exp_avg_sq.data();
  group.size = static_cast<std::int64_t>(parameter.size());
  return group;
}

ShNAdamGroup harmonics_from_tuple(nb::handle tuple, const AdamOptions& options) {
  const nb::tuple fields =
      fields_of(tuple, 9,
                "harmonics must be a tuple (shN, exp_avg, exp_avg_sq, means, sh0_gradient, "
                "camera_position, sh_degree, lr, step)");
  const auto parameter = tensor_of<ShCoefficients>(fields, 0, "shN");
  const auto exp_avg = tensor_of<ShCoefficients>(fields, 1, "exp_avg");
  const auto exp_avg_sq = tensor_of<ShCoefficients>(fields, 2, "exp_avg_sq");
  const auto means = tensor_of<Vectors>(fields, 3, "means");
  const auto sh0_gradient = tensor_of<ShGradient>(fields, 4, "sh0_gradient");
  const auto camera_position = nb::cast<std::array<float, 3>>(fields[5]);
  const int sh_degree = nb::cast<int>(fields[6]);
  const std::size_t count = parameter.shape(0), rest_count = parameter.shape(1);
  if (means.shape(0) != count || sh0_gradient.shape(0) != count ||
      exp_avg.size() != parameter.size() || exp_avg_sq.size() != parameter.size())
    throw nb::value_error(
        "adam_step: shapes that do not fit: exp_avg and exp_avg_sq must have the shape of shN, "
        "means and sh0_gradient as many rows");
  if (sh_degree < 0 || sh_degree > kMaxShDegree ||
      static_cast<std::size_t>(rest_basis_count(sh_degree)) > rest_count ||
      rest_count > static_cast<std::size_t>(rest_basis_count(kMaxShDegree)))
    throw nb::value_error("adam_step: shN does not have the bands of sh_degree (0 to 3)");
  ShNAdamGroup group{};
  group.adam = options.group(nb::cast<double>(fields[7]), nb::cast<double>(fields[8]));
  group.adam.parameter = parameter.data(), group.adam.exp_avg = exp_avg.data();
  group.adam.exp_avg_sq = exp_avg_sq.data();
  group.adam.size = static_cast<std::int64_t>(parameter.size());
  group.means = means.data(), group.sh0_gradient = sh0_gradient.data();
  std::copy(camera_position.begin(), camera_position.end(), group.camera_position);
  group.rest_count = static_cast<int>(rest_count), group.sh_degree = sh_degree;
  group.count = static_cast<std::int64_t>(count);
  return group;
}

// The values of a group that one task updates.
struct GroupSlice {
  std::size_t group;
  std::int64_t first, last;
};

void adam_step(nb::list tuples, double beta1, double beta2, double eps, int threads,
               std::optional<nb::tuple> harmonics) {
  const AdamOptions options{beta1, beta2, eps};
  std::vector<AdamGroup> groups;
  std::vector<GroupSlice> slices;
  for (nb::handle tuple : tuples) {
    const AdamGroup group = group_from_tuple(tuple, options);
    for (std::int64_t first = 0; first < group.size; first += kValuesPerTask)
      slices.push_back({groups.size(), first, std::min(first + kValuesPerTask, group.size)});
    groups.push_back(group);
  }
  ShNAdamGroup shN{};
  if (harmonics) shN = harmonics_from_tuple(*harmonics, options);
  nb::gil_scoped_release release;
  const AdamKernels& kernels = XRGS_SELECT(adam_kernels);
  // shN first, before the means move: its gradient needs the means that were rendered.
  const std::int64_t tasks = (shN.count + kGaussiansPerTask - 1) / kGaussiansPerTask;
  parallel_for(threads, tasks, [&](std::int64_t i) {
    const std::int64_t first = i * kGaussiansPerTask;
    kernels.step_shN(shN, first, std::min(first + kGaussiansPerTask, shN.count));
  });
  parallel_for(threads, static_cast<std::int64_t>(slices.size()), [&](std::int64_t i) {
    const GroupSlice& slice = slices[static_cast<std::size_t>(i)];
    kernels.step(groups[slice.group], slice.first, slice.last);
  });
}

}  // namespace

void bind_optim(nb::module_& m) {
  m.def("adam_step", &adam_step, nb::arg("groups"), nb::arg("beta1"), nb::arg("beta2"),
        nb::arg("eps"), nb::arg("threads"), nb::arg("harmonics") = nb::none(),
        "Make one step of Adam in place.\n\n"
        "Each group is a tuple (parameter, gradient, exp_avg, exp_avg_sq, lr, step): four float32\n"
        "tensors of one shape, the learning rate, and the number of this step, from 1.\n"
        "harmonics is a tuple (shN [N, K - 1, 3], exp_avg, exp_avg_sq, means [N, 3],\n"
        "sh0_gradient [N, 1, 3], camera_position, sh_degree, lr, step): the gradient of shN is\n"
        "sh0_gradient times the basis functions in the direction from the camera to the means,\n"
        "which may be in a group as well, divided by that of degree 0.");
}

}  // namespace xrgs
