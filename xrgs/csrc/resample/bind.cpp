// xrgs._native.resample: multiplies an image by two banded matrices.
#include "resample/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <limits>

#include "output_arrays.h"
#include "resample/resample.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using First = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr int kRowsPerTask = 16;

BandedMatrix checked(const First& first, const Weights& weights, std::size_t size) {
  const std::size_t count = first.shape(0), taps = weights.shape(1);
  if (weights.shape(0) != count || taps < 1 || taps > size)
    throw nb::value_error(
        "resample: weights that do not fit: they must be [count, taps] with 1 <= taps <= the size "
        "of the image");
  for (std::size_t i = 0; i < count; ++i)
    if (first.data()[i] < 0 || first.data()[i] + taps > size)
      throw nb::value_error(
          "resample: a band reaches out of the image: first + taps exceeds its size");
  return {first.data(), weights.data(), static_cast<int>(count), static_cast<int>(taps)};
}

void resample_down(const BandedMatrix& rows, const float* in, std::size_t columns, float* out,
                   int threads) {
  const ResampleKernels& kernels = XRGS_SELECT(resample_kernels);
  parallel_for(threads, (rows.count + kRowsPerTask - 1) / kRowsPerTask, [&](std::int64_t task) {
    const int first = static_cast<int>(task) * kRowsPerTask;
    const int last = first + kRowsPerTask < rows.count ? first + kRowsPerTask : rows.count;
    kernels.down(rows, in, columns, first, last, out);
  });
}

void resample_across(const BandedMatrix& columns, const float* in, int height, int width,
                     float* out, int threads) {
  const ResampleKernels& kernels = XRGS_SELECT(resample_kernels);
  const int tasks = (height + kRowsPerTask - 1) / kRowsPerTask;
  const std::size_t size = kernels.scratch_size(width);
  const OwnedBlock scratch = acquire_block(tasks * size * sizeof(float));
  parallel_for(threads, tasks, [&](std::int64_t task) {
    const int first = static_cast<int>(task) * kRowsPerTask;
    const int rows = height - first < kRowsPerTask ? height - first : kRowsPerTask;
    kernels.across(columns, in + static_cast<std::size_t>(3) * first * width, width, rows,
                   out + static_cast<std::size_t>(3) * first * columns.count,
                   static_cast<float*>(scratch->data) + task * size);
  });
}

Output resample(Image image, First row_first, Weights row_weights, First column_first,
                Weights column_weights, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  constexpr std::size_t most = std::numeric_limits<int>::max() / 64;
  if (height > most || width > most || row_first.shape(0) > most || column_first.shape(0) > most)
    throw nb::value_error("resample: an image of more than 33 million rows or columns");
  const BandedMatrix rows = checked(row_first, row_weights, height);
  const BandedMatrix columns = checked(column_first, column_weights, width);
  const std::size_t new_height = rows.count, new_width = columns.count;
  Output out = new_array<float>({new_height, new_width, 3});
  float* to = static_cast<float*>(out.data());
  nb::gil_scoped_release release;
  // The pass along the rows runs when the image has fewer rows: before or after the other pass.
  if (new_height <= height) {
    const OwnedBlock intermediate = acquire_block(3 * new_height * width * sizeof(float));
    float* between = static_cast<float*>(intermediate->data);
    resample_down(rows, image.data(), 3 * width, between, threads);
    resample_across(columns, between, rows.count, static_cast<int>(width), to, threads);
  } else {
    const OwnedBlock intermediate = acquire_block(3 * height * new_width * sizeof(float));
    float* between = static_cast<float*>(intermediate->data);
    resample_across(columns, image.data(), static_cast<int>(height), static_cast<int>(width),
                    between, threads);
    resample_down(rows, between, 3 * new_width, to, threads);
  }
  return out;
}

}  // namespace

void bind_resample(nb::module_& m) {
  m.def("resample", &resample, nb::arg("image").noconvert(), nb::arg("row_first").noconvert(),
        nb::arg("row_weights").noconvert(), nb::arg("column_first").noconvert(),
        nb::arg("column_weights").noconvert(), nb::arg("threads"),
        "Multiply an image [H, W, 3] by a banded matrix down and another across: [h, w, 3].\n\n"
        "Output i is the sum over t of weights[i, t] times input first[i] + t.");
}

}  // namespace xrgs
