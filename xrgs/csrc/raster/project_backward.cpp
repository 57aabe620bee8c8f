// Projection, backward: from the sums of a Gaussian's pairs to the gradients of its parameters.
//
// A Gaussian's slots are added in the order in which its tiles were emitted, so the result does not
// depend on the threads. Then the chain rule back through whitening, covariance, projection,
// rotation and harmonics (geometry.h, sh.h), sixteen Gaussians in lanes; what is not visible gets
// zeros. The harmonics themselves, three quarters of a Gaussian, are not read: see Shade.
#include "raster/sh.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// How many slots of a Gaussian are added without a branch, those it lacks being zeros: most have no
// more, and how many is nothing that a processor could predict.
constexpr std::uint32_t kFewSlots = 4;
alignas(64) constexpr float kNoSlot[kSlotSize] = {};

XRGS_INLINE void sum_slots(const Frame& frame, const float* sums, std::int64_t group,
                           std::uint32_t visible, Floats (&out)[16]) {
  for (int i = 0; i < 16; ++i) {
    Slots slots{0, 0};
    if ((visible >> i & 1u) != 0) slots = frame.slots[static_cast<std::size_t>(group + i)];
    const float* slot = sums + std::size_t{slots.first} * kSlotSize;
    Floats sum = load(slots.count > 0 ? slot : kNoSlot);
    for (std::uint32_t k = 1; k < kFewSlots; ++k)
      sum += load(k < slots.count ? slot + k * kSlotSize : kNoSlot);
    for (std::uint32_t k = kFewSlots; k < slots.count; ++k)
      sum += load(slot + std::size_t{k} * kSlotSize);
    out[i] = sum;
  }
  transpose(out);
}

// Gradients of what whitening reads.
struct CovarianceGradient {
  Floats xx, xy, yy, det;
  Floats mean_x, mean_y;
};

// Through u = p dx - s dy, v = q dy, ln alpha = ln(opacity) - u^2 - v^2, and p, s, q of the
// covariance.
XRGS_INLINE CovarianceGradient whitening_backward(const Projected& o, const Floats (&sum)[16]) {
  const Whitening w = whiten(o);
  const Floats two = splat(2.0f), half = splat(0.5f);
  const Floats gu = fnma(w.s, sum[kGy], w.p * sum[kGx]);     // sum of g u
  const Floats gux = fnma(w.s, sum[kGxy], w.p * sum[kGxx]);  // of g u dx
  const Floats guy = fnma(w.s, sum[kGyy], w.p * sum[kGxy]);  // of g u dy
  const Floats inv_yy = splat(1.0f) / o.yy, ratio = o.xy * inv_yy;
  const Floats vs = two * guy;
  const Floats vq_q = -(two * w.q * w.q * sum[kGyy]);  // dL/dq times q
  const Floats vp_p = w.p * fma(vs, ratio, -(two * gux));
  CovarianceGradient v;
  v.xy = vs * w.p * inv_yy;
  v.yy = inv_yy * (half * (vp_p - vq_q) - vs * w.s);
  v.det = -(half * vp_p / o.det);
  v.xx = splat(0.0f);
  v.mean_x = two * w.p * gu;
  v.mean_y = two * fnma(w.s, gu, w.q * w.q * sum[kGy]);
  return v;
}

// The gradients of the image-plane axes; v_opacity becomes that of the uncompensated opacity.
XRGS_INLINE void covariance_backward(const Projected& o, const View& view, const Inputs& in,
                                     CovarianceGradient v, Floats& v_opacity, Vector3& v_m1,
                                     Vector3& v_m2) {
  const Floats zero = splat(0.0f), half = splat(0.5f), eps = splat(view.eps2d);
  Floats per_area = zero;  // dL/d(area) / area
  if (view.antialiased) {
    const Floats inv_root = splat(1.0f) / sqrt(max(o.det, splat(1e-37f)));
    v.det = v.det - half * v_opacity * o.opacity / o.det;
    per_area = select(zero < o.area, v_opacity * in.opacity * inv_root / o.area, zero);
    v_opacity = v_opacity * o.area * inv_root;
  }
  v.xx = fma(eps, v.det, v.xx);
  v.yy = fma(eps, v.det, v.yy);
  const Vector3 v_normal = times(fma(splat(2.0f), v.det, per_area), o.normal);
  v_m1 = add(add(cross(o.m2, v_normal), v.xx + v.xx, o.m1), v.xy, o.m2);
  v_m2 = add(add(cross(v_normal, o.m1), v.yy + v.yy, o.m2), v.xy, o.m1);
}

