// Real spherical harmonics of degree 0 to 3 and their derivatives, for sixteen directions at a
// time. xrgs/splat/sh.py describes the basis. Derivatives are those of the polynomials as written,
// with x, y and z as independent variables; the direction is normalised separately (Eq. 32).
#pragma once

#include <cstdint>

#include "raster/projection.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {

constexpr float kC0 = 0.28209479f;                       // sqrt(1 / 4 pi)
constexpr float kC1 = 0.48860251f;                       // sqrt(3 / 4 pi)
constexpr float kC2 = 1.09254843f, kC20 = 0.31539157f;   // sqrt(15 / 4 pi), sqrt(5 / 16 pi)
constexpr float kC31 = 0.45704580f, kC32 = 2.89061144f;  // sqrt(21 / 32 pi), sqrt(105 / 4 pi)
constexpr float kC33 = 0.59004359f, kC30 = 0.37317633f;  // sqrt(35 / 32 pi), sqrt(7 / 16 pi)

// Evaluates the basis functions of degree 1 to Degree; basis[0] is the first of degree 1.
template <int Degree>
XRGS_INLINE void sh_basis(const Vector3& d, Floats* basis) {
  const Floats x = d.x, y = d.y, z = d.z;
  if constexpr (Degree >= 1) {
    basis[0] = broadcast(-kC1) * y;
    basis[1] = broadcast(kC1) * z;
    basis[2] = broadcast(-kC1) * x;
  }
  if constexpr (Degree >= 2) {
    const Floats xx = x * x, yy = y * y, zz = z * z;
    basis[3] = broadcast(kC2) * x * y;
    basis[4] = broadcast(-kC2) * y * z;
    basis[5] = broadcast(kC20) * fma(broadcast(3.0f), zz, broadcast(-1.0f));
    basis[6] = broadcast(-kC2) * x * z;
    basis[7] = broadcast(0.5f * kC2) * (xx - yy);
    if constexpr (Degree >= 3) {
      const Floats five = fma(broadcast(5.0f), zz, broadcast(-1.0f));
      basis[8] = broadcast(-kC33) * y * fma(broadcast(3.0f), xx, -yy);
      basis[9] = broadcast(kC32) * x * y * z;
      basis[10] = broadcast(-kC31) * y * five;
      basis[11] = broadcast(kC30) * z * (five - broadcast(2.0f));
      basis[12] = broadcast(-kC31) * x * five;
      basis[13] = broadcast(0.5f * kC32) * z * (xx - yy);
      basis[14] = broadcast(-kC33) * x * fnma(broadcast(3.0f), yy, xx);
    }
  }
}

// The sum over k of coefficients[k stride] times the gradient of basis[k].
template <int Degree>
XRGS_INLINE Vector3 sh_direction_gradient(const Vector3& d, const Floats* coefficients,
                                          int stride) {
  const auto a = [=](int k) { return coefficients[k * stride]; };
  const Floats x = d.x, y = d.y, z = d.z;
  const Floats zero = broadcast(0.0f);
  Vector3 g{zero, zero, zero};
  if constexpr (Degree >= 1) {
    g.y = broadcast(-kC1) * a(0);
    g.z = broadcast(kC1) * a(1);
    g.x = broadcast(-kC1) * a(2);
  }
  if constexpr (Degree >= 2) {
    const Floats a3 = broadcast(kC2) * a(3), a4 = broadcast(-kC2) * a(4),
                 a6 = broadcast(-kC2) * a(6);
    const Floats a5 = broadcast(6.0f * kC20) * a(5), a7 = broadcast(kC2) * a(7);
    g.x += fma(a3, y, fma(a6, z, a7 * x));
    g.y += fma(a3, x, fma(a4, z, -(a7 * y)));
    g.z += fma(a4, y, fma(a5, z, a6 * x));
  }
  if constexpr (Degree >= 3) {
    const Floats xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const Floats five = fma(broadcast(5.0f), zz, broadcast(-1.0f));
    const Floats three = broadcast(3.0f) * (xx - yy);
    const Floats a8 = broadcast(-kC33) * a(8), a9 = broadcast(kC32) * a(9),
                 a10 = broadcast(-kC31) * a(10);
    const Floats a11 = broadcast(3.0f * kC30) * a(11), a12 = broadcast(-kC31) * a(12);
    const Floats a13 = broadcast(kC32) * a(13), a14 = broadcast(-kC33) * a(14);
    const Floats half = broadcast(0.5f) * (xx - yy), six = broadcast(6.0f), ten = broadcast(10.0f);
    g.x += fma(a8 * six, xy, fma(a9, yz, fma(a12, five, fma(a13, xz, a14 * three))));
    g.y += fma(a8, three, fma(a9, xz, fma(a10, five, -fma(a13, yz, a14 * six * xy))));
    g.z += fma(a9, xy, fma(a10 * ten, yz, fma(a11, five, fma(a12 * ten, xz, a13 * half))));
  }
  return g;
}

