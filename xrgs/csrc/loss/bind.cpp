// xrgs._native.photometric_loss: L1 and SSIM of an image against a target, and the gradient of the
// loss. xrgs._native.window_moments: mean and variance of the target, for photometric_loss.
#include "loss/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "loss/photometric.h"
#include "loss/window_moments.h"
#include "output_arrays.h"
#include "thread_pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Window = nb::ndarray<const double, nb::shape<kWindow>, nb::c_contig, nb::device::cpu>;
using PixelWeights = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

constexpr double kSigma = 1.5;    // of the window, px
constexpr int kMinBandRows = 32;  // a band also computes ten rows of its neighbours
constexpr int kMomentRows = 32;   // of a task, so that its rows of the image stay in the cache

// Sets the weights of a normalised Gaussian window.
void set_window(float* window) {
  double weights[kWindow / 2 + 1], total = 0;
  for (int i = 0; i <= kWindow / 2; ++i) {
    weights[i] = std::exp(-i * i / (2 * kSigma * kSigma));
    total += i == 0 ? weights[i] : 2 * weights[i];
  }
  for (int i = 0; i <= kWindow / 2; ++i) window[i] = static_cast<float>(weights[i] / total);
}

void run_bands(const PhotometricJob& job, int threads) {
  const PhotometricKernels& kernels = XRGS_SELECT(photometric_kernels);
  // Each band repeats work at its border, so a single thread gets one band. With more threads each
  // gets two bands, so that a thread that another program delays holds up less work.
  const int most = job.height / kMinBandRows > 0 ? job.height / kMinBandRows : 1;
  const int bands = threads <= 1 ? 1 : (2 * threads < most ? 2 * threads : most);
  const std::size_t size = (kernels.scratch_size(job) + 15) / 16 * 16;
  const OwnedBlock scratch = acquire_block(bands * size * sizeof(float));
  parallel_for(threads, bands, [&](std::int64_t i) {
    const auto row = [&](std::int64_t band) { return static_cast<int>(job.height * band / bands); };
    kernels.band(job, row(i), row(i + 1), static_cast<float*>(scratch->data) + i * size);
  });
}

double total(const std::vector<double>& rows) {
  double sum = 0;
  for (double row : rows) sum += row;
  return sum;
}

nb::tuple photometric_loss(Image image, Image target, Image target_mean, Image target_variance,
                           std::optional<PixelWeights> pixel_weight, double l1, double ssim,
                           bool with_gradient, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  const auto has_size = [](const Image& a, std::size_t rows, std::size_t columns) {
    return a.shape(0) == rows && a.shape(1) == columns;
  };
  if (height < kWindow || width < kWindow || !has_size(target, height, width) ||
      !has_size(target_mean, height - kMapShrink, width - kMapShrink) ||
      !has_size(target_variance, height - kMapShrink, width - kMapShrink) ||
      (pixel_weight && (pixel_weight->shape(0) != height || pixel_weight->shape(1) != width)))
    throw nb::value_error(
        "photometric_loss: shapes that do not fit: image and target must be [H, W, 3] of at least "
        "11 x 11 px, target_mean and target_variance [H - 10, W - 10, 3], pixel_weight [H, W]");
  const double pixels = 3.0 * height * width;
  const double windows = 3.0 * (height - kMapShrink) * (width - kMapShrink);
  std::vector<double> l1_rows(height), ssim_rows(height - kMapShrink);
  nb::object gradient = nb::none();
  PhotometricJob job{};
  job.image = image.data(), job.target = target.data();
  job.target_mean = target_mean.data(), job.target_variance = target_variance.data();
  job.pixel_weight = pixel_weight ? pixel_weight->data() : nullptr;
  job.height = static_cast<int>(height), job.width = static_cast<int>(width);
  set_window(job.window);
  job.l1_slope = static_cast<float>(l1 / pixels);
  job.ssim_slope = static_cast<float>(ssim / windows);
  job.l1_rows = l1_rows.data(), job.ssim_rows = ssim_rows.data();
  if (with_gradient) {
    Output array = new_array<float>({height, width, 3});
    job.gradient = static_cast<float*>(array.data());
    gradient = nb::cast(std::move(array));
  }
  {
    nb::gil_scoped_release release;
    run_bands(job, threads);
  }
  const double loss = l1 * (total(l1_rows) / pixels) + ssim * (total(ssim_rows) / windows);
  return nb::make_tuple(loss, gradient);
}

nb::tuple window_moments(Image image, Window window, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  if (height < kWindow || width < kWindow)
    throw nb::value_error("window_moments: image must be [H, W, 3] of at least 11 x 11 px");
  const std::size_t map_height = height - kMapShrink;
  Output mean = new_array<float>({map_height, width - kMapShrink, 3});
  Output variance = new_array<float>({map_height, width - kMapShrink, 3});
  const WindowMomentsJob job{
      image.data(),  static_cast<int>(height),         static_cast<int>(width),
      window.data(), static_cast<float*>(mean.data()), static_cast<float*>(variance.data())};
  {
    nb::gil_scoped_release release;
    const WindowMomentsKernels& kernels = XRGS_SELECT(window_moments_kernels);
    const int rows = static_cast<int>(map_height);
    parallel_for(threads, (rows + kMomentRows - 1) / kMomentRows, [&](std::int64_t task) {
      const int first = static_cast<int>(task) * kMomentRows;
      kernels.rows(job, first, rows - first < kMomentRows ? rows : first + kMomentRows);
    });
  }
  return nb::make_tuple(mean, variance);
}

}  // namespace

void bind_loss(nb::module_& m) {
  m.def(
      "photometric_loss", &photometric_loss, nb::arg("image").noconvert(),
      nb::arg("target").noconvert(), nb::arg("target_mean").noconvert(),
      nb::arg("target_variance").noconvert(), nb::arg("pixel_weight").noconvert().none(),
      nb::arg("l1"), nb::arg("ssim"), nb::arg("with_gradient"), nb::arg("threads"),
      "Return l1 mean(w |image - target|) + ssim mean(w (1 - SSIM)), and its gradient by the "
      "image\n"
      "or None.\n\n"
      "image and target are [H, W, 3]; target_mean and target_variance [H - 10, W - 10, 3] are\n"
      "the target's under the window; pixel_weight [H, W] has the weight w of each pixel, and of\n"
      "the window around it, and None weighs all of them 1.");
  m.def("window_moments", &window_moments, nb::arg("image").noconvert(),
        nb::arg("window").noconvert(), nb::arg("threads"),
        "Return the mean and the variance of an image [H, W, 3] under a window: [H - 10, W - 10, "
        "3] each.\n\n"
        "window [11] has the weights along one axis, in double.");
}

}  // namespace xrgs