// The gradient of the unit quaternion from that of its rotation's rows, and through its length.
XRGS_INLINE void quaternion_backward(const Rotation& r, const Vector3 (&v)[3], Floats (&out)[4]) {
  const Floats two = splat(2.0f);
  const Floats d21 = v[2].y - v[1].z, d02 = v[0].z - v[2].x, d10 = v[1].x - v[0].y;
  const Floats s10 = v[1].x + v[0].y, s02 = v[0].z + v[2].x, s21 = v[2].y + v[1].z;
  Floats w = two * fma(r.x, d21, fma(r.y, d02, r.z * d10));
  Floats x = two * fma(r.y, s10, fma(r.z, s02, fnma(two * r.x, v[1].y + v[2].z, r.w * d21)));
  Floats y = two * fma(r.x, s10, fma(r.z, s21, fnma(two * r.y, v[0].x + v[2].z, r.w * d02)));
  Floats z = two * fma(r.x, s02, fma(r.y, s21, fnma(two * r.z, v[0].x + v[1].y, r.w * d10)));
  const Floats along = fma(w, r.w, fma(x, r.x, fma(y, r.y, z * r.z)));
  out[0] = r.inv_length * fnma(along, r.w, w);
  out[1] = r.inv_length * fnma(along, r.x, x);
  out[2] = r.inv_length * fnma(along, r.y, y);
  out[3] = r.inv_length * fnma(along, r.z, z);
}

struct ShapeGradient {
  Vector3 mean, scale;
  Floats quat[4];
};

// From image-plane axes and means to means, scales and quaternions.
XRGS_INLINE ShapeGradient projection_backward(const Projected& o, const View& view,
                                              const Inputs& in, const Vector3& v_m1,
                                              const Vector3& v_m2, Floats v_x2d, Floats v_y2d) {
  const Floats zero = splat(0.0f);
  const Floats focal_x = splat(view.fx) * o.inv_z, focal_y = splat(view.fy) * o.inv_z;
  const Vector3 a0 = times(focal_x, v_m1), a1 = times(focal_y, v_m2);
  const Vector3 a2 = add(times(-o.slope_x, a0), -o.slope_y, a1);
  const Floats v_slope_x = select(o.free_x, -dot(a0, o.axis[2]), zero);
  const Floats v_slope_y = select(o.free_y, -dot(a1, o.axis[2]), zero);
  // Slopes and means both move with x/z and y/z.
  const Floats v_xz = fma(splat(view.fx), v_x2d, v_slope_x),
               v_yz = fma(splat(view.fy), v_y2d, v_slope_y);
  Vector3 v_cam;
  v_cam.x = v_xz * o.inv_z;
  v_cam.y = v_yz * o.inv_z;
  v_cam.z = -o.inv_z * (fma(v_cam.x, o.x, v_cam.y * o.y) + dot(v_m1, o.m1) + dot(v_m2, o.m2));

  const float* r = view.rotation;
  const auto to_world = [r](const Vector3& c0, const Vector3& c1, const Vector3& c2, int k) {
    return add(add(times(splat(r[k]), c0), splat(r[3 + k]), c1), splat(r[6 + k]), c2);
  };
  ShapeGradient out;
  Floats* mean[3] = {&out.mean.x, &out.mean.y, &out.mean.z};
  Vector3 v_rotation[3];
  out.scale = {zero, zero, zero};
  for (int k = 0; k < 3; ++k) {
    *mean[k] = fma(splat(r[k]), v_cam.x, fma(splat(r[3 + k]), v_cam.y, splat(r[6 + k]) * v_cam.z));
    const Vector3 row = to_world(a0, a1, a2, k);  // of rotation diag(scale)
    const Vector3& q = o.rotation.row[k];
    out.scale = {fma(row.x, q.x, out.scale.x), fma(row.y, q.y, out.scale.y),
                 fma(row.z, q.z, out.scale.z)};
    v_rotation[k] = {row.x * in.scale.x, row.y * in.scale.y, row.z * in.scale.z};
  }
  quaternion_backward(o.rotation, v_rotation, out.quat);
  return out;
}

