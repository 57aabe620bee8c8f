// The backward projection: from the rows of pair_grads to the gradients of the parameters.
//
// The rows of a Gaussian are added in the order of its tiles, so the result does not depend on the
// threads. The chain rule is then applied to the Cholesky factor of the conic, the covariance, the
// projection, the rotation and the spherical harmonics (Eq. 19 to 32), for sixteen Gaussians at a
// time. Gaussians that are not visible get zeros. The coefficients of the harmonics are not read,
// see ColorDerivatives.
#include <cstring>

#include "raster/sh.h"
#include "raster/stages.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Number of a Gaussian's rows that are added without a branch, with zeros for missing rows. Most
// Gaussians have no more rows, and their number is unpredictable for the processor.
constexpr std::uint32_t kFewPairs = 4;
alignas(64) constexpr float kNoPair[kPairGradStride] = {};

XRGS_INLINE void sum_pair_grads(const Frame& frame, const float* pair_grads, std::int64_t group,
                                std::uint32_t visible, Floats (&out)[16]) {
  for (int i = 0; i < 16; ++i) {
    PairRange range{0, 0};
    if ((visible >> i & 1u) != 0) range = frame.pair_ranges[static_cast<std::size_t>(group + i)];
    const float* row = pair_grads + std::size_t{range.first} * kPairGradStride;
    Floats sum = load(range.count > 0 ? row : kNoPair);
    for (std::uint32_t k = 1; k < kFewPairs; ++k)
      sum += load(k < range.count ? row + k * kPairGradStride : kNoPair);
    for (std::uint32_t k = kFewPairs; k < range.count; ++k)
      sum += load(row + std::size_t{k} * kPairGradStride);
    out[i] = sum;
  }
  transpose(out);
}

// The gradients of the projected mean, of the dilated 2D covariance and of its determinant, which
// is treated as a fourth independent variable.
struct ConicGradient {
  Floats xx, xy, yy, det;
  Floats mean_x, mean_y;
};

// The gradients of the conic's factor, from u = xx dx - xy dy, v = yy dy and ln alpha = ln(opacity)
// - u^2 - v^2, and from these the gradients of the covariance (Eq. 20, 22 and 23).
XRGS_INLINE ConicGradient conic_factor_backward(const Projection& o, const Floats (&sum)[16]) {
  const ConicFactor factor = conic_factor(o);
  const Floats two = broadcast(2.0f);
  const Floats inv_yy = broadcast(1.0f) / o.yy;
  // Half the gradients of ln(factor.xx), for constant factor.xy / factor.xx, and of ln(factor.yy).
  const Floats half_v_log_xx = -sum[kGradUU];
  const Floats half_v_log_yy = -(factor.yy * factor.yy * sum[kGradDyDy]);
  const Floats v_factor_xy = two * sum[kGradUDy];
  ConicGradient v;
  v.xx = broadcast(0.0f);
  v.xy = v_factor_xy * factor.xx * inv_yy;
  v.yy = inv_yy * fnma(v_factor_xy, factor.xy, half_v_log_xx - half_v_log_yy);
  v.det = sum[kGradUU] / o.det;
  v.mean_x = two * factor.xx * sum[kGradU];
  v.mean_y = two * fnma(factor.xy, sum[kGradU], factor.yy * factor.yy * sum[kGradDy]);
  return v;
}

