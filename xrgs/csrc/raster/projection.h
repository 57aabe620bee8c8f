// The projection of Gaussians to ellipses in the image plane (EWA splatting), sixteen at a time.
// docs/rasterizer.md derives it (Eq. 1 to 7 and 10).
#pragma once

#include "raster/types.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {

// How far outside the image the Jacobian may be evaluated, as a fraction of half the field of view
// (Eq. 3): the 1.3 of gsplat and of the original 3DGS code, around the true principal point.
constexpr float kClampMargin = 0.3f;

// Gaussians at this depth or farther, world units, are not visible: its reciprocal is denormal.
constexpr float kDepthEnd = 8e37f;

// If the determinant of the 2D covariance is kHugeDet px^4 or more, the unit of the image plane is
// kHugePixel px, so that the determinant and its gradient are in the range of float32.
constexpr float kHugeDet = 1e30f, kHugePixel = 4294967296.0f;

struct Vector3 {
  Floats x, y, z;
};

XRGS_INLINE Floats dot(const Vector3& a, const Vector3& b) {
  return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}
XRGS_INLINE Vector3 cross(const Vector3& a, const Vector3& b) {
  return {fnma(a.z, b.y, a.y * b.z), fnma(a.x, b.z, a.z * b.x), fnma(a.y, b.x, a.x * b.y)};
}
// a + k b
XRGS_INLINE Vector3 add_scaled(const Vector3& a, Floats k, const Vector3& b) {
  return {fma(k, b.x, a.x), fma(k, b.y, a.y), fma(k, b.z, a.z)};
}
XRGS_INLINE Vector3 times(Floats k, const Vector3& a) { return {k * a.x, k * a.y, k * a.z}; }

// The activated parameters of sixteen Gaussians, without their colours.
struct GaussianInputs {
  Vector3 mean, scale;
  Floats qw, qx, qy, qz, opacity, offset_x, offset_y;
};

// The rows `group`..group+15 of an array [N, width]. Rows past the last one are replaced by zeros.
struct PaddedRows {
  float values[64];
  const float* of(const float* all, std::int64_t group, int lanes, int width) {
    if (lanes == 16) return all + group * width;
    for (int i = 0; i < 16 * width; ++i)
      values[i] = i < lanes * width ? all[group * width + i] : 0.0f;
    return values;
  }
};

// Loads the Gaussians group..group+lanes-1, and applies the activation functions if `raw`. Lanes
// past the last Gaussian are zeros.
XRGS_INLINE GaussianInputs load_inputs(const GaussianParameters& p, bool raw, std::int64_t group,
                                       int lanes) {
  GaussianInputs in;
  PaddedRows padded;
  load_triples(padded.of(p.means, group, lanes, 3), in.mean.x, in.mean.y, in.mean.z);
  load_quadruples(padded.of(p.quats, group, lanes, 4), in.qw, in.qx, in.qy, in.qz);
  load_triples(padded.of(p.scales, group, lanes, 3), in.scale.x, in.scale.y, in.scale.z);
  in.opacity = load(padded.of(p.opacities, group, lanes, 1));
  if (raw) {
    in.scale = {exp(in.scale.x), exp(in.scale.y), exp(in.scale.z)};
    in.opacity = logistic(in.opacity);
  }
  in.offset_x = in.offset_y = broadcast(0.0f);
  if (p.means2d_offset != nullptr) {
    const float* offsets = padded.of(p.means2d_offset, group, lanes, 2);
    deinterleave(load(offsets), load(offsets + 16), in.offset_x, in.offset_y);
  }
  return in;
}

// A unit quaternion, its rotation matrix, and 1 / the length of the quaternion before
// normalisation. For a tiny quaternion, inv_length is that of kTinyScale times the quaternion.
struct Rotation {
  Floats w, x, y, z, inv_length;
  Mask tiny;
  Vector3 row[3];
};

constexpr float kSmallestNormal = 1.17549435e-38f;

// Quaternions whose components are all below the first number are multiplied by the second, 2^64.
constexpr float kTinyQuaternion = 1.0842022e-19f, kTinyScale = 18446744073709551616.0f;

