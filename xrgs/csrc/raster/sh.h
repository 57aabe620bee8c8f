// Real spherical harmonics of degree 0 to 3 and their derivatives, sixteen directions at a time.
//
// The basis of 3D Gaussian Splatting: orthonormal, Condon-Shortley phase included, index l^2+l+m.
// Gradients are those of the polynomials as written, in x, y, z taken as free variables.
#pragma once

#include "raster/geometry.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {

constexpr float kC0 = 0.28209479f;                       // sqrt(1 / 4 pi)
constexpr float kC1 = 0.48860251f;                       // sqrt(3 / 4 pi)
constexpr float kC2 = 1.09254843f, kC20 = 0.31539157f;   // sqrt(15 / 4 pi), sqrt(5 / 16 pi)
constexpr float kC31 = 0.45704580f, kC32 = 2.89061144f;  // sqrt(21 / 32 pi), sqrt(105 / 4 pi)
constexpr float kC33 = 0.59004359f, kC30 = 0.37317633f;  // sqrt(35 / 32 pi), sqrt(7 / 16 pi)

constexpr int rest_of(int degree) { return (degree + 1) * (degree + 1) - 1; }

// basis[k] of bands 1 to Degree, without the constant one.
template <int Degree>
XRGS_INLINE void sh_basis(const Vector3& d, Floats* basis) {
  const Floats x = d.x, y = d.y, z = d.z;
  if constexpr (Degree >= 1) {
    basis[0] = splat(-kC1) * y;
    basis[1] = splat(kC1) * z;
    basis[2] = splat(-kC1) * x;
  }
  if constexpr (Degree >= 2) {
    const Floats xx = x * x, yy = y * y, zz = z * z;
    basis[3] = splat(kC2) * x * y;
    basis[4] = splat(-kC2) * y * z;
    basis[5] = splat(kC20) * fma(splat(3.0f), zz, splat(-1.0f));
    basis[6] = splat(-kC2) * x * z;
    basis[7] = splat(0.5f * kC2) * (xx - yy);
    if constexpr (Degree >= 3) {
      const Floats five = fma(splat(5.0f), zz, splat(-1.0f));
      basis[8] = splat(-kC33) * y * fma(splat(3.0f), xx, -yy);
      basis[9] = splat(kC32) * x * y * z;
      basis[10] = splat(-kC31) * y * five;
      basis[11] = splat(kC30) * z * (five - splat(2.0f));
      basis[12] = splat(-kC31) * x * five;
      basis[13] = splat(0.5f * kC32) * z * (xx - yy);
      basis[14] = splat(-kC33) * x * fnma(splat(3.0f), yy, xx);
    }
  }
}

// Sum over k of a[k stride] times the gradient of basis[k].
template <int Degree>
XRGS_INLINE Vector3 sh_gradient(const Vector3& d, const Floats* coefficients, int stride) {
  const auto a = [=](int k) { return coefficients[k * stride]; };
  const Floats x = d.x, y = d.y, z = d.z;
  const Floats zero = splat(0.0f);
  Vector3 g{zero, zero, zero};
  if constexpr (Degree >= 1) {
    g.y = splat(-kC1) * a(0);
    g.z = splat(kC1) * a(1);
    g.x = splat(-kC1) * a(2);
  }
  if constexpr (Degree >= 2) {
    const Floats a3 = splat(kC2) * a(3), a4 = splat(-kC2) * a(4), a6 = splat(-kC2) * a(6);
    const Floats a5 = splat(6.0f * kC20) * a(5), a7 = splat(kC2) * a(7);
    g.x += fma(a3, y, fma(a6, z, a7 * x));
    g.y += fma(a3, x, fma(a4, z, -(a7 * y)));
    g.z += fma(a4, y, fma(a5, z, a6 * x));
  }
  if constexpr (Degree >= 3) {
    const Floats xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const Floats five = fma(splat(5.0f), zz, splat(-1.0f));
    const Floats three = splat(3.0f) * (xx - yy);
    const Floats a8 = splat(-kC33) * a(8), a9 = splat(kC32) * a(9), a10 = splat(-kC31) * a(10);
    const Floats a11 = splat(3.0f * kC30) * a(11), a12 = splat(-kC31) * a(12);
    const Floats a13 = splat(kC32) * a(13), a14 = splat(-kC33) * a(14);
    const Floats half = splat(0.5f) * (xx - yy), six = splat(6.0f), ten = splat(10.0f);
    g.x += fma(a8 * six, xy, fma(a9, yz, fma(a12, five, fma(a13, xz, a14 * three))));
    g.y += fma(a8, three, fma(a9, xz, fma(a10, five, -fma(a13, yz, a14 * six * xy))));
    g.z += fma(a9, xy, fma(a10 * ten, yz, fma(a11, five, fma(a12 * ten, xz, a13 * half))));
  }
  return g;
}

