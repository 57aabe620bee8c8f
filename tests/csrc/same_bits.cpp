// Checks the vector operations, runs every kernel on inputs that are the same on every machine, and
// prints a hash of the bits of each result, one to a line after "fma" or "no-fma", which says
// whether the instruction set has a fused multiply-add: same_bits THREADS. Without an argument it
// lists the instruction sets of this machine. same_bits.sh compares the hashes of compilers and
// processors.
//
// The inputs are made of integers by + - * / alone, which IEEE 754 rounds in one way everywhere, so
// that no mathematical library takes part. The bindings (xrgs/csrc/*/bind.cpp) do call one, for
// constants that are computed in double and rounded to float: std::pow for Adam's bias corrections,
// std::exp for the window of SSIM, and std::log2 for the threshold of alpha. The results that a
// user sees depend on it only where two libraries differ across a rounding of float.
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <string>
#include <vector>

#include "activations/activations.h"
#include "densify/grad2d.h"
#include "isa.h"
#include "loss/photometric.h"
#include "loss/window_moments.h"
#include "optim/adam.h"
#include "raster/frame.h"
#include "raster/render.h"
#include "resample/resample.h"
#include "simd/array_math.h"
#include "simd_checks.h"
#include "thread_pool.h"

namespace {

using xrgs::parallel_for;

// Memory on 64-byte boundaries, which the kernels' outputs and scratch need.
template <class T>
struct AlignedAllocator {
  using value_type = T;
  static constexpr std::align_val_t kBoundary{64};
  T* allocate(std::size_t count) {
    return static_cast<T*>(::operator new(count * sizeof(T), kBoundary));
  }
  void deallocate(T* block, std::size_t) { ::operator delete(block, kBoundary); }
  bool operator==(AlignedAllocator) const { return true; }
  bool operator!=(AlignedAllocator) const { return false; }
};
using Floats = std::vector<float, AlignedAllocator<float>>;

constexpr int kWidth = 48, kHeight = 36;
constexpr int kMapWidth = kWidth - xrgs::kMapShrink, kMapHeight = kHeight - xrgs::kMapShrink;
constexpr int kRestCount = 15;
constexpr std::int64_t kPixels = std::int64_t{kWidth} * kHeight;

std::size_t size_of(std::int64_t count) { return static_cast<std::size_t>(count); }

// Random numbers by a linear congruential generator of 64 bits.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  // Returns a number from low (included) to high.
  float between(float low, float high) {
    state_ = state_ * 6364136223846793005u + 1442695040888963407u;
    const float unit = static_cast<float>(state_ >> 40) / 16777216.0f;
    return low + (high - low) * unit;
  }
  Floats array(std::int64_t count, float low, float high) {
    Floats values(size_of(count));
    for (float& value : values) value = between(low, high);
    return values;
  }

 private:
  std::uint64_t state_;
};

// A hash of arrays: FNV-1a of 64 bits, byte by byte.
class Hash {
 public:
  template <class Array>
  void add(const Array& values) {
    const auto* bytes = reinterpret_cast<const unsigned char*>(values.data());
    for (std::size_t i = 0; i < values.size() * sizeof values[0]; ++i)
      hash_ = (hash_ ^ bytes[i]) * 1099511628211u;
  }
  void print(const char* name) const {
    const char* rounding = XRGS_SELECT(array_math_kernels).fused_multiply_add ? "fma" : "no-fma";
    std::printf("%s %s %016llx\n", rounding, name, static_cast<unsigned long long>(hash_));
  }

 private:
  std::uint64_t hash_ = 14695981039346656037u;
};

// The parameters of Gaussians, or their gradients, or one of their moments.
struct Parameters {
  Floats means, quats, scales, opacities, sh0, shN, offsets;

