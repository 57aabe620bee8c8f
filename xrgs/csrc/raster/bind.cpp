// The Python bindings of the rasterizer, which check shapes and release the GIL for the kernels.
#include "raster/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

#include "output_arrays.h"
#include "raster/render.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace xrgs {
namespace {

template <class... Shape>
using Array = nb::ndarray<const float, nb::shape<Shape::value...>, nb::c_contig, nb::device::cpu>;
template <long Size>
using Side = std::integral_constant<nb::ssize_t, Size>;
using Vectors = Array<Side<-1>, Side<3>>;
using Quaternions = Array<Side<-1>, Side<4>>;
using Offsets = Array<Side<-1>, Side<2>>;
using Scalars = Array<Side<-1>>;
using ShCoefficients = Array<Side<-1>, Side<-1>, Side<3>>;
using Image = Array<Side<-1>, Side<-1>, Side<3>>;
using Plane = Array<Side<-1>, Side<-1>>;
using Matrix4 = std::array<float, 16>;

// The frame of a Python object. It is released for reuse when Python deletes the object.
class FrameHandle {
 public:
  FrameHandle() : frame_(acquire_frame()) {}
  ~FrameHandle() {
    if (frame_) release_frame(std::move(frame_));
  }
  FrameHandle(FrameHandle&&) = default;
  FrameHandle& operator=(FrameHandle&&) = delete;
  Frame& operator*() { return *frame_; }
  Frame* operator->() { return frame_.get(); }

 private:
  std::unique_ptr<Frame> frame_;
};

void check_rows(const char* name, std::size_t rows, std::size_t expected) {
  if (rows != expected)
    throw nb::value_error((std::string(name) + " must have " + std::to_string(expected) +
                           " rows, got " + std::to_string(rows))
                              .c_str());
}

void check_bands(std::size_t stored, int sh_degree) {
  constexpr auto most = static_cast<std::size_t>(rest_basis_count(kMaxShDegree));
  if (stored > most)
    throw nb::value_error(
        ("shN must have at most " + std::to_string(most) + " bands, got " + std::to_string(stored))
            .c_str());
  if (stored < static_cast<std::size_t>(rest_basis_count(sh_degree)))
    throw nb::value_error("shN has fewer bands than sh_degree needs");
}

// The parameter tensors of a call, which own the memory that GaussianParameters points to.
struct ParameterTensors {
  Vectors means;
  Quaternions quats;
  Vectors scales;
  Scalars opacities;
  ShCoefficients sh0, shN;
  std::optional<Offsets> means2d_offset;

