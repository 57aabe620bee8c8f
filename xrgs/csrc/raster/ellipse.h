// Where a Gaussian reaches: the exact horizontal span of its ellipse within a strip of rows.
//
// The ellipse is u^2 + v^2 <= reach2 with u = p dx - s dy, v = q dy. At one dy its points are
// dx = (s dy +- sqrt(reach2 - v^2)) / p. It is convex, so over a strip of rows the rightmost point
// is the ellipse's own rightmost point (at dy = tip) or the nearest to it that the strip allows,
// and the leftmost likewise at -tip. The part within the strip is convex too: it meets every
// column of pixels between the two.
#pragma once

#include "raster/types.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {

// Sixteen Gaussians, or one in all lanes.
struct Ellipse {
  Floats x, y, s, q, inv_p, tip, reach2, reach_y;
};

// At least the square root of a >= 0, and above it by less than 0.1%.
XRGS_INLINE Floats sqrt_above(Floats a) {
  a = max(a, splat(1e-20f));
#if defined(__AVX512F__)
  return a * Floats{_mm512_rsqrt14_ps(a.v)} * splat(1.0001f);
#elif defined(__AVX2__)
  return a * Floats{_mm256_rsqrt_ps(a.lo), _mm256_rsqrt_ps(a.hi)} * splat(1.0005f);
#else
  return sqrt(a);
#endif
}

// The span of pixel positions left..right of the rows whose centres are top..bottom; lanes where
// the ellipse does not reach these rows are not in the mask.
XRGS_INLINE Mask span(const Ellipse& e, Floats top, Floats bottom, Floats& left, Floats& right) {
  const Floats low = top - e.y, high = bottom - e.y;
  const Floats at_right = clamp(e.tip, low, high);
  const Floats at_left = clamp(-e.tip, low, high);
  const Floats v_right = e.q * at_right, v_left = e.q * at_left;
  const Floats half_right = sqrt_above(fnma(v_right, v_right, e.reach2));
  const Floats half_left = sqrt_above(fnma(v_left, v_left, e.reach2));
  right = fma(fma(e.s, at_right, half_right), e.inv_p, e.x);
  left = fma(e.s * at_left - half_left, e.inv_p, e.x);
  return (low <= e.reach_y) & (-e.reach_y <= high);
}

// Lanes of sixteen records that were transposed.
XRGS_INLINE Ellipse ellipse_of(const Floats (&fields)[16]) {
  return {fields[0], fields[1],  fields[3],  fields[4],
          fields[9], fields[10], fields[11], fields[12]};
}

XRGS_INLINE Ellipse ellipse_of(const Record& r) {
  return {splat(r.x),     splat(r.y),   splat(r.s),      splat(r.q),
          splat(r.inv_p), splat(r.tip), splat(r.reach2), splat(r.reach_y)};
}

}  // namespace XRGS_NS
}  // namespace xrgs