// Sixteen rows of `Width` floats, `stride` apart, as columns; rows not in `rows` read as zero.
template <int Width>
XRGS_INLINE void load_columns(const float* p, std::int64_t stride, std::uint32_t rows,
                              Floats* out) {
  for (int c = 0; c < Width; c += 16) {
    const int width = Width - c < 16 ? Width - c : 16;
    Floats r[16];
    for (int i = 0; i < 16; ++i)
      r[i] = (rows >> i & 1u) != 0 ? load_first(p + i * stride + c, width) : splat(0.0f);
    transpose(r);
    for (int i = 0; i < width; ++i) out[c + i] = r[i];
  }
}

// Whose harmonics to load: where most of the sixteen are visible those of all, as a test of each
// one would cost more than what it spares.
XRGS_INLINE std::uint32_t rows_to_load(std::uint32_t visible, int lanes) {
  return __builtin_popcount(visible) >= 8 ? (1u << lanes) - 1u : visible;
}

// The unit vector from the camera to each mean, and 1 / its length before.
XRGS_INLINE Vector3 direction_of(const Vector3& mean, const float* position, Floats& inv) {
  const Vector3 from_camera{mean.x - splat(position[0]), mean.y - splat(position[1]),
                            mean.z - splat(position[2])};
  inv = splat(1.0f) / sqrt(max(dot(from_camera, from_camera), splat(1.17549435e-38f)));
  return times(inv, from_camera);
}

// The gradients of sixteen Gaussians' harmonics, row by row. Bands that are not on stay zero.
struct Harmonics {
  alignas(64) float rows[16 * 3 * rest_of(3) + 16] = {};
};

// Columns to rows `stride` apart. Each row is written to a multiple of sixteen: what that adds is
// zero, and where it reaches into the next row it is overwritten.
template <int Width>
XRGS_INLINE void store_columns(const Floats* columns, std::int64_t stride, Harmonics& out) {
  Floats r[(Width + 15) / 16][16];
  for (int c = 0; c < Width; c += 16) {
    for (int i = 0; i < 16; ++i) r[c / 16][i] = c + i < Width ? columns[c + i] : splat(0.0f);
    transpose(r[c / 16]);
  }
  for (int i = 0; i < 16; ++i)
    for (int c = 0; c < Width; c += 16) store(out.rows + i * stride + c, r[c / 16][i]);
}

// From the gradient v of their colours, before the clamp, that of `rest` harmonics above band 0: a
// column of numbers times a row.
template <int Degree>
XRGS_INLINE void harmonics_gradient(const Vector3& direction, const Vector3& v, int rest,
                                    Harmonics& out) {
  constexpr int kRest = rest_of(Degree);
  if constexpr (kRest > 0) {
    Floats basis[kRest], columns[3 * kRest];
    sh_basis<Degree>(direction, basis);
    for (int k = 0; k < kRest; ++k) {
      columns[3 * k] = basis[k] * v.x;
      columns[3 * k + 1] = basis[k] * v.y;
      columns[3 * k + 2] = basis[k] * v.z;
    }
    store_columns<3 * kRest>(columns, std::int64_t{rest} * 3, out);
  }
}

}  // namespace XRGS_NS
}  // namespace xrgs
