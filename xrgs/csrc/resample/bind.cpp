// xrgs._native.resample: an image by two banded matrices.
#include "resample/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <limits>
#include <memory>

#include "arrays.h"
#include "pool.h"
#include "resample/resample.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using First = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Scratch = std::unique_ptr<void, GiveBlock>;

constexpr int kRows = 16;  // of a task

Bands checked(const First& first, const Weights& weights, std::size_t old) {
  const std::size_t count = first.shape(0), taps = weights.shape(1);
  if (weights.shape(0) != count || taps < 1 || taps > old)
    throw nb::value_error("resample: weights that do not fit");
  for (std::size_t i = 0; i < count; ++i)
    if (first.data()[i] < 0 || first.data()[i] + taps > old)
      throw nb::value_error("resample: a band reaches out of the image");
  return {first.data(), weights.data(), static_cast<int>(count), static_cast<int>(taps)};
}

void run_down(const Bands& rows, const float* in, std::size_t columns, float* out, int threads) {
  const ResampleKernels& kernels = XRGS_PICK(resample_kernels);
  parallel_for(threads, (rows.count + kRows - 1) / kRows, [&](std::int64_t task) {
    const int first = static_cast<int>(task) * kRows;
    const int last = first + kRows < rows.count ? first + kRows : rows.count;
    kernels.down(rows, in, columns, first, last, out);
  });
}

void run_across(const Bands& columns, const float* in, int height, int width, float* out,
                int threads) {
  const ResampleKernels& kernels = XRGS_PICK(resample_kernels);
  const int tasks = (height + kRows - 1) / kRows;
  const std::size_t size = kernels.scratch(width);
  Scratch scratch(take_block(tasks * size * sizeof(float)));
  parallel_for(threads, tasks, [&](std::int64_t task) {
    const int first = static_cast<int>(task) * kRows;
    const int rows = height - first < kRows ? height - first : kRows;
    kernels.across(columns, in + static_cast<std::size_t>(3) * first * width, width, rows,
                   out + static_cast<std::size_t>(3) * first * columns.count,
                   static_cast<float*>(scratch.get()) + task * size);
  });
}

Output resample(Image image, First row_first, Weights row_weights, First column_first,
                Weights column_weights, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  constexpr std::size_t most = std::numeric_limits<int>::max() / 64;
  if (height > most || width > most || row_first.shape(0) > most || column_first.shape(0) > most)
    throw nb::value_error("resample: an image of more than 33 million rows or columns");
  const Bands rows = checked(row_first, row_weights, height);
  const Bands columns = checked(column_first, column_weights, width);
  const std::size_t new_height = rows.count, new_width = columns.count;
  Output out = new_array<float>({new_height, new_width, 3});
  float* to = static_cast<float*>(out.data());
  nb::gil_scoped_release release;
  // Across where there are fewer rows.
  if (new_height <= height) {
    Scratch middle(take_block(3 * new_height * width * sizeof(float)));
    float* half = static_cast<float*>(middle.get());
    run_down(rows, image.data(), 3 * width, half, threads);
    run_across(columns, half, rows.count, static_cast<int>(width), to, threads);
  } else {
    Scratch middle(take_block(3 * height * new_width * sizeof(float)));
    float* half = static_cast<float*>(middle.get());
    run_across(columns, image.data(), static_cast<int>(height), static_cast<int>(width), half,
               threads);
    run_down(rows, half, 3 * new_width, to, threads);
  }
  return out;
}

}  // namespace

void bind_resample(nb::module_& m) {
  m.def("resample", &resample, nb::arg("image"), nb::arg("row_first"), nb::arg("row_weights"),
        nb::arg("column_first"), nb::arg("column_weights"), nb::arg("threads"),
        "An image [H, W, 3] by a banded matrix down and another across: [h, w, 3].\n"
        "Output i takes weights [i, t] of input first [i] + t.");
}

}  // namespace xrgs
