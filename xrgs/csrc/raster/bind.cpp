// nanobind's side of the rasterizer: shapes are checked here, the GIL is released around the work.
#include "raster/bind.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>

#include "arrays.h"
#include "raster/driver.h"

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
using Harmonics = Array<Side<-1>, Side<-1>, Side<3>>;
using Image = Array<Side<-1>, Side<-1>, Side<3>>;
using Plane = Array<Side<-1>, Side<-1>>;
using Matrix4 = std::array<float, 16>;

// A frame on loan: given back when Python drops it.
class LentFrame {
 public:
  LentFrame() : frame_(take_frame()) {}
  ~LentFrame() {
    if (frame_) give_frame(std::move(frame_));
  }
  LentFrame(LentFrame&&) = default;
  LentFrame& operator=(LentFrame&&) = delete;
  Frame& operator*() { return *frame_; }
  Frame* operator->() { return frame_.get(); }

 private:
  std::unique_ptr<Frame> frame_;
};

void check_size(const char* name, std::size_t size, std::size_t count) {
  if (size != count)
    throw nb::value_error((std::string(name) + " must have " + std::to_string(count) +
                           " rows, got " + std::to_string(size))
                              .c_str());
}

// The tensors of a call, held for as long as their pointers are used.
struct Tensors {
  Vectors means;
  Quaternions quats;
  Vectors scales;
  Scalars opacities;
  Harmonics sh0, shN;
  std::optional<Offsets> offsets;

  Parameters checked() const {
    const std::size_t count = means.shape(0);
    check_size("quats", quats.shape(0), count);
    check_size("scales", scales.shape(0), count);
    check_size("opacities", opacities.shape(0), count);
    check_size("sh0", sh0.shape(0), count);
    check_size("shN", shN.shape(0), count);
    if (sh0.shape(1) != 1) throw nb::value_error("sh0 must be [N, 1, 3]");
    if (offsets) check_size("means2d_offset", offsets->shape(0), count);
    if (count > 0xffffffffu) throw nb::value_error("means: more than 2^32 Gaussians");
    return {static_cast<std::int64_t>(count),
            means.data(),
            quats.data(),
            scales.data(),
            opacities.data(),
            sh0.data(),
            shN.data(),
            static_cast<int>(shN.shape(1)),
            offsets ? offsets->data() : nullptr};
  }
};

bool all_finite(const float* p, std::size_t count) {
  for (std::size_t i = 0; i < count; ++i)
    if (!std::isfinite(p[i])) return false;
  return true;
}

// Which parameter was it?
[[noreturn]] void throw_bad_value(const Tensors& t) {
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
  if (t.offsets) check("means2d_offset", *t.offsets);
  for (std::size_t i = 0; i < t.scales.size(); ++i)
    if (t.scales.data()[i] < 0.0f) throw nb::value_error("scales has values below 0");
  for (std::size_t i = 0; i < t.opacities.size(); ++i)
    if (t.opacities.data()[i] < 0.0f || t.opacities.data()[i] > 1.0f)
      throw nb::value_error("opacities has values outside 0..1");
  throw nb::value_error("sh0 and shN overflow: a colour is not finite");
}

[[noreturn]] void throw_memory(const Frame& frame) {
  const std::string message = "the lists of " + std::to_string(frame.seen) +
                              " visible Gaussians in " + std::to_string(frame.view.width) + "x" +
                              std::to_string(frame.view.height) + " px do not fit in memory";
  PyErr_SetString(PyExc_MemoryError, message.c_str());
  throw nb::python_error();
}

std::tuple<Output, Output> forward(LentFrame& frame, const View& view, const Vectors& means,
                                   const Quaternions& quats, const Vectors& scales,
                                   const Scalars& opacities, const Harmonics& sh0,
                                   const Harmonics& shN, const std::optional<Offsets>& offsets,
                                   int threads) {
  const Tensors tensors{means, quats, scales, opacities, sh0, shN, offsets};
  const Parameters parameters = tensors.checked();
  if ((view.degree + 1) * (view.degree + 1) - 1 > parameters.rest)
    throw nb::value_error("shN has fewer bands than sh_degree asks for");
  const auto height = static_cast<std::size_t>(view.height),
             width = static_cast<std::size_t>(view.width);
  Output image = new_array<float>({height, width, 3}), alpha = new_array<float>({height, width});
  bool good = true, enough = true;
  {
    nb::gil_scoped_release release;
    try {
      good = render(threads, parameters, view, *frame, static_cast<float*>(image.data()),
                    static_cast<float*>(alpha.data()));
    } catch (const std::bad_alloc&) {
      enough = false;
    }
  }
  if (!enough) throw_memory(*frame);
  if (!good) throw_bad_value(tensors);
  return {std::move(image), std::move(alpha)};
}

using Outputs = std::tuple<Output, Output, Output, Output, Output, std::optional<Output>,
                           std::optional<Output>>;