  explicit Parameters(std::int64_t count)
      : means(size_of(3 * count)),
        quats(size_of(4 * count)),
        scales(size_of(3 * count)),
        opacities(size_of(count)),
        sh0(size_of(3 * count)),
        shN(size_of(3 * kRestCount * count)),
        offsets(size_of(2 * count)) {}
  std::int64_t count() const { return static_cast<std::int64_t>(opacities.size()); }
  xrgs::GaussianParameters view() const {
    return {count(),    means.data(), quats.data(), scales.data(), opacities.data(),
            sh0.data(), shN.data(),   kRestCount,   offsets.data()};
  }
  void add_to(Hash& hash) const {
    for (const Floats* array : {&means, &quats, &scales, &opacities, &sh0, &shN, &offsets})
      hash.add(*array);
  }
};

// A camera that is turned about two axes by angles with rational sines.
xrgs::RenderConfig make_config(bool antialiased, bool absgrad) {
  xrgs::RenderConfig config{};
  const float rotation[9] = {0.8f, 0.0f, 0.6f, -0.36f, 0.8f, 0.48f, -0.48f, -0.6f, 0.64f};
  const float translation[3] = {0.1f, -0.2f, 0.3f};
  for (int i = 0; i < 9; ++i) config.rotation[i] = rotation[i];
  for (int i = 0; i < 3; ++i) {
    config.translation[i] = translation[i];
    for (int k = 0; k < 3; ++k) config.camera_position[i] -= rotation[3 * k + i] * translation[k];
    config.background[i] = 0.25f * static_cast<float>(i);
  }
  config.fx = 40.0f, config.fy = 41.0f;
  config.cx = 0.5f * kWidth, config.cy = 0.5f * kHeight;
  config.width = kWidth, config.height = kHeight;
  config.near = 0.01f, config.eps2d = 0.3f;
  config.alpha_min = 1.0f / 255.0f, config.log2_alpha_min = -7.99435344f;
  config.alpha_max = 0.99f, config.transmittance_min = 1e-4f;
  config.antialiased = antialiased, config.absgrad = absgrad, config.sh_degree = 3;
  config.culling = {true, true, true, true, true};
  return config;
}

// Gaussians in front of the camera, some of them out of view.
Parameters make_gaussians(std::int64_t count, const xrgs::RenderConfig& config) {
  Random random(7);
  Parameters p(count);
  for (std::int64_t i = 0; i < count; ++i) {
    const float z = random.between(1.5f, 6.0f);
    const float camera[3] = {z * random.between(-0.8f, 0.8f) - config.translation[0],
                             z * random.between(-0.6f, 0.6f) - config.translation[1],
                             z - config.translation[2]};
    for (int k = 0; k < 3; ++k)
      for (int row = 0; row < 3; ++row)
        p.means[size_of(3 * i + k)] += config.rotation[3 * row + k] * camera[row];
    for (int k = 0; k < 3; ++k) {
      const float t = random.between(0.1f, 1.0f);
      p.scales[size_of(3 * i + k)] = 0.3f * t * t * t;  // from round to long and thin
    }
  }
  p.quats = random.array(4 * count, -1.0f, 1.0f);
  p.opacities = random.array(count, 0.0f, 1.0f);
  p.sh0 = random.array(3 * count, -1.5f, 1.5f);
  p.shN = random.array(3 * kRestCount * count, -0.3f, 0.3f);
  p.offsets = random.array(2 * count, -0.5f, 0.5f);
  return p;
}

struct Image {
  Floats color = Floats(size_of(3 * kPixels)), alpha = Floats(size_of(kPixels));
};

void render(int threads, const Parameters& p, const xrgs::RenderConfig& config, xrgs::Frame& frame,
            Image& image) {
  if (xrgs::render(threads, p.view(), config, frame, image.color.data(), image.alpha.data()) == 0)
    return;
  std::fputs("the parameters are not valid\n", stderr);
  std::exit(1);
}

void render_backward(int threads, const Parameters& p, xrgs::Frame& frame, const Image& v,
                     Parameters& gradients) {
  xrgs::render_backward(threads, p.view(), frame, v.color.data(), v.alpha.data(),
                        {gradients.means.data(), gradients.quats.data(), gradients.scales.data(),
                         gradients.opacities.data(), gradients.sh0.data(), gradients.shN.data(),
                         gradients.offsets.data()});
}

