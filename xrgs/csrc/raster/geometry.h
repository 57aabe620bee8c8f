// From a Gaussian in the world to an ellipse in the image: EWA, sixteen at a time.
//
// p_cam = R mean + t. The axes of the Gaussian in camera coordinates are A = R Q diag(scale), with
// Q the rotation of its quaternion. With the local affine approximation of the projection,
//   m1 = fx/z (A_0 - (x/z) A_2),  m2 = fy/z (A_1 - (y/z) A_2)     (A_i the rows of A)
// are the axes in the image, and the covariance is [m1; m2] [m1; m2]^T + eps I, whose determinant
// |m1 x m2|^2 + eps (|m1|^2 + |m2|^2) + eps^2 has no cancellation in this form. In m1 and m2 the
// slopes x/z and y/z are held within 1.3 times the field of view, beyond which the approximation
// blows up.
#pragma once

#include "raster/types.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {

constexpr float kClampMargin = 0.3f;  // of half the field of view

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
XRGS_INLINE Vector3 add(const Vector3& a, Floats k, const Vector3& b) {
  return {fma(k, b.x, a.x), fma(k, b.y, a.y), fma(k, b.z, a.z)};
}
XRGS_INLINE Vector3 times(Floats k, const Vector3& a) { return {k * a.x, k * a.y, k * a.z}; }

// Sixteen Gaussians' parameters but for their colour. `group` is the first one; lanes past the end
// are filled with zeros.
struct Inputs {
  Vector3 mean, scale;
  Floats qw, qx, qy, qz, opacity, offset_x, offset_y;
};

// `width` floats of each of sixteen Gaussians, those past the end replaced by zeros.
struct Padded {
  float values[64];
  const float* of(const float* all, std::int64_t group, int lanes, int width) {
    if (lanes == 16) return all + group * width;
    for (int i = 0; i < 16 * width; ++i)
      values[i] = i < lanes * width ? all[group * width + i] : 0.0f;
    return values;
  }
};

XRGS_INLINE Inputs load_inputs(const Parameters& p, std::int64_t group, int lanes) {
  Inputs in;
  Padded padded;
  load_triples(padded.of(p.means, group, lanes, 3), in.mean.x, in.mean.y, in.mean.z);
  load_quadruples(padded.of(p.quats, group, lanes, 4), in.qw, in.qx, in.qy, in.qz);
  load_triples(padded.of(p.scales, group, lanes, 3), in.scale.x, in.scale.y, in.scale.z);
  in.opacity = load(padded.of(p.opacities, group, lanes, 1));
  in.offset_x = in.offset_y = splat(0.0f);
  if (p.offsets != nullptr) {
    const float* both = padded.of(p.offsets, group, lanes, 2);
    deinterleave(load(both), load(both + 16), in.offset_x, in.offset_y);
  }
  return in;
}

// A unit quaternion, its rotation, and 1 / the length of the quaternion that it came from.
struct Rotation {
  Floats w, x, y, z, inv_length;
  Vector3 row[3];
};