// The gradients of the rows of M (Eq. 24 and 25). v_opacity is that of the compensated opacity and
// becomes that of the parameter.
XRGS_INLINE void covariance_backward(const Projection& o, const RenderConfig& config,
                                     const GaussianInputs& in, ConicGradient v, Floats& v_opacity,
                                     Vector3& v_m_x, Vector3& v_m_y) {
  const Floats zero = broadcast(0.0f), half = broadcast(0.5f);
  Floats v_sqrt_det2d_ratio = zero;  // dL/d(sqrt_det2d) / sqrt_det2d
  if (config.antialiased) {
    const Floats inv_root = broadcast(1.0f) / sqrt(max(o.det, broadcast(1e-37f)));
    v.det = v.det - half * v_opacity * o.opacity / o.det;
    v_sqrt_det2d_ratio =
        select(zero < o.sqrt_det2d, v_opacity * in.opacity * inv_root / o.sqrt_det2d, zero);
    v_opacity = v_opacity * o.sqrt_det2d * inv_root;
  }
  v.xx = fma(o.eps, v.det, v.xx);
  v.yy = fma(o.eps, v.det, v.yy);
  const Vector3 v_normal = times(fma(broadcast(2.0f), v.det, v_sqrt_det2d_ratio), o.normal);
  v_m_x = add_scaled(add_scaled(cross(o.m_y, v_normal), v.xx + v.xx, o.m_x), v.xy, o.m_y);
  v_m_y = add_scaled(add_scaled(cross(v_normal, o.m_x), v.yy + v.yy, o.m_y), v.xy, o.m_x);
}

// The gradient of the quaternion, given that of the rows of its rotation matrix (Eq. 30).
XRGS_INLINE void quaternion_backward(const Rotation& r, const Vector3 (&v)[3], Floats (&out)[4]) {
  const Floats two = broadcast(2.0f);
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
  if (any(r.tiny))
    for (int i = 0; i < 4; ++i) out[i] = select(r.tiny, broadcast(kTinyScale) * out[i], out[i]);
}

// Converts sums over pixels to units of the large pixels for huge Gaussians (kHugePixel).
XRGS_INLINE void to_huge_pixels(Floats unit, Floats (&sum)[16]) {
  sum[kGradDy] = unit * sum[kGradDy];
  sum[kGradUDy] = unit * sum[kGradUDy];
  sum[kGradDyDy] = unit * (unit * sum[kGradDyDy]);
}

// Converts a projection, and the gradients of its rows of M and of its mean, to pixels.
XRGS_INLINE void to_pixels(Projection& o, ConicGradient& v, Vector3& v_m_x, Vector3& v_m_y) {
  const Floats inv_unit = select(o.huge, broadcast(kHugePixel), broadcast(1.0f));
  o.m_x = times(inv_unit, o.m_x);
  o.m_y = times(inv_unit, o.m_y);
  v_m_x = times(o.unit, v_m_x);
  v_m_y = times(o.unit, v_m_y);
  v.mean_x = o.unit * v.mean_x;
  v.mean_y = o.unit * v.mean_y;
}

struct GeometryGradient {
  Vector3 mean, scale;
  Floats quat[4];
};

// Whether all gradients of the visible Gaussians are finite. The gradients of shN need no test:
// they are products of the colour's gradient and a basis function, which is at most 1.
XRGS_INLINE bool all_finite(const GeometryGradient& v, const Vector3& v_color, Floats v_opacity,
                            Floats v_offset_x, Floats v_offset_y, std::uint32_t visible) {
  const Floats zero = broadcast(0.0f);
  Floats sum = v_opacity * zero;  // stays zero: infinity or NaN times zero is NaN
  for (Floats part :
       {v.mean.x, v.mean.y, v.mean.z, v.scale.x, v.scale.y, v.scale.z, v.quat[0], v.quat[1],
        v.quat[2], v.quat[3], v_color.x, v_color.y, v_color.z, v_offset_x, v_offset_y})
    sum = fma(part, zero, sum);
  return (visible & ~to_bits(sum == zero)) == 0;
}