// A target of the loss, with its mean and variance under the window.
struct Target {
  Floats image, mean, variance;
};

// The weights of the window at each distance from its middle: a Gaussian of 1.5 px.
constexpr float kWindowWeights[xrgs::kWindow / 2 + 1] = {0.26601171f, 0.21300554f, 0.10936069f,
                                                         0.03600077f, 0.00759876f, 0.00102838f};

Target make_target(const Floats& image) {
  Target target{image, Floats(size_of(3 * kMapWidth * kMapHeight)),
                Floats(size_of(3 * kMapWidth * kMapHeight))};
  for (int y = 0; y < kMapHeight; ++y)
    for (int c = 0; c < 3 * kMapWidth; ++c) {
      double mean = 0, square = 0;
      for (int i = 0; i < xrgs::kWindow; ++i)
        for (int j = 0; j < xrgs::kWindow; ++j) {
          const double weight = double{kWindowWeights[std::abs(i - xrgs::kWindow / 2)]} *
                                kWindowWeights[std::abs(j - xrgs::kWindow / 2)];
          const double value = image[size_of(3 * kWidth * (y + i) + c + 3 * j)];
          mean += weight * value;
          square += weight * value * value;
        }
      target.mean[size_of(3 * kMapWidth * y + c)] = static_cast<float>(mean);
      target.variance[size_of(3 * kMapWidth * y + c)] = static_cast<float>(square - mean * mean);
    }
  return target;
}

struct Loss {
  std::vector<double> l1_rows = std::vector<double>(kHeight);
  std::vector<double> ssim_rows = std::vector<double>(kMapHeight);
  Image gradient;
};

// `pixel_weight` has a weight for each pixel; null weighs all of them 1.
void photometric_loss(int threads, const Floats& image, const Target& target,
                      const float* pixel_weight, Loss& loss) {
  xrgs::PhotometricJob job{};
  job.image = image.data(), job.target = target.image.data();
  job.target_mean = target.mean.data(), job.target_variance = target.variance.data();
  job.pixel_weight = pixel_weight;
  job.height = kHeight, job.width = kWidth;
  std::copy(kWindowWeights, kWindowWeights + xrgs::kWindow / 2 + 1, job.window);
  job.l1_slope = 0.8f / (3 * kPixels), job.ssim_slope = 0.2f / (3 * kMapWidth * kMapHeight);
  job.l1_rows = loss.l1_rows.data(), job.ssim_rows = loss.ssim_rows.data();
  job.gradient = loss.gradient.color.data();
  const auto& kernels = XRGS_SELECT(photometric_kernels);
  parallel_for(threads, threads, [&](std::int64_t band) {
    Floats scratch(kernels.scratch_size(job));
    const auto row = [&](std::int64_t at) { return static_cast<int>(kHeight * at / threads); };
    kernels.band(job, row(band), row(band + 1), scratch.data());
  });
}

xrgs::AdamGroup adam_group(Floats& parameter, const Floats& gradient, Floats& exp_avg,
                           Floats& exp_avg_sq, double lr, int step) {
  double beta1_power = 1, beta2_power = 1;
  for (int i = 0; i < step; ++i) beta1_power *= 0.9, beta2_power *= 0.999;
  xrgs::AdamGroup group{};
  group.parameter = parameter.data(), group.gradient = gradient.data();
  group.exp_avg = exp_avg.data(), group.exp_avg_sq = exp_avg_sq.data();
  group.size = static_cast<std::int64_t>(parameter.size());
  group.one_minus_beta1 = 0.1f, group.beta2 = 0.999f, group.one_minus_beta2 = 0.001f;
  group.step_size = static_cast<float>(lr / (1 - beta1_power));
  // 1 / sqrt(1 - beta2^step), by Newton's method from above the root.
  double root = 1;
  for (int i = 0; i < 60; ++i) root = 0.5 * (root + (1 - beta2_power) / root);
  group.inv_sqrt_bias2 = static_cast<float>(1 / root);
  group.eps = 1e-15f;
  return group;
}

