// The operations of simd.h for any processor: plain loops over an array of sixteen, which the
// compiler vectorises as far as it can.
#pragma once

#include <cstdint>
#include <cstring>

namespace xrgs {
namespace XRGS_NS {

// The number of vectors that the registers hold, if there are sixteen registers of four floats.
constexpr int kVectorRegisters = 4;
constexpr bool kFusedMultiplyAdd = false;

struct Floats {
  float v[16];
};
struct Ints {
  std::int32_t v[16];
};
struct Mask {
  std::int32_t v[16];
};  // all bits of a lane set, or none

#define XRGS_EACH(type, expression)                   \
  type r;                                             \
  for (int i = 0; i < 16; ++i) r.v[i] = (expression); \
  return r

XRGS_INLINE Floats broadcast(float a) { XRGS_EACH(Floats, a); }
XRGS_INLINE Ints broadcast_int(std::int32_t a) { XRGS_EACH(Ints, a); }
XRGS_INLINE Floats load(const float* p) { XRGS_EACH(Floats, p[i]); }
XRGS_INLINE void store(float* p, Floats a) {
  for (int i = 0; i < 16; ++i) p[i] = a.v[i];
}
XRGS_INLINE Floats load_first(const float* p, int count) {
  XRGS_EACH(Floats, i < count ? p[i] : 0.0f);
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  for (int i = 0; i < count; ++i) p[i] = a.v[i];
}
XRGS_INLINE void stream(float* p, Floats a) { store(p, a); }

XRGS_INLINE Floats operator+(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] + b.v[i]); }
XRGS_INLINE Floats operator-(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] - b.v[i]); }
XRGS_INLINE Floats operator*(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] * b.v[i]); }
XRGS_INLINE Floats operator/(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] / b.v[i]); }
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, a.v[i] * b.v[i] + c.v[i]);
}
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, c.v[i] - a.v[i] * b.v[i]);
}
XRGS_INLINE Floats min(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
XRGS_INLINE Floats max(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
XRGS_INLINE Floats min_positive(Floats a, Floats b) { return min(a, b); }
XRGS_INLINE Floats abs(Floats a) { XRGS_EACH(Floats, __builtin_fabsf(a.v[i])); }
XRGS_INLINE Floats sqrt(Floats a) { XRGS_EACH(Floats, __builtin_sqrtf(a.v[i])); }
XRGS_INLINE Floats floor(Floats a) { XRGS_EACH(Floats, __builtin_floorf(a.v[i])); }
XRGS_INLINE Floats ceil(Floats a) { XRGS_EACH(Floats, __builtin_ceilf(a.v[i])); }

XRGS_INLINE Mask operator<(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] < b.v[i])); }
XRGS_INLINE Mask operator<=(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] <= b.v[i])); }
XRGS_INLINE Mask operator==(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] == b.v[i])); }
XRGS_INLINE Mask operator&(Mask a, Mask b) { XRGS_EACH(Mask, a.v[i] & b.v[i]); }
XRGS_INLINE std::uint32_t to_bits(Mask m) {
  std::uint32_t r = 0;
  for (int i = 0; i < 16; ++i) r |= (static_cast<std::uint32_t>(m.v[i]) & 1u) << i;
  return r;
}
XRGS_INLINE Mask mask_from_bits(std::uint32_t bits) {
  XRGS_EACH(Mask, -static_cast<std::int32_t>((bits >> i) & 1u));
}
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  XRGS_EACH(Floats, m.v[i] ? a.v[i] : b.v[i]);
}
XRGS_INLINE Floats select_or_zero(Mask m, Floats a) { XRGS_EACH(Floats, m.v[i] ? a.v[i] : 0.0f); }

// Integer sums wrap around, as those of vector instructions do.
XRGS_INLINE std::uint32_t unsigned_of(std::int32_t a) { return static_cast<std::uint32_t>(a); }
XRGS_INLINE Ints operator+(Ints a, Ints b) {
  XRGS_EACH(Ints, static_cast<std::int32_t>(unsigned_of(a.v[i]) + unsigned_of(b.v[i])));
}
XRGS_INLINE Ints operator-(Ints a, Ints b) {
  XRGS_EACH(Ints, static_cast<std::int32_t>(unsigned_of(a.v[i]) - unsigned_of(b.v[i])));
}
template <int Count>
XRGS_INLINE Ints shift_left(Ints a) {
  XRGS_EACH(Ints, static_cast<std::int32_t>(static_cast<std::uint32_t>(a.v[i]) << Count));
}
template <int Count>
XRGS_INLINE Ints shift_right(Ints a) {
  XRGS_EACH(Ints, a.v[i] >> Count);
}
XRGS_INLINE Ints as_ints(Floats a) {
  Ints r;
  std::memcpy(r.v, a.v, sizeof r.v);
  return r;
}
XRGS_INLINE Floats as_floats(Ints a) {
  Floats r;
  std::memcpy(r.v, a.v, sizeof r.v);
  return r;
}
XRGS_INLINE Floats to_floats(Ints a) { XRGS_EACH(Floats, static_cast<float>(a.v[i])); }
XRGS_INLINE Ints to_ints(Floats a) { XRGS_EACH(Ints, static_cast<std::int32_t>(a.v[i])); }
XRGS_INLINE void store(std::int32_t* p, Ints a) { std::memcpy(p, a.v, sizeof a.v); }

XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  for (int i = 0; i < 8; ++i) {
    low.v[2 * i] = a.v[i];
    low.v[2 * i + 1] = b.v[i];
    high.v[2 * i] = a.v[i + 8];
    high.v[2 * i + 1] = b.v[i + 8];
  }
}

XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  for (int i = 0; i < 8; ++i) {
    a.v[i] = low.v[2 * i];
    b.v[i] = low.v[2 * i + 1];
    a.v[i + 8] = high.v[2 * i];
    b.v[i + 8] = high.v[2 * i + 1];
  }
}

template <int C>
XRGS_INLINE Floats broadcast_column(Floats a) {
  XRGS_EACH(Floats, a.v[i / 4 * 4 + C]);
}
template <int R>
XRGS_INLINE Floats broadcast_row(Floats a) {
  XRGS_EACH(Floats, a.v[4 * R + i % 4]);
}
XRGS_INLINE Floats sum_rows(Floats a) {
  XRGS_EACH(Floats, (a.v[i % 4] + a.v[8 + i % 4]) + (a.v[4 + i % 4] + a.v[12 + i % 4]));
}
XRGS_INLINE Floats add_last_row(Floats a, Floats b) {
  XRGS_EACH(Floats, i < 12 ? a.v[i] : a.v[i] + b.v[i]);
}

XRGS_INLINE float sum_lanes(Floats a) {
  for (int width = 8; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) a.v[i] += a.v[i + width];
  return a.v[0];
}

XRGS_INLINE void transpose(Floats (&r)[16]) {
  for (int i = 0; i < 16; ++i)
    for (int j = 0; j < i; ++j) {
      const float t = r[i].v[j];
      r[i].v[j] = r[j].v[i];
      r[j].v[i] = t;
    }
}

XRGS_INLINE void stream_fence() {}

#undef XRGS_EACH

}  // namespace XRGS_NS
}  // namespace xrgs

// The operations that this instruction set has no better form of.
#include "simd/generic.h"