// kTinyScale times a tiny number. Arithmetic treats denormal numbers as zeros, so these are
// converted as integers, multiples of 2^-149.
XRGS_INLINE Floats scale_tiny(Floats a) {
  const Floats unit = broadcast(2.5849394e-26f);  // kTinyScale 2^-149
  const Floats sign = to_floats(shift_right<31>(as_ints(a)));  // 0 or -1
  const Floats denormal = unit * to_floats(as_ints(abs(a)));
  return select(abs(a) < broadcast(kSmallestNormal), fma(sign + sign, denormal, denormal),
                broadcast(kTinyScale) * a);
}

// The zero quaternion becomes the identity, with an inv_length of zero, so it has no gradient.
XRGS_INLINE Rotation quat_to_rotation(const GaussianInputs& in) {
  // Divided by the largest component first, so that the squares neither overflow nor underflow.
  // Both are divided by four before, since the reciprocal of the largest numbers is denormal.
  const Floats one = broadcast(1.0f), quarter = broadcast(0.25f);
  Floats qw = in.qw, qx = in.qx, qy = in.qy, qz = in.qz;
  Floats largest = max(max(abs(qw), abs(qx)), max(abs(qy), abs(qz)));
  Rotation r;
  r.tiny = largest < broadcast(kTinyQuaternion);
  if (any(r.tiny)) {
    qw = select(r.tiny, scale_tiny(qw), qw);
    qx = select(r.tiny, scale_tiny(qx), qx);
    qy = select(r.tiny, scale_tiny(qy), qy);
    qz = select(r.tiny, scale_tiny(qz), qz);
    largest = max(max(abs(qw), abs(qx)), max(abs(qy), abs(qz)));
  }
  const Mask zero = largest == broadcast(0.0f);
  const Floats inv_largest = one / (quarter * select(zero, one, largest));
  r.w = select(zero, one, quarter * qw * inv_largest);
  r.x = select(zero, broadcast(0.0f), quarter * qx * inv_largest);
  r.y = select(zero, broadcast(0.0f), quarter * qy * inv_largest);
  r.z = select(zero, broadcast(0.0f), quarter * qz * inv_largest);
  const Floats inv = one / sqrt(fma(r.w, r.w, fma(r.x, r.x, fma(r.y, r.y, r.z * r.z))));
  r.inv_length = select(zero, broadcast(0.0f), quarter * inv * inv_largest);
  r.w = r.w * inv;
  r.x = r.x * inv;
  r.y = r.y * inv;
  r.z = r.z * inv;
  const Floats x2 = r.x + r.x, y2 = r.y + r.y, z2 = r.z + r.z;
  r.row[0] = {one - fma(y2, r.y, z2 * r.z), fnma(z2, r.w, x2 * r.y), fma(y2, r.w, x2 * r.z)};
  r.row[1] = {fma(z2, r.w, x2 * r.y), one - fma(x2, r.x, z2 * r.z), fnma(x2, r.w, y2 * r.z)};
  r.row[2] = {fnma(y2, r.w, x2 * r.z), fma(x2, r.w, y2 * r.z), one - fma(x2, r.x, y2 * r.y)};
  return r;
}

// All intermediate values between the parameters and the conic, for forward and backward pass.
struct Projection {
  Floats x, y, z, inv_z;    // the mean in camera coordinates (Eq. 1)
  Floats slope_x, slope_y;  // x/z and y/z, clamped (Eq. 3)
  Mask slope_x_unclamped, slope_y_unclamped;
  Rotation rotation;
  Vector3 axis[3];        // the rows of A (Eq. 4)
  Vector3 m_x, m_y;       // the rows of M = J A, px (Eq. 4)
  Vector3 normal;         // m_x cross m_y
  Floats xx, xy, yy;      // the dilated 2D covariance, px^2 (Eq. 5)
  Floats eps;             // eps2d, px^2
  Floats sqrt_det2d;      // |normal|: root of the determinant before dilation
  Floats det;             // of the dilated covariance (Eq. 6)
  Floats opacity;         // compensated if antialiased (Eq. 10)
  Floats mean_x, mean_y;  // px (Eq. 2)
  Mask in_front;          // of the near plane, and nearer than kDepthEnd
  Mask huge;              // whether m_x, m_y and values derived from them are in kHugePixel px
  Floats unit;            // 1 / kHugePixel if huge, else 1
};

// Clamps a slope to the field of view and a margin (Eq. 3); `size` is the width or height in px.
XRGS_INLINE Floats clamp_slope(Floats slope, float focal, float centre, float size,
                               Mask& unclamped) {
  const float before = centre / focal, after = (size - centre) / focal;
  const float margin = kClampMargin * 0.5f * (before + after);
  const Floats low = broadcast(-before - margin), high = broadcast(after + margin);
  unclamped = (low <= slope) & (slope <= high);
  return clamp(slope, low, high);
}

