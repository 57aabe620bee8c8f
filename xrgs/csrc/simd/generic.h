// Operations of simd.h in terms of the others, for instruction sets that have no better form of
// them. avx2.h and portable.h include this file.
#pragma once

#include <cstdint>

namespace xrgs {
namespace XRGS_NS {

// exp2(x) = 2^n 2^f, with n the integer nearest to x: 2^f is a polynomial of degree 5, and n is
// added to its exponent. The polynomial's relative error is 7.5e-8; with the rounding of each step
// the total is 2.1e-7 with AVX2 and 2.36e-7 without FMA (measured). exp2 of an integer n is 2^n (1
// + 2^-23), so exp2(0) is 1.00000012.
XRGS_INLINE Floats exp2(Floats x) {
  const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  const Floats t = x + magic;
  const Floats f = x - (t - magic);  // -1/2 to 1/2
  Floats p = fma(f, broadcast(0.0013276472f), broadcast(0.0096755410f));
  p = fma(f, p, broadcast(0.0555071309f));
  p = fma(f, p, broadcast(0.2402212024f));
  p = fma(f, p, broadcast(0.6931469440f));
  p = fma(f, p, broadcast(1.0000001192f));
  return as_floats(as_ints(p) + shift_left<23>(as_ints(t)));
}

XRGS_INLINE void load_triples(const float* p, Floats& x, Floats& y, Floats& z) {
  float part[3][16];
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < 3; ++k) part[k][i] = p[3 * i + k];
  x = load(part[0]);
  y = load(part[1]);
  z = load(part[2]);
}
XRGS_INLINE void store_triples(float* p, Floats x, Floats y, Floats z) {
  float part[3][16];
  store(part[0], x);
  store(part[1], y);
  store(part[2], z);
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < 3; ++k) p[3 * i + k] = part[k][i];
}

}  // namespace XRGS_NS
}  // namespace xrgs
