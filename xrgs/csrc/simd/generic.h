// Operations of simd.h in terms of other operations, for instruction sets without a faster form.
// avx2.h and vector16.h include this file.
#pragma once

#include <cstdint>

namespace xrgs {
namespace XRGS_NS {

XRGS_INLINE Floats multiply_where(Mask m, Floats a, Floats b) { return select_or_zero(m, a * b); }
XRGS_INLINE Floats min_positive_where(Mask m, Floats a, Floats b) {
  return select_or_zero(m, min_positive(a, b));
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