// Where sixteen Gaussians' gradients of `width` floats go: to their place, or for a group that is
// not whole to a buffer, and from there with `copy_out`.
struct Sixteen {
  std::int64_t group;
  int lanes;
  float buffer[64];

  Sixteen(std::int64_t first, int count) : group(first), lanes(count) {}
  float* of(float* all, int width) { return lanes == 16 ? all + group * width : buffer; }
  void copy_out(float* all, int width) {
    if (lanes == 16) return;
    for (int i = 0; i < lanes * width; ++i) all[group * width + i] = buffer[i];
  }
};

void zero_floats(float* p, std::int64_t count) {
  std::memset(p, 0, static_cast<std::size_t>(count) * 4);
}

// The colour's part: writes the gradients of the harmonics (of those above band 0 if they are
// wanted), returns that of the mean.
template <int Degree>
XRGS_INLINE Vector3 color_backward(const Parameters& p, const View& view, const Inputs& in,
                                   const Shade& shade, const Floats (&sum)[16], std::int64_t group,
                                   int lanes, const Gradients& out, Harmonics& harmonics) {
  constexpr int kRest = rest_of(Degree);
  Floats inv;
  const Vector3 d = direction_of(in.mean, view.position, inv);
  const Vector3 v{keep(mask_of(shade.open[0]), sum[kWr]), keep(mask_of(shade.open[1]), sum[kWg]),
                  keep(mask_of(shade.open[2]), sum[kWb])};
  Sixteen to(group, lanes);
  store_triples(to.of(out.sh0, 3), splat(kC0) * v.x, splat(kC0) * v.y, splat(kC0) * v.z);
  to.copy_out(out.sh0, 3);
  Vector3 v_mean{splat(0.0f), splat(0.0f), splat(0.0f)};
  if constexpr (kRest > 0) {
    const auto slope = [&](int axis) {
      return Vector3{load(shade.slope[axis]), load(shade.slope[3 + axis]),
                     load(shade.slope[6 + axis])};
    };
    const Vector3 v_d{dot(slope(0), v), dot(slope(1), v), dot(slope(2), v)};
    v_mean = times(inv, add(v_d, -dot(v_d, d), d));
  }
  if (out.shN == nullptr) return v_mean;
  harmonics_gradient<Degree>(d, v, p.rest, harmonics);
  float* place = out.shN + group * p.rest * 3;
  const int count = lanes * p.rest * 3;
  if (lanes == 16)  // on a 64-byte boundary, as the array and sixteen rows of any width are
    for (int i = 0; i < count; i += 16) stream(place + i, load(harmonics.rows + i));
  else
    for (int i = 0; i < count; ++i) place[i] = harmonics.rows[i];
  return v_mean;
}

void write_zeros(const Parameters& p, std::int64_t group, int lanes, const Gradients& out) {
  zero_floats(out.means + group * 3, lanes * 3);
  zero_floats(out.quats + group * 4, lanes * 4);
  zero_floats(out.scales + group * 3, lanes * 3);
  zero_floats(out.opacities + group, lanes);
  zero_floats(out.sh0 + group * 3, lanes * 3);
  if (out.shN != nullptr)
    zero_floats(out.shN + group * p.rest * 3, std::int64_t{lanes} * p.rest * 3);
  if (out.offsets != nullptr) zero_floats(out.offsets + group * 2, lanes * 2);
}