Outputs backward(LentFrame& frame, const Image& image_gradient, const Plane& alpha_gradient,
                 const Vectors& means, const Quaternions& quats, const Vectors& scales,
                 const Scalars& opacities, const Harmonics& sh0, const Harmonics& shN,
                 const std::optional<Offsets>& offsets, bool with_rest, int threads) {
  const Tensors tensors{means, quats, scales, opacities, sh0, shN, offsets};
  const Parameters parameters = tensors.checked();
  check_size("means", means.shape(0), static_cast<std::size_t>(frame->gaussians));
  const auto height = static_cast<std::size_t>(frame->view.height);
  const auto width = static_cast<std::size_t>(frame->view.width);
  if (image_gradient.shape(0) != height || image_gradient.shape(1) != width ||
      alpha_gradient.shape(0) != height || alpha_gradient.shape(1) != width)
    throw nb::value_error("the gradients must have the image's size");
  const std::size_t n = means.shape(0), rest = shN.shape(1);
  Outputs out{new_array<float>({n, 3}),
              new_array<float>({n, 4}),
              new_array<float>({n, 3}),
              new_array<float>({n}),
              new_array<float>({n, 1, 3}),
              std::nullopt,
              std::nullopt};
  if (with_rest) std::get<5>(out) = new_array<float>({n, rest, 3});
  if (offsets) std::get<6>(out) = new_array<float>({n, 2});
  const auto pointer = [](Output& array) { return static_cast<float*>(array.data()); };
  const Gradients gradients{pointer(std::get<0>(out)),
                            pointer(std::get<1>(out)),
                            pointer(std::get<2>(out)),
                            pointer(std::get<3>(out)),
                            pointer(std::get<4>(out)),
                            with_rest ? pointer(*std::get<5>(out)) : nullptr,
                            offsets ? pointer(*std::get<6>(out)) : nullptr};
  bool enough = true;
  {
    nb::gil_scoped_release release;
    try {
      render_backward(threads, parameters, *frame, image_gradient.data(), alpha_gradient.data(),
                      gradients);
    } catch (const std::bad_alloc&) {
      enough = false;
    }
  }
  if (!enough) throw_memory(*frame);
  return out;
}

View make_view(const Matrix4& viewmat, const std::array<float, 4>& intrinsics, int width,
               int height, float near, float eps2d, float alpha_min, float alpha_max,
               float transmittance_min, bool antialiased, bool absgrad,
               const std::array<float, 3>& background, int degree,
               const std::array<bool, 5>& skips) {
  if (width < 1 || height < 1) throw nb::value_error("width and height must be at least 1");
  if (degree < 0 || degree > 3) throw nb::value_error("sh_degree must be 0 to 3");
  View v;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k)
      v.rotation[3 * i + k] = viewmat[static_cast<std::size_t>(4 * i + k)];
    v.translation[i] = viewmat[static_cast<std::size_t>(4 * i + 3)];
    v.background[i] = background[static_cast<std::size_t>(i)];
  }
  for (int k = 0; k < 3; ++k) {
    double position = 0.0;
    for (int i = 0; i < 3; ++i)
      position -=
          static_cast<double>(v.rotation[3 * i + k]) * static_cast<double>(v.translation[i]);
    v.position[k] = static_cast<float>(position);
  }
  v.fx = intrinsics[0];
  v.fy = intrinsics[1];
  v.cx = intrinsics[2];
  v.cy = intrinsics[3];
  v.width = width;
  v.height = height;
  v.near = near;
  v.eps2d = eps2d;
  v.alpha_min = std::max(alpha_min, std::numeric_limits<float>::min());
  v.level_min = std::log2(v.alpha_min);
  v.alpha_max = alpha_max;
  v.transmittance_min = transmittance_min;
  v.antialiased = antialiased;
  v.absgrad = absgrad;
  v.degree = degree;
  v.skips = {skips[0], skips[1], skips[2], skips[3], skips[4]};
  return v;
}

Output visible_of(LentFrame& frame) {
  const auto count = static_cast<std::size_t>(frame->gaussians);
  Output out = new_array<bool>({count});
  bool* visible = static_cast<bool*>(out.data());
  for (std::size_t i = 0; i < count; ++i)
    visible[i] = (frame->visible[i / 16] >> (i % 16) & 1) != 0;
  return out;
}

nb::dict timings_of(LentFrame& frame) {
  const Timings& t = frame->timings;
  nb::dict out;
  out["project"] = t.project;
  out["sort"] = t.sort;
  out["bin"] = t.bin;
  out["composite"] = t.composite;
  out["composite_backward"] = t.composite_backward;
  out["project_backward"] = t.project_backward;
  return out;
}

}  // namespace

void bind_raster(nb::module_& m) {
  nb::class_<View>(m, "View", "A camera and the settings of the rasterizer.")
      .def_static("make", &make_view, nb::kw_only(), "viewmat"_a, "intrinsics"_a, "width"_a,
                  "height"_a, "near"_a, "eps2d"_a, "alpha_min"_a, "alpha_max"_a,
                  "transmittance_min"_a, "antialiased"_a, "absgrad"_a, "background"_a,
                  "sh_degree"_a, "skips"_a,
                  "skips: out_of_view, sub_threshold, tiles, blocks, saturated.");
  nb::class_<LentFrame>(m, "Frame", "One rendered view's memory, from forward to backward.")
      .def(nb::init<>())
      .def("forward", &forward, "view"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh0"_a,
           "shN"_a, "offsets"_a.none(), "threads"_a, "Render: image [H, W, 3], alpha [H, W].")
      .def("backward", &backward, "image_gradient"_a, "alpha_gradient"_a, "means"_a, "quats"_a,
           "scales"_a, "opacities"_a, "sh0"_a, "shN"_a, "offsets"_a.none(), "with_rest"_a,
           "threads"_a,
           "Gradients of the parameters, in their order (shN's if with_rest), and of the offsets "
           "if\n"
           "there are any.")
      .def("visible", &visible_of, "Which Gaussians are visible: [N] bool.")
      .def_prop_ro(
          "pairs", [](LentFrame& f) { return f->pairs(); }, "(tile, Gaussian) pairs.")
      .def_prop_ro(
          "evaluations", [](LentFrame& f) { return f->evaluations(); },
          "Pixels that a Gaussian's alpha was computed at.")
      .def_prop_ro(
          "bytes", [](LentFrame& f) { return f->bytes(); },
          "Memory in use, that of the backward pass included.")
      .def_prop_ro("timings", &timings_of, "Milliseconds of each stage.");
}

}  // namespace xrgs