// The gradients of means, scales and quaternions, from those of the rows of M and of the projected
// mean (Eq. 26 to 30).
XRGS_INLINE GeometryGradient projection_backward(const Projection& o, const RenderConfig& config,
                                                 const GaussianInputs& in, const Vector3& v_m_x,
                                                 const Vector3& v_m_y, Floats v_mean2d_x,
                                                 Floats v_mean2d_y) {
  const Floats zero = broadcast(0.0f);
  const Floats focal_x = broadcast(config.fx) * o.inv_z, focal_y = broadcast(config.fy) * o.inv_z;
  // The gradients of the rows of A.
  const Vector3 a0 = times(focal_x, v_m_x), a1 = times(focal_y, v_m_y);
  const Vector3 a2 = add_scaled(times(-o.slope_x, a0), -o.slope_y, a1);
  const Floats v_slope_x = select(o.slope_x_unclamped, -dot(a0, o.axis[2]), zero);
  const Floats v_slope_y = select(o.slope_y_unclamped, -dot(a1, o.axis[2]), zero);
  // Both the slopes and the projected means depend on x/z and y/z.
  const Floats v_x_over_z = fma(broadcast(config.fx), v_mean2d_x, v_slope_x);
  const Floats v_y_over_z = fma(broadcast(config.fy), v_mean2d_y, v_slope_y);
  Vector3 v_camera;
  v_camera.x = v_x_over_z * o.inv_z;
  v_camera.y = v_y_over_z * o.inv_z;
  v_camera.z =
      -o.inv_z * (fma(v_camera.x, o.x, v_camera.y * o.y) + dot(v_m_x, o.m_x) + dot(v_m_y, o.m_y));

  const float* r = config.rotation;
  const auto world_row = [r](const Vector3& c0, const Vector3& c1, const Vector3& c2, int k) {
    return add_scaled(add_scaled(times(broadcast(r[k]), c0), broadcast(r[3 + k]), c1),
                      broadcast(r[6 + k]), c2);
  };
  GeometryGradient out;
  Floats* mean[3] = {&out.mean.x, &out.mean.y, &out.mean.z};
  Vector3 v_rotation[3];
  out.scale = {zero, zero, zero};
  for (int k = 0; k < 3; ++k) {
    *mean[k] = fma(broadcast(r[k]), v_camera.x,
                   fma(broadcast(r[3 + k]), v_camera.y, broadcast(r[6 + k]) * v_camera.z));
    const Vector3 row = world_row(a0, a1, a2, k);  // of rotation diag(scale)
    const Vector3& q = o.rotation.row[k];
    out.scale = {fma(row.x, q.x, out.scale.x), fma(row.y, q.y, out.scale.y),
                 fma(row.z, q.z, out.scale.z)};
    v_rotation[k] = {row.x * in.scale.x, row.y * in.scale.y, row.z * in.scale.z};
  }
  quaternion_backward(o.rotation, v_rotation, out.quat);
  return out;
}

// Writes the gradients of sixteen Gaussians to an array [N, width]: directly to its rows, or for an
// incomplete group to a buffer that copy_out() copies to the rows.
struct GroupWriter {
  std::int64_t group;
  int lanes;
  float buffer[64];

  GroupWriter(std::int64_t first, int count) : group(first), lanes(count) {}
  float* target(float* all, int width) { return lanes == 16 ? all + group * width : buffer; }
  void copy_out(float* all, int width) {
    if (lanes == 16) return;
    for (int i = 0; i < lanes * width; ++i) all[group * width + i] = buffer[i];
  }
};

void zero_floats(float* p, std::int64_t count) {
  std::memset(p, 0, static_cast<std::size_t>(count) * 4);
}

