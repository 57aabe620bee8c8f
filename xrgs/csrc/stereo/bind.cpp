// xrgs._native.plane_sweep_costs and .semiglobal_sums: a dense start's plane sweep. Both compute in
// the caller's thread.
#include "stereo/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "output_arrays.h"
#include "stereo/stereo.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Image = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Volume = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const float, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Used = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using OutVolume = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

template <class Array>
bool has_shape(const Array& array, std::size_t first, std::size_t second) {
  return array.shape(0) == first && array.shape(1) == second;
}

// Returns the arrays of a list, without conversion. nanobind's own conversion to a vector ends the
// process where memory runs out. Throws TypeError.
template <class Array>
std::vector<Array> arrays_of(const nb::list& list, const char* name) {
  std::vector<Array> arrays(list.size());
  for (std::size_t i = 0; i < arrays.size(); ++i)
    if (!nb::try_cast(list[i], arrays[i], false))
      throw nb::type_error(("plane_sweep_costs: each of " + std::string(name) +
                            " must be of its type and dimensions, contiguous, on the CPU")
                               .c_str());
  return arrays;
}

void plane_sweep_costs(const nb::list& window_list, const nb::list& a_list, const nb::list& b_list,
                       const nb::list& image_list, const nb::list& used_list,
                       Volume inverse_depths, int best, float noise, float nearest,
                       OutVolume costs) {
  const std::vector<Image> windows = arrays_of<Image>(window_list, "windows");
  const std::vector<Volume> a = arrays_of<Volume>(a_list, "a");
  const std::vector<Vector> b = arrays_of<Vector>(b_list, "b");
  const std::vector<Image> images = arrays_of<Image>(image_list, "images");
  const std::vector<Used> used = arrays_of<Used>(used_list, "used");
  const std::size_t count = a.size();
  if (windows.size() != 4 || count < 1 || b.size() != count || images.size() != count ||
      used.size() != count || best < 1)
    throw nb::value_error(
        "plane_sweep_costs: four images of the windows, and a, b, image and mask of each other "
        "view are needed");
  const std::size_t height = windows[0].shape(0), width = windows[0].shape(1);
  constexpr std::size_t most = std::numeric_limits<int>::max() / 64;
  for (const Image& image : windows)
    if (!has_shape(image, height, width) || height < 1 || width < 1 || height > most ||
        width > most)
      throw nb::value_error("plane_sweep_costs: windows whose shapes differ");
  const std::size_t planes = costs.shape(0);
  const bool per_pixel = inverse_depths.shape(1) == height && inverse_depths.shape(2) == width;
  const bool alike = inverse_depths.shape(1) == 1 && inverse_depths.shape(2) == 1;
  if (inverse_depths.shape(0) != planes || !(per_pixel || alike) || costs.shape(1) != height ||
      costs.shape(2) != width)
    throw nb::value_error(
        "plane_sweep_costs: inverse depths must be [D, 1, 1] or [D, h, w], and costs [D, h, w]");
  static_assert(sizeof(bool) == 1);
  std::vector<OtherView> others;
  for (std::size_t k = 0; k < count; ++k) {
    const std::size_t rows = images[k].shape(0), columns = images[k].shape(1);
    if (a[k].shape(0) != 3 || a[k].shape(1) != height || a[k].shape(2) != width || rows < 2 ||
        columns < 2 || rows > most || columns > most)
      throw nb::value_error(
          "plane_sweep_costs: a must be [3, h, w], and an image at least 1 px with a row and a "
          "column more");
    const bool masked = used[k].size() > 0;
    if (masked && !has_shape(used[k], rows - 1, columns - 1))
      throw nb::value_error("plane_sweep_costs: a mask of another size than its image");
    others.push_back({a[k].data(),
                      {b[k].data()[0], b[k].data()[1], b[k].data()[2]},
                      images[k].data(),
                      masked ? reinterpret_cast<const std::uint8_t*>(used[k].data()) : nullptr,
                      static_cast<int>(rows - 1),
                      static_cast<int>(columns - 1)});
  }
  const CostJob job{windows[0].data(),
                    windows[1].data(),
                    windows[2].data(),
                    windows[3].data(),
                    static_cast<int>(height),
                    static_cast<int>(width),
                    inverse_depths.data(),
                    per_pixel,
                    others.data(),
                    static_cast<int>(count),
                    best,
                    noise,
                    nearest,
                    costs.data()};
  const StereoKernels& kernels = XRGS_SELECT(stereo_kernels);
  nb::gil_scoped_release release;
  const OwnedBlock scratch = acquire_block(kernels.costs_scratch(job) * sizeof(float));
  for (std::size_t plane = 0; plane < planes; ++plane)
    kernels.costs(job, static_cast<int>(plane), static_cast<float*>(scratch->data));
}

void semiglobal_sums(Volume costs, float jump, float step, OutVolume sums) {
  const std::size_t n = costs.shape(0), planes = costs.shape(1), m = costs.shape(2);
  if (sums.shape(0) != n || sums.shape(1) != planes || sums.shape(2) != m || costs.size() == 0)
    throw nb::value_error("semiglobal_sums: costs and sums must have one shape, without a zero");
  nb::gil_scoped_release release;
  const OwnedBlock scratch = acquire_block(2 * planes * m * sizeof(float));
  XRGS_SELECT(stereo_kernels)
      .sum_along(costs.data(), n, planes, m, jump, step, sums.data(),
                 static_cast<float*>(scratch->data));
}

}  // namespace

void bind_stereo(nb::module_& m) {
  m.def("plane_sweep_costs", &plane_sweep_costs, nb::arg("windows"), nb::arg("a"), nb::arg("b"),
        nb::arg("images"), nb::arg("used"), nb::arg("inverse_depths").noconvert(), nb::arg("best"),
        nb::arg("noise"), nb::arg("nearest"), nb::arg("costs").noconvert(),
        "Write how badly each pixel fits other views at each inverse depth: costs [D, h, w].");
  m.def("semiglobal_sums", &semiglobal_sums, nb::arg("costs").noconvert(), nb::arg("jump"),
        nb::arg("step"), nb::arg("sums").noconvert(),
        "Write the costs [n, D, m] summed up along the first axis, forward and backward.");
}

}  // namespace xrgs
