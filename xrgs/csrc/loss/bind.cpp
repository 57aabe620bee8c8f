// xrgs._native.photometric: the sums of L1 and SSIM over an image, and the gradient of the loss.
#include "loss/bind.h"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "arrays.h"
#include "loss/photometric.h"
#include "pool.h"

namespace nb = nanobind;

namespace xrgs {
namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;

constexpr double kSigma = 1.5;
constexpr int kLeastBand = 32;  // rows; a band computes ten rows more than its own

void set_taps(float* taps) {
  double weights[kTaps / 2 + 1], total = 0;
  for (int i = 0; i <= kTaps / 2; ++i) {
    weights[i] = std::exp(-i * i / (2 * kSigma * kSigma));
    total += i == 0 ? weights[i] : 2 * weights[i];
  }
  for (int i = 0; i <= kTaps / 2; ++i) taps[i] = static_cast<float>(weights[i] / total);
}

void run_bands(const Photometric& job, int threads) {
  const PhotometricKernels& kernels = XRGS_PICK(photometric_kernels);
  // One band does least work twice; with more threads, two each, for one that others hold up.
  const int most = job.height / kLeastBand > 0 ? job.height / kLeastBand : 1;
  const int bands = threads <= 1 ? 1 : (2 * threads < most ? 2 * threads : most);
  const std::size_t size = (kernels.scratch(job.width) + 15) / 16 * 16;
  std::unique_ptr<void, GiveBlock> scratch(take_block(bands * size * sizeof(float)));
  parallel_for(threads, bands, [&](std::int64_t i) {
    const auto row = [&](std::int64_t band) { return static_cast<int>(job.height * band / bands); };
    kernels.band(job, row(i), row(i + 1), static_cast<float*>(scratch.get()) + i * size);
  });
}

double total(const std::vector<double>& rows) {
  double sum = 0;
  for (double row : rows) sum += row;
  return sum;
}

nb::tuple photometric(Image image, Image target, Image mean, Image variance, double l1, double ssim,
                      bool with_gradient, int threads) {
  const std::size_t height = image.shape(0), width = image.shape(1);
  const auto is = [](const Image& a, std::size_t rows, std::size_t columns) {
    return a.shape(0) == rows && a.shape(1) == columns;
  };
  if (height < kTaps || width < kTaps || !is(target, height, width) ||
      !is(mean, height - kReach, width - kReach) || !is(variance, height - kReach, width - kReach))
    throw nb::value_error("photometric: shapes that do not fit");
  const double pixels = 3.0 * height * width;
  const double windows = 3.0 * (height - kReach) * (width - kReach);
  std::vector<double> l1_rows(height), ssim_rows(height - kReach);
  nb::object gradient = nb::none();
  Photometric job{};
  job.image = image.data(), job.target = target.data();
  job.mean = mean.data(), job.variance = variance.data();
  job.height = static_cast<int>(height), job.width = static_cast<int>(width);
  set_taps(job.taps);
  job.l1_slope = static_cast<float>(l1 / pixels);
  job.ssim_slope = static_cast<float>(-ssim / windows);
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
  const double loss = l1 * (total(l1_rows) / pixels) + ssim * (1 - total(ssim_rows) / windows);
  return nb::make_tuple(loss, gradient);
}

}  // namespace

void bind_loss(nb::module_& m) {
  m.def("photometric", &photometric, nb::arg("image"), nb::arg("target"), nb::arg("mean"),
        nb::arg("variance"), nb::arg("l1"), nb::arg("ssim"), nb::arg("with_gradient"),
        nb::arg("threads"),
        "l1 mean|image - target| + ssim (1 - SSIM), and its gradient by the image [H, W, 3] or\n"
        "None. mean and variance [H - 10, W - 10, 3] are the target's under the window.");
}

}  // namespace xrgs