// Sets the members that are derived from m_x, m_y and eps (Eq. 5 and 6).
XRGS_INLINE void set_covariance(Projection& o) {
  o.normal = cross(o.m_x, o.m_y);
  const Floats xx = dot(o.m_x, o.m_x), yy = dot(o.m_y, o.m_y), det2d = dot(o.normal, o.normal);
  o.sqrt_det2d = sqrt(det2d);
  o.det = det2d + fma(o.eps, xx + yy, o.eps * o.eps);
  o.xx = xx + o.eps;
  o.xy = dot(o.m_x, o.m_y);
  o.yy = yy + o.eps;
}

XRGS_INLINE Projection project_inputs(const GaussianInputs& in, const RenderConfig& config) {
  Projection o;
  const float* r = config.rotation;
  const Vector3 row[3] = {{broadcast(r[0]), broadcast(r[1]), broadcast(r[2])},
                          {broadcast(r[3]), broadcast(r[4]), broadcast(r[5])},
                          {broadcast(r[6]), broadcast(r[7]), broadcast(r[8])}};
  o.x = dot(row[0], in.mean) + broadcast(config.translation[0]);
  o.y = dot(row[1], in.mean) + broadcast(config.translation[1]);
  o.z = dot(row[2], in.mean) + broadcast(config.translation[2]);
  o.in_front = (broadcast(config.near) < o.z) & (abs(o.z) < broadcast(kDepthEnd));
  o.z = select(o.in_front, o.z, broadcast(1.0f));
  o.inv_z = broadcast(1.0f) / o.z;
  const Floats focal_x = broadcast(config.fx) * o.inv_z, focal_y = broadcast(config.fy) * o.inv_z;
  o.mean_x = fma(focal_x, o.x, broadcast(config.cx)) + in.offset_x;
  o.mean_y = fma(focal_y, o.y, broadcast(config.cy)) + in.offset_y;
  o.slope_x = clamp_slope(o.x * o.inv_z, config.fx, config.cx, static_cast<float>(config.width),
                          o.slope_x_unclamped);
  o.slope_y = clamp_slope(o.y * o.inv_z, config.fy, config.cy, static_cast<float>(config.height),
                          o.slope_y_unclamped);

  o.rotation = quat_to_rotation(in);
  for (int i = 0; i < 3; ++i) {
    Vector3 a = times(row[i].x, o.rotation.row[0]);
    a = add_scaled(a, row[i].y, o.rotation.row[1]);
    a = add_scaled(a, row[i].z, o.rotation.row[2]);
    o.axis[i] = {a.x * in.scale.x, a.y * in.scale.y, a.z * in.scale.z};
  }
  o.m_x = times(focal_x, add_scaled(o.axis[0], -o.slope_x, o.axis[2]));
  o.m_y = times(focal_y, add_scaled(o.axis[1], -o.slope_y, o.axis[2]));
  o.eps = broadcast(config.eps2d);
  set_covariance(o);
  o.huge = broadcast(kHugeDet) <= o.det;
  o.unit = broadcast(1.0f);
  if (any(o.huge)) {
    o.unit = select(o.huge, broadcast(1.0f / kHugePixel), o.unit);
    o.m_x = times(o.unit, o.m_x);
    o.m_y = times(o.unit, o.m_y);
    o.eps = o.unit * o.unit * o.eps;
    set_covariance(o);
  }
  o.opacity = in.opacity;
  if (config.antialiased)
    o.opacity = in.opacity * (o.sqrt_det2d / sqrt(max(o.det, broadcast(1e-37f))));
  return o;
}

// The Cholesky factor of half the conic (Eq. 7): the exponent is -u^2 - v^2 with u = xx dx - xy dy
// and v = yy dy.
struct ConicFactor {
  Floats xx, xy, yy;
};

XRGS_INLINE ConicFactor conic_factor(const Projection& o) {
  const Floats half = broadcast(0.5f);
  const Floats xx = sqrt(half * (o.yy / o.det));
  return {xx, xx * (o.xy / o.yy), sqrt(half / o.yy)};
}

}  // namespace XRGS_NS
}  // namespace xrgs