struct Moments {
  Parameters exp_avg, exp_avg_sq;
  explicit Moments(std::int64_t count) : exp_avg(count), exp_avg_sq(count) {}
};

// One step of Adam on all parameters but the offsets.
void adam_step(int threads, Parameters& p, const Parameters& gradients, Moments& moments,
               const xrgs::RenderConfig& config, double lr, int step) {
  Parameters &m = moments.exp_avg, &v = moments.exp_avg_sq;
  // The step of shN reads the means that were rendered, so it comes first.
  xrgs::ShNAdamGroup rest{};
  rest.adam = adam_group(p.shN, gradients.shN, m.shN, v.shN, lr / 20, step);
  rest.means = p.means.data(), rest.sh0_gradient = gradients.sh0.data();
  std::copy(config.camera_position, config.camera_position + 3, rest.camera_position);
  rest.rest_count = kRestCount, rest.sh_degree = config.sh_degree;
  const auto& kernels = XRGS_SELECT(adam_kernels);
  constexpr std::int64_t kPerTask = 64;
  const auto in_tasks = [&](std::int64_t count, auto&& body) {
    parallel_for(threads, (count + kPerTask - 1) / kPerTask, [&](std::int64_t task) {
      body(task * kPerTask, std::min(count, (task + 1) * kPerTask));
    });
  };
  in_tasks(p.count(),
           [&](std::int64_t first, std::int64_t last) { kernels.step_shN(rest, first, last); });
  for (const xrgs::AdamGroup& group :
       {adam_group(p.means, gradients.means, m.means, v.means, lr, step),
        adam_group(p.quats, gradients.quats, m.quats, v.quats, lr, step),
        adam_group(p.scales, gradients.scales, m.scales, v.scales, lr / 10, step),
        adam_group(p.opacities, gradients.opacities, m.opacities, v.opacities, lr, step),
        adam_group(p.sh0, gradients.sh0, m.sh0, v.sh0, lr, step)})
    in_tasks(group.size,
             [&](std::int64_t first, std::int64_t last) { kernels.step(group, first, last); });
}

void array_math_part() {
  const auto& kernels = XRGS_SELECT(array_math_kernels);
  Random random(1);
  const Floats exponents = random.array(100001, -126.0f, 127.0f);
  Floats numbers = random.array(100001, 1e-30f, 2.0f), out(numbers.size());
  for (std::size_t i = 0; i < numbers.size(); i += 2) numbers[i] = 1.0f / numbers[i];
  const auto count = static_cast<std::int64_t>(out.size());
  Hash exp2_hash, log2_hash;
  kernels.exp2(exponents.data(), out.data(), count);
  exp2_hash.add(out);
  exp2_hash.print("exp2");
  kernels.log2(numbers.data(), out.data(), count);
  log2_hash.add(out);
  log2_hash.print("log2");
}

void activations_part(int threads) {
  constexpr std::int64_t kCount = 10001, kPerTask = 1000;
  const auto& kernels = XRGS_SELECT(activation_kernels);
  Random random(8);
  // Some values of exp are infinite, some of either function 0.
  const Floats x = random.array(kCount, -95.0f, 95.0f), v_y = random.array(kCount, -1.0f, 1.0f);
  const auto print = [&](const char* name, auto value, auto gradient) {
    Floats y(x.size()), v_x(x.size());
    parallel_for(threads, (kCount + kPerTask - 1) / kPerTask, [&](std::int64_t task) {
      const std::int64_t first = task * kPerTask, last = std::min(kCount, first + kPerTask);
      value(x.data(), y.data(), first, last);
      gradient(v_y.data(), y.data(), v_x.data(), first, last);
    });
    Hash hash;
    hash.add(y);
    hash.add(v_x);
    hash.print(name);
  };
  print("exp", kernels.exp, kernels.exp_backward);
  print("logistic", kernels.logistic, kernels.logistic_backward);
}