// Loads sixteen rows of `Width` floats, `stride` apart, as columns. Rows whose bit in `rows` is not
// set are not read, and give zeros. If the last vector of a row would reach past its end, it
// overlaps the vector before, since masked loads across cache lines are several times slower.
template <int Width>
XRGS_INLINE void load_columns(const float* p, std::int64_t stride, std::uint32_t rows,
                              Floats* out) {
  for (int c = 0; c < Width; c += 16) {
    const int first = c == 0 || c + 16 <= Width ? c : Width - 16;
    Floats r[16];
    for (int i = 0; i < 16; ++i) {
      const float* row = p + i * stride + first;
      r[i] = (rows >> i & 1u) == 0 ? broadcast(0.0f)
             : Width < 16          ? load_first(row, Width)
                                   : load(row);
    }
    transpose(r);
    for (int i = 0; i < 16 && first + i < Width; ++i) out[first + i] = r[i];
  }
}

// The Gaussians whose shN is loaded: the visible ones, but all if at least half are visible,
// because then the tests would take longer than the loads that they avoid.
XRGS_INLINE std::uint32_t rows_to_load(std::uint32_t visible, int lanes) {
  return __builtin_popcount(visible) >= 8 ? (1u << lanes) - 1u : visible;
}

// The unit vectors from the camera to the means, and 1 / their lengths before normalisation.
XRGS_INLINE Vector3 view_direction(const Vector3& mean, const float* camera_position,
                                   Floats& inv_distance) {
  const Vector3 from_camera{mean.x - broadcast(camera_position[0]),
                            mean.y - broadcast(camera_position[1]),
                            mean.z - broadcast(camera_position[2])};
  inv_distance =
      broadcast(1.0f) / sqrt(max(dot(from_camera, from_camera), broadcast(1.17549435e-38f)));
  return times(inv_distance, from_camera);
}

// The factors of the gradients of shN for sixteen Gaussians: rows of basis functions of degree 1
// and higher, padded with zeros, and the gradients of the colours before the clamp.
struct ShGradientFactors {
  alignas(64) float basis[16][16];  // repeat_thrice of the last row reads one float of v_color
  alignas(64) float v_color[16 * 3 + 16];
};

template <int Degree>
XRGS_INLINE void store_basis(const Vector3& direction, ShGradientFactors& out) {
  constexpr int kRest = rest_basis_count(Degree);
  Floats rows[16];
  sh_basis<Degree>(direction, rows);
  for (int k = kRest; k < 16; ++k) rows[k] = broadcast(0.0f);
  transpose(rows);
  for (int i = 0; i < 16; ++i) store(out.basis[i], rows[i]);
}

// The gradients of shN of sixteen Gaussians, row by row. Those of degrees above Degree stay zero.
struct ShGradientRows {
  alignas(64) float rows[16 * 3 * rest_basis_count(3) + 16] = {};
};

// Writes floats 16 C to 16 C + 15 of a Gaussian's row, with zeros after its last band.
template <int Degree, int C>
XRGS_INLINE void store_gradient_part(const float* basis, const float* v_color, float* row) {
  constexpr int kLeft = 3 * rest_basis_count(Degree) - 16 * C;
  if constexpr (kLeft > 0) {
    const Floats part = repeat_thrice<C>(basis) * repeat_triple<C>(v_color);
    store(row + 16 * C,
          kLeft >= 16 ? part : select_or_zero(mask_from_bits((1u << (kLeft & 15)) - 1u), part));
  }
}

// Writes the gradient of Gaussian i of sixteen, whose rows are `stride` floats apart: the basis
// times the gradient of the colour (Eq. 31). The last vector is padded with zeros, which may reach
// into the next row: so rows must be written in ascending order.
template <int Degree>
XRGS_INLINE void store_gradient_row(const ShGradientFactors& factors, int i, std::int64_t stride,
                                    ShGradientRows& out) {
  const float *basis = factors.basis[i], *v_color = factors.v_color + 3 * i;
  float* row = out.rows + i * stride;
  store_gradient_part<Degree, 0>(basis, v_color, row);
  store_gradient_part<Degree, 1>(basis, v_color, row);
  store_gradient_part<Degree, 2>(basis, v_color, row);
}

}  // namespace XRGS_NS
}  // namespace xrgs