  // Throws ValueError if shapes do not match each other or the degree of the harmonics.
  GaussianParameters checked(int sh_degree) const {
    const std::size_t count = means.shape(0);
    check_rows("quats", quats.shape(0), count);
    check_rows("scales", scales.shape(0), count);
    check_rows("opacities", opacities.shape(0), count);
    check_rows("sh0", sh0.shape(0), count);
    check_rows("shN", shN.shape(0), count);
    if (sh0.shape(1) != 1) throw nb::value_error("sh0 must be [N, 1, 3]");
    check_bands(shN.shape(1), sh_degree);
    if (means2d_offset) check_rows("means2d_offset", means2d_offset->shape(0), count);
    if (count > 0xffffffffu) throw nb::value_error("means has more than 2^32 - 1 rows");
    return {static_cast<std::int64_t>(count),
            means.data(),
            quats.data(),
            scales.data(),
            opacities.data(),
            sh0.data(),
            shN.data(),
            static_cast<int>(shN.shape(1)),
            means2d_offset ? means2d_offset->data() : nullptr};
  }
};

bool all_finite(const float* p, std::size_t count) {
  for (std::size_t i = 0; i < count; ++i)
    if (!std::isfinite(p[i])) return false;
  return true;
}

// Throws an error that names the parameter that made a render fail.
[[noreturn]] void throw_invalid_parameter(const ParameterTensors& t, bool raw,
                                          std::uint32_t faults) {
  const auto check = [](const char* name, const auto& array) {
    if (!all_finite(array.data(), array.size()))
      throw nb::value_error((std::string(name) + " has values that are not finite").c_str());
  };
  check("means", t.means);
  check("quats", t.quats);
  check("scales", t.scales);
  check("opacities", t.opacities);
  check("sh0", t.sh0);
  check("shN", t.shN);
  if (t.means2d_offset) check("means2d_offset", *t.means2d_offset);
  for (std::size_t i = 0; i < t.scales.size(); ++i) {
    const float scale = t.scales.data()[i];
    if (raw && !std::isfinite(std::exp(scale)))
      throw nb::value_error("scales has values that are not finite");
    if (!raw && scale < 0.0f) throw nb::value_error("scales has values below 0");
  }
  for (std::size_t i = 0; !raw && i < t.opacities.size(); ++i)
    if (t.opacities.data()[i] < 0.0f || t.opacities.data()[i] > 1.0f)
      throw nb::value_error("opacities has values outside 0..1");
  if ((faults & kTooLarge) != 0)
    throw nb::value_error("scales: a Gaussian is larger than 1e18 px in the image");
  throw nb::value_error("sh0 and shN overflow: a colour is above 1e38");
}

// Throws MemoryError. The message is made without further allocations.
[[noreturn]] void throw_out_of_memory(const Frame& frame) {
  if (frame.visible_count > 0)
    PyErr_Format(
        PyExc_MemoryError, "the lists of %lld visible Gaussians in %dx%d px do not fit in memory",
        static_cast<long long>(frame.visible_count), frame.config.width, frame.config.height);
  else
    PyErr_Format(PyExc_MemoryError,
                 "%lld Gaussians do not fit in memory a second time, projected to %dx%d px",
                 static_cast<long long>(frame.gaussian_count), frame.config.width,
                 frame.config.height);
  throw nb::python_error();
}

// Returns the frame of a completed render. Throws ValueError if there is none.
Frame& rendered(FrameHandle& frame) {
  if (!frame->rendered)
    throw nb::value_error("the frame has no render: call forward first, and without an error");
  return *frame;
}

std::tuple<Output, Output> forward(FrameHandle& frame, const RenderConfig& config,
                                   const Vectors& means, const Quaternions& quats,
                                   const Vectors& scales, const Scalars& opacities,
                                   const ShCoefficients& sh0, const ShCoefficients& shN,
                                   const std::optional<Offsets>& means2d_offset, int threads) {
  const ParameterTensors tensors{means, quats, scales, opacities, sh0, shN, means2d_offset};
  const GaussianParameters parameters = tensors.checked(config.sh_degree);
  const auto height = static_cast<std::size_t>(config.height);
  const auto width = static_cast<std::size_t>(config.width);
  Output image = new_array<float>({height, width, 3}), alpha = new_array<float>({height, width});
  std::uint32_t faults = 0;
  bool allocation_ok = true;
  {
    nb::gil_scoped_release release;
    try {
      faults = render(threads, parameters, config, *frame, static_cast<float*>(image.data()),
                      static_cast<float*>(alpha.data()));
    } catch (const std::bad_alloc&) {
      allocation_ok = false;
    }
  }
  if (!allocation_ok) throw_out_of_memory(*frame);
  if (faults != 0) throw_invalid_parameter(tensors, config.raw, faults);
  return {std::move(image), std::move(alpha)};
}

// The gradients of means, quats, scales, opacities, sh0, shN and means2d_offset, and whether all of
// them are finite.
using GradientTensors = std::tuple<Output, Output, Output, Output, Output, std::optional<Output>,
                                   std::optional<Output>, bool>;

GradientTensors backward(FrameHandle& handle, const Image& v_image, const Plane& v_alpha,
                         const Vectors& means, const Quaternions& quats, const Vectors& scales,
                         const Scalars& opacities, const ShCoefficients& sh0,
                         const ShCoefficients& shN, const std::optional<Offsets>& means2d_offset,
                         bool with_shN, int threads, bool with_means2d_offset) {
  const ParameterTensors tensors{means, quats, scales, opacities, sh0, shN, means2d_offset};
  Frame& frame = rendered(handle);
  const GaussianParameters parameters = tensors.checked(frame.config.sh_degree);
  check_rows("means", means.shape(0), static_cast<std::size_t>(frame.gaussian_count));
  const auto height = static_cast<std::size_t>(frame.config.height);
  const auto width = static_cast<std::size_t>(frame.config.width);
  if (v_image.shape(0) != height || v_image.shape(1) != width || v_alpha.shape(0) != height ||
      v_alpha.shape(1) != width)
    throw nb::value_error("the gradients must have the image's size");
  const std::size_t n = means.shape(0), rest_count = shN.shape(1);
  GradientTensors out{new_array<float>({n, 3}),
                      new_array<float>({n, 4}),
                      new_array<float>({n, 3}),
                      new_array<float>({n}),
                      new_array<float>({n, 1, 3}),
                      std::nullopt,
                      std::nullopt,
                      true};
  if (with_shN) std::get<5>(out) = new_array<float>({n, rest_count, 3});
  with_means2d_offset = with_means2d_offset || means2d_offset;
  if (with_means2d_offset) std::get<6>(out) = new_array<float>({n, 2});
  const auto pointer = [](Output& array) { return static_cast<float*>(array.data()); };
  const ParameterGradients gradients{pointer(std::get<0>(out)),
                                     pointer(std::get<1>(out)),
                                     pointer(std::get<2>(out)),
                                     pointer(std::get<3>(out)),
                                     pointer(std::get<4>(out)),
                                     with_shN ? pointer(*std::get<5>(out)) : nullptr,
                                     with_means2d_offset ? pointer(*std::get<6>(out)) : nullptr};
  bool allocation_ok = true;
  {
    nb::gil_scoped_release release;
    try {
      std::get<7>(out) =
          render_backward(threads, parameters, frame, v_image.data(), v_alpha.data(), gradients);
    } catch (const std::bad_alloc&) {
      allocation_ok = false;
    }
  }
  if (!allocation_ok) throw_out_of_memory(frame);
  return out;
}

void check_within(const char* name, float value, float largest) {
  if (!(std::abs(value) <= largest)) {
    char bound[16];
    std::snprintf(bound, sizeof bound, "%.2g", static_cast<double>(largest));
    throw nb::value_error((std::string(name) + " must be finite, at most " + bound).c_str());
  }
}

// The camera's position in world units, -R^T t.
void set_camera_position(RenderConfig& config) {
  for (int k = 0; k < 3; ++k) {
    double position = 0.0;
    for (int i = 0; i < 3; ++i)
      position -= static_cast<double>(config.rotation[3 * i + k]) *
                  static_cast<double>(config.translation[i]);
    config.camera_position[k] = static_cast<float>(position);
  }
}

// Throws an error that names the first number of the camera or the settings that overflows float32,
// or the background if it is too bright.
void check_finite(const RenderConfig& config) {
  constexpr float kLargest = std::numeric_limits<float>::max();
  for (float value : config.rotation) check_within("viewmat", value, kLargest);
  for (float value : config.translation) check_within("viewmat", value, kLargest);
  for (float value : config.camera_position) check_within("viewmat's position", value, kLargest);
  for (float value : {config.fx, config.fy, config.cx, config.cy})
    check_within("intrinsics", value, kLargest);
  check_within("near", config.near, kLargest);
  check_within("eps2d", config.eps2d, kLargest);
  check_within("alpha_min", config.alpha_min, kLargest);
  check_within("alpha_max", config.alpha_max, kLargest);
  check_within("transmittance_min", config.transmittance_min, kLargest);
  for (float value : config.background) check_within("background", value, kLargestColor);
}

RenderConfig make_config(const Matrix4& viewmat, const std::array<float, 4>& intrinsics, int width,
                         int height, float near, float eps2d, float alpha_min, float alpha_max,
                         float transmittance_min, bool antialiased, bool absgrad,
                         const std::array<float, 3>& background, int sh_degree,
                         const std::array<bool, 5>& culling, bool raw) {
  if (width < 1 || height < 1) throw nb::value_error("width and height must be at least 1");
  if (sh_degree < 0 || sh_degree > 3) throw nb::value_error("sh_degree must be 0 to 3");
  RenderConfig config;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k)
      config.rotation[3 * i + k] = viewmat[static_cast<std::size_t>(4 * i + k)];
    config.translation[i] = viewmat[static_cast<std::size_t>(4 * i + 3)];
    config.background[i] = background[static_cast<std::size_t>(i)];
  }
  set_camera_position(config);
  config.fx = intrinsics[0];
  config.fy = intrinsics[1];
  config.cx = intrinsics[2];
  config.cy = intrinsics[3];
  config.width = width;
  config.height = height;
  config.near = near;
  config.eps2d = eps2d;
  config.alpha_min = std::max(alpha_min, std::numeric_limits<float>::min());
  // In double, then rounded to float, so that differences between mathematical libraries vanish.
  config.log2_alpha_min = static_cast<float>(std::log2(static_cast<double>(config.alpha_min)));
  config.alpha_max = alpha_max;
  config.transmittance_min = transmittance_min;
  config.antialiased = antialiased;
  config.absgrad = absgrad;
  config.raw = raw;
  config.sh_degree = sh_degree;
  config.culling = {culling[0], culling[1], culling[2], culling[3], culling[4]};
  check_finite(config);
  return config;
}