// Writes the gradients of sh0 and, if wanted, of shN (Eq. 31). Sets v to the gradient of the
// colour, and returns the gradient of the mean through the viewing direction (Eq. 32).
template <int Degree>
XRGS_INLINE Vector3 color_backward(const GaussianParameters& p, const RenderConfig& config,
                                   const GaussianInputs& in, const ColorDerivatives& derivatives,
                                   const Floats (&sum)[16], std::int64_t group, int lanes,
                                   const ParameterGradients& out, ShGradientRows& sh_rows,
                                   Vector3& v) {
  constexpr int kRest = rest_basis_count(Degree);
  Floats inv_distance;
  const Vector3 d = view_direction(in.mean, config.camera_position, inv_distance);
  v = {select_or_zero(mask_from_bits(derivatives.unclamped[0]), sum[kGradRed]),
       select_or_zero(mask_from_bits(derivatives.unclamped[1]), sum[kGradGreen]),
       select_or_zero(mask_from_bits(derivatives.unclamped[2]), sum[kGradBlue])};
  GroupWriter writer(group, lanes);
  store_triples(writer.target(out.sh0, 3), broadcast(kC0) * v.x, broadcast(kC0) * v.y,
                broadcast(kC0) * v.z);
  writer.copy_out(out.sh0, 3);
  Vector3 v_mean{broadcast(0.0f), broadcast(0.0f), broadcast(0.0f)};
  if constexpr (kRest > 0) {
    const auto by_axis = [&](int axis) {
      return Vector3{load(derivatives.dcolor_ddir[axis]), load(derivatives.dcolor_ddir[3 + axis]),
                     load(derivatives.dcolor_ddir[6 + axis])};
    };
    const Vector3 v_d{dot(by_axis(0), v), dot(by_axis(1), v), dot(by_axis(2), v)};
    v_mean = times(inv_distance, add_scaled(v_d, -dot(v_d, d), d));
  }
  if (out.shN == nullptr) return v_mean;
  ShGradientFactors factors;
  store_basis<Degree>(d, factors);
  store_triples(factors.v_color, v.x, v.y, v.z);
  const std::int64_t stride = std::int64_t{p.rest_count} * 3;
  for (int i = 0; i < 16; ++i) store_gradient_row<Degree>(factors, i, stride, sh_rows);
  float* target = out.shN + group * p.rest_count * 3;
  const int count = lanes * p.rest_count * 3;
  if (lanes == 16)  // on a 64-byte boundary, as the array and sixteen rows of any width are
    for (int i = 0; i < count; i += 16) stream(target + i, load(sh_rows.rows + i));
  else
    for (int i = 0; i < count; ++i) target[i] = sh_rows.rows[i];
  return v_mean;
}

void write_zeros(const GaussianParameters& p, std::int64_t group, int lanes,
                 const ParameterGradients& out) {
  zero_floats(out.means + group * 3, lanes * 3);
  zero_floats(out.quats + group * 4, lanes * 4);
  zero_floats(out.scales + group * 3, lanes * 3);
  zero_floats(out.opacities + group, lanes);
  zero_floats(out.sh0 + group * 3, lanes * 3);
  if (out.shN != nullptr)
    zero_floats(out.shN + group * p.rest_count * 3, std::int64_t{lanes} * p.rest_count * 3);
  if (out.means2d_offset != nullptr) zero_floats(out.means2d_offset + group * 2, lanes * 2);
}

// Writes the gradients of all parameters except the colours.
void write_geometry(const GeometryGradient& v, Floats v_opacity, Floats v_mean2d_x,
                    Floats v_mean2d_y, Mask visible, std::int64_t group, int lanes,
                    const ParameterGradients& out) {
  GroupWriter writer(group, lanes);
  store_triples(writer.target(out.means, 3), select_or_zero(visible, v.mean.x),
                select_or_zero(visible, v.mean.y), select_or_zero(visible, v.mean.z));
  writer.copy_out(out.means, 3);
  store_triples(writer.target(out.scales, 3), select_or_zero(visible, v.scale.x),
                select_or_zero(visible, v.scale.y), select_or_zero(visible, v.scale.z));
  writer.copy_out(out.scales, 3);
  store_quadruples(writer.target(out.quats, 4), select_or_zero(visible, v.quat[0]),
                   select_or_zero(visible, v.quat[1]), select_or_zero(visible, v.quat[2]),
                   select_or_zero(visible, v.quat[3]));
  writer.copy_out(out.quats, 4);
  store(writer.target(out.opacities, 1), select_or_zero(visible, v_opacity));
  writer.copy_out(out.opacities, 1);
  if (out.means2d_offset == nullptr) return;
  Floats low, high;
  interleave(select_or_zero(visible, v_mean2d_x), select_or_zero(visible, v_mean2d_y), low, high);
  float* offsets = writer.target(out.means2d_offset, 2);
  store(offsets, low);
  store(offsets + 16, high);
  writer.copy_out(out.means2d_offset, 2);
}