void raster_part(int threads, bool antialiased, bool absgrad, bool raw, const char* forward_name,
                 const char* backward_name) {
  xrgs::RenderConfig config = make_config(antialiased, absgrad);
  Parameters p = make_gaussians(2500, config);
  if (raw) {
    Random raw_values(11);
    p.scales = raw_values.array(3 * p.count(), -5.0f, -1.2f);
    p.opacities = raw_values.array(p.count(), -4.0f, 4.0f);
    config.raw = true;
  }
  Parameters gradients(p.count());
  xrgs::Frame frame;
  Image image, v;
  render(threads, p, config, frame, image);
  Hash forward, backward;
  forward.add(image.color);
  forward.add(image.alpha);
  forward.print(forward_name);
  Random random(2);
  v.color = random.array(3 * kPixels, -1.0f, 1.0f);
  v.alpha = random.array(kPixels, -1.0f, 1.0f);
  render_backward(threads, p, frame, v, gradients);
  gradients.add_to(backward);
  backward.print(backward_name);
}

void window_moments(int threads, const Floats& image) {
  double window[xrgs::kWindow];
  for (int tap = 0; tap < xrgs::kWindow; ++tap)
    window[tap] = kWindowWeights[std::abs(tap - xrgs::kWindow / 2)];
  Floats mean(size_of(3 * kMapWidth * kMapHeight)), variance(mean.size());
  const xrgs::WindowMomentsJob job{image.data(), kHeight,     kWidth,
                                   window,       mean.data(), variance.data()};
  parallel_for(threads, kMapHeight, [&](std::int64_t task) {
    const int row = static_cast<int>(task);
    XRGS_SELECT(window_moments_kernels).rows(job, row, row + 1);
  });
  Hash hash;
  hash.add(mean);
  hash.add(variance);
  hash.print("window-moments");
}

void loss_part(int threads) {
  Random random(3);
  const Floats image = random.array(3 * kPixels, 0.0f, 1.0f);
  window_moments(threads, image);
  Floats other = image;
  for (float& value : other) value += random.between(-0.1f, 0.1f);
  const Target target = make_target(other);
  const Floats weights = random.array(kPixels, 0.0f, 1.0f);
  for (const float* pixel_weight : {static_cast<const float*>(nullptr), weights.data()}) {
    Loss loss;
    photometric_loss(threads, image, target, pixel_weight, loss);
    Hash hash;
    hash.add(loss.l1_rows);
    hash.add(loss.ssim_rows);
    hash.add(loss.gradient.color);
    hash.print(pixel_weight == nullptr ? "loss" : "loss-weighted");
  }
}

void adam_part(int threads) {
  const xrgs::RenderConfig config = make_config(false, false);
  Parameters p = make_gaussians(501, config);
  const Parameters gradients = make_gaussians(501, config);
  Moments moments(p.count());
  for (int step = 1; step <= 3; ++step)
    adam_step(threads, p, gradients, moments, config, 0.01, step);
  Hash hash;
  p.add_to(hash);
  moments.exp_avg.add_to(hash);
  moments.exp_avg_sq.add_to(hash);
  hash.print("adam");
}

void densify_part(int threads) {
  constexpr std::int64_t kCount = 1003, kPerTask = 160;
  Random random(4);
  const Floats gradient = random.array(2 * kCount, -1.0f, 1.0f);
  Floats sum = random.array(kCount, 0.0f, 5.0f), visible_count(kCount);
  std::vector<std::uint8_t> visible(kCount);
  for (auto& one : visible) one = random.between(0.0f, 1.0f) < 0.7f;
  const xrgs::Grad2dJob job{gradient.data(), visible.data(), 24.0f,
                            18.0f,           sum.data(),     visible_count.data()};
  parallel_for(threads, (kCount + kPerTask - 1) / kPerTask, [&](std::int64_t task) {
    XRGS_SELECT(grad2d_kernels)
        .accumulate(job, task * kPerTask, std::min(kCount, (task + 1) * kPerTask));
  });
  Hash hash;
  hash.add(sum);
  hash.add(visible_count);
  hash.print("densify");
}