// Expands the eight bits of a byte to eight bytes of 0 or 1, the lowest bit to the lowest byte.
std::uint64_t spread_bits(std::uint64_t byte) {
  const std::uint64_t one_bit_each = byte * 0x0101010101010101u & 0x8040201008040201u;
  return (one_bit_each + 0x7f7f7f7f7f7f7f7fu) >> 7 & 0x0101010101010101u;
}

Output visible_mask(FrameHandle& handle) {
  const Frame& frame = rendered(handle);
  const auto count = static_cast<std::size_t>(frame.gaussian_count);
  Output out = new_array<bool>({count});
  auto* visible = static_cast<std::uint8_t*>(out.data());
  for (std::size_t i = 0; i < count; i += 8) {
    const std::uint64_t bytes = spread_bits(frame.visible[i / 16] >> (i % 16) & 255u);
    std::memcpy(visible + i, &bytes, std::min<std::size_t>(8, count - i));
  }
  return out;
}

nb::dict timings_dict(FrameHandle& frame) {
  const Timings& t = rendered(frame).timings;
  nb::dict out;
  out["project"] = t.project;
  out["sort"] = t.sort;
  out["intersect_tiles"] = t.intersect_tiles;
  out["composite"] = t.composite;
  out["composite_backward"] = t.composite_backward;
  out["project_backward"] = t.project_backward;
  return out;
}

}  // namespace