void write_shape(const ShapeGradient& v, Floats v_opacity, Floats v_x2d, Floats v_y2d, Mask visible,
                 std::int64_t group, int lanes, const Gradients& out) {
  Sixteen to(group, lanes);
  store_triples(to.of(out.means, 3), keep(visible, v.mean.x), keep(visible, v.mean.y),
                keep(visible, v.mean.z));
  to.copy_out(out.means, 3);
  store_triples(to.of(out.scales, 3), keep(visible, v.scale.x), keep(visible, v.scale.y),
                keep(visible, v.scale.z));
  to.copy_out(out.scales, 3);
  store_quadruples(to.of(out.quats, 4), keep(visible, v.quat[0]), keep(visible, v.quat[1]),
                   keep(visible, v.quat[2]), keep(visible, v.quat[3]));
  to.copy_out(out.quats, 4);
  store(to.of(out.opacities, 1), keep(visible, v_opacity));
  to.copy_out(out.opacities, 1);
  if (out.offsets == nullptr) return;
  Floats low, high;
  interleave(keep(visible, v_x2d), keep(visible, v_y2d), low, high);
  float* offsets = to.of(out.offsets, 2);
  store(offsets, low);
  store(offsets + 16, high);
  to.copy_out(out.offsets, 2);
}

template <int Degree>
void backward_sixteen(const Parameters& p, const Frame& frame, const float* sums,
                      std::int64_t group, int lanes, std::uint32_t visible, const Gradients& out,
                      Harmonics& harmonics) {
  const View& view = frame.view;
  Floats sum[16];
  sum_slots(frame, sums, group, visible, sum);
  const Inputs in = load_inputs(p, group, lanes);
  const Projected o = project_inputs(in, view);
  const CovarianceGradient v = whitening_backward(o, sum);
  Floats v_opacity = sum[kG] / o.opacity;
  Vector3 v_m1, v_m2;
  covariance_backward(o, view, in, v, v_opacity, v_m1, v_m2);
  ShapeGradient shape = projection_backward(o, view, in, v_m1, v_m2, v.mean_x, v.mean_y);
  const Shade& shade = frame.shades[static_cast<std::size_t>(group / 16)];
  const Vector3 by_color =
      color_backward<Degree>(p, view, in, shade, sum, group, lanes, out, harmonics);
  shape.mean = add(shape.mean, splat(1.0f), by_color);
  const Floats v_x2d = view.absgrad ? sum[kAbsX] : v.mean_x;
  const Floats v_y2d = view.absgrad ? sum[kAbsY] : v.mean_y;
  write_shape(shape, v_opacity, v_x2d, v_y2d, mask_of(visible), group, lanes, out);
}

template <int Degree>
void backward_degree(const Parameters& p, const Frame& frame, const float* sums, std::int64_t first,
                     std::int64_t last, const Gradients& out) {
  Harmonics harmonics;
  for (std::int64_t group = first; group < last; group += 16) {
    const int lanes = last - group < 16 ? static_cast<int>(last - group) : 16;
    const std::uint32_t visible = frame.visible[static_cast<std::size_t>(group / 16)];
    if (visible == 0)
      write_zeros(p, group, lanes, out);
    else
      backward_sixteen<Degree>(p, frame, sums, group, lanes, visible, out, harmonics);
  }
  stream_fence();
}

}  // namespace

void project_backward(const Parameters& p, const Frame& frame, const float* sums,
                      std::int64_t first, std::int64_t last, const Gradients& out) {
  switch (frame.view.degree) {
    case 0:
      return backward_degree<0>(p, frame, sums, first, last, out);
    case 1:
      return backward_degree<1>(p, frame, sums, first, last, out);
    case 2:
      return backward_degree<2>(p, frame, sums, first, last, out);
    default:
      return backward_degree<3>(p, frame, sums, first, last, out);
  }
}

}  // namespace XRGS_NS
}  // namespace xrgs
