// exp2 and log2 of sixteen lanes.
//
// exp2(x) = 2^n 2^f with n the nearest integer and f the rest: a degree-5 polynomial of least
// relative error (7.5e-8) in f, and n added to its exponent. With AVX-512, whose units for
// multiplication are the scarce ones, a table of 2^(i/32) and a degree-2 polynomial (5.3e-8).
// log2(x) = n + log2(m) with m in [sqrt(1/2), sqrt(2)): with s = (m - 1) / (m + 1), |s| < 0.172,
// log2(m) = 2/ln 2 (s + s^3/3 + s^5/5 + ...), cut after s^9 (relative error 4e-9).
#pragma once

#include "simd.h"

namespace xrgs {
namespace XRGS_NS {

#if defined(__AVX512F__)
// The bits of 2^(i/32), less i << 18.
alignas(64) constexpr std::uint32_t kExp2Table[32] = {
    0x3f800000, 0x3f7ecd87, 0x3f7daac3, 0x3f7c980f, 0x3f7b95c2, 0x3f7aa43a, 0x3f79c3d3, 0x3f78f4f0,
    0x3f7837f0, 0x3f778d3a, 0x3f76f532, 0x3f767043, 0x3f75fed7, 0x3f75a15b, 0x3f75583f, 0x3f7523f6,
    0x3f7504f3, 0x3f74fbaf, 0x3f7508a4, 0x3f752c4d, 0x3f75672a, 0x3f75b9be, 0x3f76248c, 0x3f76a81e,
    0x3f7744fd, 0x3f77fbb8, 0x3f78ccdf, 0x3f79b907, 0x3f7ac0c7, 0x3f7be4ba, 0x3f7d257d, 0x3f7e83b3,
};
#endif

// Of -126 <= x <= 127; elsewhere anything.
XRGS_INLINE Floats exp2(Floats x) {
#if defined(__AVX512F__)
  // Adding 1.5 * 2^18 rounds to multiples of 1/32: the sum's low five bits say which, i, and the
  // bits above them n. The table has 2^(i/32) less what i, shifted along with n, will add.
  const Floats magic = splat(393216.0f);
  const Floats t = x + magic;
  const Floats f = x - (t - magic);  // -1/64 to 1/64
  const Floats p =
      fma(f, fma(f, splat(0.24022474884986877f), splat(0.6931573152542114f)), splat(1.0f));
  const __m512i part = _mm512_permutex2var_epi32(
      _mm512_load_si512(kExp2Table), _mm512_castps_si512(t.v), _mm512_load_si512(kExp2Table + 16));
  return p * as_floats(Ints{part} + shift_left<18>(as_ints(t)));
#else
  const Floats magic = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  const Floats t = x + magic;
  const Floats f = x - (t - magic);  // -1/2 to 1/2
  Floats p = fma(f, splat(0.0013276472f), splat(0.0096755410f));
  p = fma(f, p, splat(0.0555071309f));
  p = fma(f, p, splat(0.2402212024f));
  p = fma(f, p, splat(0.6931469440f));
  p = fma(f, p, splat(1.0000001192f));
  return as_floats(as_ints(p) + shift_left<23>(as_ints(t)));
#endif
}

// Of finite x >= 2^-126.
XRGS_INLINE Floats log2(Floats x) {
  // The exponent of x / sqrt(1/2), so that m lies on both sides of 1.
  const Ints n = shift_right<23>(as_ints(x) - splat_int(0x3f3504f3));
  const Floats m = as_floats(as_ints(x) - shift_left<23>(n));
  const Floats s = (m - splat(1.0f)) / (m + splat(1.0f));
  const Floats s2 = s * s;
  Floats p = fma(s2, splat(0.3205989f), splat(0.4121986f));
  p = fma(s2, p, splat(0.5770780f));
  p = fma(s2, p, splat(0.9617967f));
  p = fma(s2, p, splat(2.8853900818f));
  return fma(s, p, to_floats(n));
}

}  // namespace XRGS_NS
}  // namespace xrgs