void bind_raster(nb::module_& m) {
  nb::class_<RenderConfig>(m, "RenderConfig", "The camera and the settings of one render.")
      .def(nb::new_(&make_config), nb::kw_only(), "viewmat"_a, "intrinsics"_a, "width"_a,
           "height"_a, "near"_a, "eps2d"_a, "alpha_min"_a, "alpha_max"_a, "transmittance_min"_a,
           "antialiased"_a, "absgrad"_a, "background"_a, "sh_degree"_a, "culling"_a,
           "raw"_a = false,
           "Collect the arguments of a render.\n\n"
           "viewmat: 16 floats, world to camera, row by row. intrinsics: fx, fy, cx, cy in px.\n"
           "culling: out_of_view, sub_threshold, tiles, blocks, saturated, as in\n"
           "xrgs.splat.settings.CullingOptions. raw: scales are natural logarithms and opacities\n"
           "logits, and so are their gradients. The others are those of RasterSettings.");
  // Tensors are not converted: copying to another type would take longer than the render.
  nb::class_<FrameHandle>(m, "Frame",
                          "The memory of one rendered view, from its forward to its backward pass.")
      .def(nb::init<>())
      .def("forward", &forward, "config"_a, "means"_a.noconvert(), "quats"_a.noconvert(),
           "scales"_a.noconvert(), "opacities"_a.noconvert(), "sh0"_a.noconvert(),
           "shN"_a.noconvert(), "means2d_offset"_a.none().noconvert(), "threads"_a,
           "Render the Gaussians: image [H, W, 3] and alpha [H, W].")
      .def("backward", &backward, "v_image"_a.noconvert(), "v_alpha"_a.noconvert(),
           "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
           "opacities"_a.noconvert(), "sh0"_a.noconvert(), "shN"_a.noconvert(),
           "means2d_offset"_a.none().noconvert(), "with_shN"_a, "threads"_a,
           "with_means2d_offset"_a = false,
           "Compute the gradients of the parameters, in their order, from those of image and "
           "alpha.\n"
           "shN's is None unless with_shN. That of means2d_offset is None where there is none, "
           "unless\n"
           "with_means2d_offset: offsets of zeros need not be passed.\n"
           "The last value says whether all of them are finite.")
      .def("visible", &visible_mask, "Return which Gaussians are visible: [N] bool.")
      .def_prop_ro(
          "pair_count", [](FrameHandle& f) { return rendered(f).pair_count(); },
          "Number of (tile, Gaussian) pairs, gsplat's number of tile intersections.")
      .def_prop_ro(
          "evaluations", [](FrameHandle& f) { return rendered(f).evaluations(); },
          "Number of alphas that were computed: one for each pixel and Gaussian.")
      .def_prop_ro(
          "bytes", [](FrameHandle& f) { return rendered(f).bytes(); },
          "Memory in use, in bytes, including that of the backward pass.")
      .def_prop_ro("timings", &timings_dict, "Duration of each stage, in milliseconds.");
}

}  // namespace xrgs