// The zero quaternion is the identity, and its inv_length zero: it gets no gradient.
XRGS_INLINE Rotation rotation_of(const Inputs& in) {
  // Scaled by its largest part first: a tiny or a huge one has a length, too.
  const Floats one = splat(1.0f);
  const Floats largest = max(max(abs(in.qw), abs(in.qx)), max(abs(in.qy), abs(in.qz)));
  const Mask zero = largest < splat(1.0842022e-19f);  // the root of the smallest normal number
  const Floats inv_largest = one / select(zero, one, largest);
  Rotation r;
  r.w = select(zero, one, in.qw * inv_largest);
  r.x = select(zero, splat(0.0f), in.qx * inv_largest);
  r.y = select(zero, splat(0.0f), in.qy * inv_largest);
  r.z = select(zero, splat(0.0f), in.qz * inv_largest);
  const Floats inv = one / sqrt(fma(r.w, r.w, fma(r.x, r.x, fma(r.y, r.y, r.z * r.z))));
  r.inv_length = select(zero, splat(0.0f), inv * inv_largest);
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

struct Projected {
  Floats x, y, z, inv_z;    // camera coordinates
  Floats slope_x, slope_y;  // held within the field of view
  Mask free_x, free_y;      // where they were not held
  Rotation rotation;
  Vector3 axis[3];         // rows of A
  Vector3 m1, m2, normal;  // px; normal = m1 x m2
  Floats xx, xy, yy;       // dilated covariance, px^2
  Floats area, det;        // |normal|, and the determinant of the dilated covariance
  Floats opacity;          // compensated where antialiased
  Floats mean_x, mean_y;   // px
  Mask front;              // in front of the near plane
};

XRGS_INLINE Floats clamp_slope(Floats slope, float focal, float centre, float size, Mask& inside) {
  const float before = centre / focal, after = (size - centre) / focal;
  const float margin = kClampMargin * 0.5f * (before + after);
  const Floats low = splat(-before - margin), high = splat(after + margin);
  inside = (low <= slope) & (slope <= high);
  return clamp(slope, low, high);
}

XRGS_INLINE Projected project_inputs(const Inputs& in, const View& v) {
  Projected o;
  const float* r = v.rotation;
  const Vector3 row[3] = {{splat(r[0]), splat(r[1]), splat(r[2])},
                          {splat(r[3]), splat(r[4]), splat(r[5])},
                          {splat(r[6]), splat(r[7]), splat(r[8])}};
  o.x = dot(row[0], in.mean) + splat(v.translation[0]);
  o.y = dot(row[1], in.mean) + splat(v.translation[1]);
  o.z = dot(row[2], in.mean) + splat(v.translation[2]);
  o.front = splat(v.near) < o.z;
  o.z = select(o.front, o.z, splat(1.0f));
  o.inv_z = splat(1.0f) / o.z;
  const Floats focal_x = splat(v.fx) * o.inv_z, focal_y = splat(v.fy) * o.inv_z;
  o.mean_x = fma(focal_x, o.x, splat(v.cx)) + in.offset_x;
  o.mean_y = fma(focal_y, o.y, splat(v.cy)) + in.offset_y;
  o.slope_x = clamp_slope(o.x * o.inv_z, v.fx, v.cx, static_cast<float>(v.width), o.free_x);
  o.slope_y = clamp_slope(o.y * o.inv_z, v.fy, v.cy, static_cast<float>(v.height), o.free_y);

  o.rotation = rotation_of(in);
  for (int i = 0; i < 3; ++i) {
    Vector3 a = times(row[i].x, o.rotation.row[0]);
    a = add(a, row[i].y, o.rotation.row[1]);
    a = add(a, row[i].z, o.rotation.row[2]);
    o.axis[i] = {a.x * in.scale.x, a.y * in.scale.y, a.z * in.scale.z};
  }
  o.m1 = times(focal_x, add(o.axis[0], -o.slope_x, o.axis[2]));
  o.m2 = times(focal_y, add(o.axis[1], -o.slope_y, o.axis[2]));
  o.normal = cross(o.m1, o.m2);

  const Floats eps = splat(v.eps2d);
  const Floats xx = dot(o.m1, o.m1), yy = dot(o.m2, o.m2), area2 = dot(o.normal, o.normal);
  o.area = sqrt(area2);
  o.det = area2 + fma(eps, xx + yy, eps * eps);
  o.xx = xx + eps;
  o.xy = dot(o.m1, o.m2);
  o.yy = yy + eps;
  o.opacity = in.opacity;
  if (v.antialiased) o.opacity = in.opacity * (o.area / sqrt(max(o.det, splat(1e-37f))));
  return o;
}

// The inverse covariance as a sum of squares, exp(-u^2 - v^2) with u = p dx - s dy, v = q dy.
struct Whitening {
  Floats p, s, q;
};

XRGS_INLINE Whitening whiten(const Projected& o) {
  const Floats half = splat(0.5f);
  const Floats p = sqrt(half * (o.yy / o.det));
  return {p, p * (o.xy / o.yy), sqrt(half / o.yy)};
}

}  // namespace XRGS_NS
}  // namespace xrgs