void resample_part(int threads) {
  constexpr int kNewWidth = 29, kNewHeight = 21, kTaps = 7, kRowsPerTask = 16;
  Random random(5);
  const Floats image = random.array(3 * kPixels, 0.0f, 1.0f);
  const Floats row_weights = random.array(kNewHeight * kTaps, -0.2f, 0.6f);
  const Floats column_weights = random.array(kNewWidth * kTaps, -0.2f, 0.6f);
  std::vector<int> row_first(kNewHeight), column_first(kNewWidth);
  for (int i = 0; i < kNewHeight; ++i)
    row_first[size_of(i)] = i * (kHeight - kTaps) / (kNewHeight - 1);
  for (int i = 0; i < kNewWidth; ++i)
    column_first[size_of(i)] = i * (kWidth - kTaps) / (kNewWidth - 1);
  const xrgs::BandedMatrix rows{row_first.data(), row_weights.data(), kNewHeight, kTaps};
  const xrgs::BandedMatrix columns{column_first.data(), column_weights.data(), kNewWidth, kTaps};
  Floats between(size_of(3 * kWidth * kNewHeight)), out(size_of(3 * kNewWidth * kNewHeight));
  const auto& kernels = XRGS_SELECT(resample_kernels);
  parallel_for(threads, (kNewHeight + kRowsPerTask - 1) / kRowsPerTask, [&](std::int64_t task) {
    const int first = static_cast<int>(task) * kRowsPerTask;
    const int last = std::min(first + kRowsPerTask, kNewHeight);
    kernels.down(rows, image.data(), 3 * kWidth, first, last, between.data());
    Floats scratch(kernels.scratch_size(kWidth));
    kernels.across(columns, between.data() + 3 * kWidth * first, kWidth, last - first,
                   out.data() + 3 * kNewWidth * first, scratch.data());
  });
  Hash hash;
  hash.add(out);
  hash.print("resample");
}

// Trains Gaussians towards a render of others: each step is a render, the loss, both backward
// passes and a step of Adam.
void training_part(int threads) {
  constexpr int kSteps = 20;
  const xrgs::RenderConfig config = make_config(false, false);
  Parameters p = make_gaussians(500, config);
  xrgs::Frame frame;
  Image image;
  render(threads, p, config, frame, image);
  const Target target = make_target(image.color);
  Random random(6);
  for (Floats* array : {&p.means, &p.sh0, &p.quats})
    for (float& value : *array) value += random.between(-0.1f, 0.1f);
  Parameters gradients(p.count());
  Moments moments(p.count());
  Loss loss;
  double first = 0, last = 0;
  for (int step = 1; step <= kSteps; ++step) {
    render(threads, p, config, frame, image);
    photometric_loss(threads, image.color, target, nullptr, loss);
    last = 0;
    for (double row : loss.l1_rows) last += row;
    if (step == 1) first = last;
    render_backward(threads, p, frame, loss.gradient, gradients);
    adam_step(threads, p, gradients, moments, config, 0.005, step);
    for (float& scale : p.scales) scale = std::max(scale, 0.001f);
    for (float& opacity : p.opacities) opacity = std::clamp(opacity, 0.01f, 0.99f);
  }
  if (!(last < 0.9 * first)) {
    std::fprintf(stderr, "training did not lower the error: %g, then %g\n", first, last);
    std::exit(1);
  }
  Hash hash;
  p.add_to(hash);
  hash.print("training");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 2) {
    for (const std::string& isa : xrgs::available_isas()) std::puts(isa.c_str());
    return 0;
  }
  const int threads = std::atoi(argv[1]);
  if (threads < 1) {
    std::fputs("THREADS must be at least 1\n", stderr);
    return 2;
  }
  if (XRGS_SELECT(simd_checks).run() != 0) return 1;
  array_math_part();
  activations_part(threads);
  raster_part(threads, false, false, false, "forward", "backward");
  raster_part(threads, true, true, false, "forward-antialiased", "backward-absgrad");
  raster_part(threads, false, false, true, "forward-raw", "backward-raw");
  loss_part(threads);
  adam_part(threads);
  densify_part(threads);
  resample_part(threads);
  training_part(threads);
  return 0;
}