// Writes the gradients of Gaussians group..group+lanes-1. Returns whether all of them are finite.
template <int Degree>
bool backward_group(const GaussianParameters& p, const Frame& frame, const float* pair_grads,
                    std::int64_t group, int lanes, std::uint32_t visible,
                    const ParameterGradients& out, ShGradientRows& sh_rows) {
  const RenderConfig& config = frame.config;
  Floats sum[16];
  sum_pair_grads(frame, pair_grads, group, visible, sum);
  const GaussianInputs in = load_inputs(p, config.raw, group, lanes);
  Projection o = project_inputs(in, config);
  if (any(o.huge)) to_huge_pixels(o.unit, sum);
  ConicGradient v = conic_factor_backward(o, sum);
  Floats v_opacity = sum[kGrad] / o.opacity;  // Eq. 19
  Vector3 v_m_x, v_m_y;
  covariance_backward(o, config, in, v, v_opacity, v_m_x, v_m_y);
  if (any(o.huge)) to_pixels(o, v, v_m_x, v_m_y);
  GeometryGradient geometry = projection_backward(o, config, in, v_m_x, v_m_y, v.mean_x, v.mean_y);
  const ColorDerivatives& derivatives =
      frame.color_derivatives[static_cast<std::size_t>(group / 16)];
  Vector3 v_color;
  const Vector3 by_direction =
      color_backward<Degree>(p, config, in, derivatives, sum, group, lanes, out, sh_rows, v_color);
  geometry.mean = add_scaled(geometry.mean, broadcast(1.0f), by_direction);
  if (config.raw) {
    Vector3& scale = geometry.scale;
    scale = {exp_gradient(scale.x, in.scale.x), exp_gradient(scale.y, in.scale.y),
             exp_gradient(scale.z, in.scale.z)};
    v_opacity = logistic_gradient(v_opacity, in.opacity);
  }
  const Floats v_offset_x = config.absgrad ? sum[kAbsGradX] : v.mean_x;
  const Floats v_offset_y = config.absgrad ? sum[kAbsGradY] : v.mean_y;
  write_geometry(geometry, v_opacity, v_offset_x, v_offset_y, mask_from_bits(visible), group, lanes,
                 out);
  return all_finite(geometry, v_color, v_opacity, v_offset_x, v_offset_y, visible);
}

template <int Degree>
bool backward_degree(const GaussianParameters& p, const Frame& frame, const float* pair_grads,
                     std::int64_t first, std::int64_t last, const ParameterGradients& out) {
  ShGradientRows sh_rows;
  bool finite = true;
  for (std::int64_t group = first; group < last; group += 16) {
    const int lanes = last - group < 16 ? static_cast<int>(last - group) : 16;
    const std::uint32_t visible = frame.visible[static_cast<std::size_t>(group / 16)];
    if (visible == 0)
      write_zeros(p, group, lanes, out);
    else if (!backward_group<Degree>(p, frame, pair_grads, group, lanes, visible, out, sh_rows))
      finite = false;
  }
  stream_fence();
  return finite;
}

}  // namespace

bool project_backward(const GaussianParameters& p, const Frame& frame, const float* pair_grads,
                      std::int64_t first, std::int64_t last, const ParameterGradients& out) {
  switch (frame.config.sh_degree) {
    case 0:
      return backward_degree<0>(p, frame, pair_grads, first, last, out);
    case 1:
      return backward_degree<1>(p, frame, pair_grads, first, last, out);
    case 2:
      return backward_degree<2>(p, frame, pair_grads, first, last, out);
    default:
      return backward_degree<3>(p, frame, pair_grads, first, last, out);
  }
}

}  // namespace XRGS_NS
}  // namespace xrgs
