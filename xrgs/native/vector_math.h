// exp2 and log2 of sixteen lanes.
//
// exp2(x) = 2^n 2^f with n = floor(x) or the nearest integer and f the rest: a degree-5 polynomial
// of least relative error (7.5e-8) on the unit interval of f, scaled by 2^n.
// log2(x) = n + log2(m) with m in [sqrt(1/2), sqrt(2)): with s = (m - 1) / (m + 1), |s| < 0.172,
// log2(m) = 2/ln 2 (s + s^3/3 + s^5/5 + ...), cut after s^9 (relative error 4e-9).
#pragma once

#include "simd.h"

namespace xrgs {
namespace XRGS_NS {

// Of finite x <= 127; below -126 it may be flushed to zero or to 2^-126.
XRGS_INLINE Floats exp2(Floats x) {
#if defined(__AVX512F__)
  const Floats f{_mm512_reduce_ps(x.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};  // 0 to 1
  Floats p = fma(f, splat(0.0018775767f), splat(0.0089893397f));
  p = fma(f, p, splat(0.0558263175f));
  p = fma(f, p, splat(0.2401536107f));
  p = fma(f, p, splat(0.6931530833f));
  p = fma(f, p, splat(0.9999999404f));
  return {_mm512_scalef_ps(p.v, x.v)};  // times 2^floor(x)
#else
  const Floats magic = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  x = max(x, splat(-126.0f));
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
