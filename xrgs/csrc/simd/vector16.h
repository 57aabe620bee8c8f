// The operations of simd.h for any processor, with four vectors of 16 bytes, which GCC and clang
// support for every target. Operations without a compiler's operator use intrinsics on x86-64
// without AVX2 (SSE2) and on 64-bit ARM (NEON), and the general forms at the end on others.
//
// Loops over an array of sixteen floats would not do: GCC does not vectorise most of them.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__aarch64__)
#include <arm_neon.h>
#elif defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace xrgs {
namespace XRGS_NS {

typedef float Float4 __attribute__((vector_size(16)));
typedef std::int32_t Int4 __attribute__((vector_size(16)));
typedef std::uint32_t UInt4 __attribute__((vector_size(16)));

struct Floats {
  Float4 v[4];
};
struct Ints {
  Int4 v[4];
};
struct Mask {
  Int4 v[4];
};  // all bits of a lane set, or none

// Returns a Floats, Ints or Mask from `expression` for its vectors i = 0 to 3. With a loop, GCC
// would keep the vectors in memory, because it unrolls too late.
#define XRGS_EACH(type, expression)                    \
  const auto each = [&](int i) { return expression; }; \
  return type { each(0), each(1), each(2), each(3) }

// The lanes i, j, k and l of the eight lanes of a and b. GCC has __builtin_shufflevector from
// version 12 on.
#if defined(__has_builtin) && __has_builtin(__builtin_shufflevector)
#define XRGS_SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define XRGS_SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, Int4{i, j, k, l})
#endif

XRGS_INLINE Float4 same4(float a) { return Float4{a, a, a, a}; }
XRGS_INLINE Int4 same4(std::int32_t a) { return Int4{a, a, a, a}; }
XRGS_INLINE Float4 as_float4(Int4 a) { return reinterpret_cast<Float4>(a); }
XRGS_INLINE Int4 as_int4(Float4 a) { return reinterpret_cast<Int4>(a); }
XRGS_INLINE Float4 load4(const float* p) {
  Float4 r;
  std::memcpy(&r, p, sizeof r);
  return r;
}

#if defined(__aarch64__)

// The number of vectors that fit in thirty-two registers of four floats.
constexpr int kVectorRegisters = 8;
constexpr bool kFusedMultiplyAdd = true;

XRGS_INLINE Float4 fma4(Float4 a, Float4 b, Float4 c) { return vfmaq_f32(c, a, b); }
XRGS_INLINE Float4 fnma4(Float4 a, Float4 b, Float4 c) { return vfmsq_f32(c, a, b); }
XRGS_INLINE Float4 sqrt4(Float4 a) { return vsqrtq_f32(a); }
XRGS_INLINE Float4 floor4(Float4 a) { return vrndmq_f32(a); }
XRGS_INLINE Float4 ceil4(Float4 a) { return vrndpq_f32(a); }
XRGS_INLINE Float4 select4(Int4 m, Float4 a, Float4 b) {
  return vbslq_f32(reinterpret_cast<uint32x4_t>(m), a, b);
}
// Not vminq_f32, which returns NaN if either argument is NaN.
XRGS_INLINE Float4 min4(Float4 a, Float4 b) { return select4(a < b, a, b); }
XRGS_INLINE Float4 max4(Float4 a, Float4 b) { return select4(a > b, a, b); }
XRGS_INLINE void stream4(float* p, Float4 a) { vst1q_f32(p, a); }
XRGS_INLINE void stream_fence() {}
XRGS_INLINE std::uint32_t to_bits(Mask m) {
  const Int4 bits = (m.v[0] & Int4{1, 2, 4, 8}) | (m.v[1] & Int4{16, 32, 64, 128}) |
                    (m.v[2] & Int4{256, 512, 1024, 2048}) |
                    (m.v[3] & Int4{4096, 8192, 16384, 32768});
  return vaddvq_u32(reinterpret_cast<uint32x4_t>(bits));
}

#else

// The number of vectors that fit in sixteen registers of four floats.
constexpr int kVectorRegisters = 4;
constexpr bool kFusedMultiplyAdd = false;

XRGS_INLINE Float4 fma4(Float4 a, Float4 b, Float4 c) { return a * b + c; }
XRGS_INLINE Float4 fnma4(Float4 a, Float4 b, Float4 c) { return c - a * b; }
XRGS_INLINE Float4 select4(Int4 m, Float4 a, Float4 b) {
  return as_float4((m & as_int4(a)) | (~m & as_int4(b)));
}
// Rounds towards zero, then adds `step` if the result is on the wrong side of a. Numbers from 2^23
// on, infinities and NaN are returned unchanged; -0 keeps its sign.
template <class Wrong>
XRGS_INLINE Float4 round4(Float4 a, Float4 step, Wrong&& wrong) {
  const Int4 sign = as_int4(a) & as_int4(same4(-0.0f));
  const Int4 small = as_float4(as_int4(a) & same4(0x7fffffff)) < same4(8388608.0f);
  const Float4 bounded = as_float4(as_int4(a) & small);
  const Float4 whole = __builtin_convertvector(__builtin_convertvector(bounded, Int4), Float4);
  const Float4 rounded = whole + as_float4(as_int4(step) & wrong(whole, bounded));
  return select4(small, as_float4(as_int4(rounded) | sign), a);
}
XRGS_INLINE Float4 floor4(Float4 a) {
  return round4(a, same4(-1.0f), [](Float4 whole, Float4 x) -> Int4 { return whole > x; });
}
XRGS_INLINE Float4 ceil4(Float4 a) {
  return round4(a, same4(1.0f), [](Float4 whole, Float4 x) -> Int4 { return whole < x; });
}

#if defined(__SSE2__)
XRGS_INLINE Float4 sqrt4(Float4 a) { return _mm_sqrt_ps(a); }
XRGS_INLINE Float4 min4(Float4 a, Float4 b) { return _mm_min_ps(a, b); }
XRGS_INLINE Float4 max4(Float4 a, Float4 b) { return _mm_max_ps(a, b); }
XRGS_INLINE void stream4(float* p, Float4 a) { _mm_stream_ps(p, a); }
XRGS_INLINE void stream_fence() { _mm_sfence(); }
XRGS_INLINE std::uint32_t to_bits(Mask m) {
  const auto pair = [](Int4 a, Int4 b) {
    return _mm_packs_epi32(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b));
  };
  return static_cast<std::uint32_t>(
      _mm_movemask_epi8(_mm_packs_epi16(pair(m.v[0], m.v[1]), pair(m.v[2], m.v[3]))));
}
#else
XRGS_INLINE Float4 sqrt4(Float4 a) {
  return Float4{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]),
                __builtin_sqrtf(a[3])};
}
XRGS_INLINE Float4 min4(Float4 a, Float4 b) { return select4(a < b, a, b); }
XRGS_INLINE Float4 max4(Float4 a, Float4 b) { return select4(a > b, a, b); }
XRGS_INLINE void stream4(float* p, Float4 a) { std::memcpy(p, &a, sizeof a); }
XRGS_INLINE void stream_fence() {}
XRGS_INLINE std::uint32_t to_bits(Mask m) {
  std::uint32_t r = 0;
  for (int i = 0; i < 16; ++i) r |= (static_cast<std::uint32_t>(m.v[i / 4][i % 4]) & 1u) << i;
  return r;
}
#endif

#endif

XRGS_INLINE Floats broadcast(float a) { XRGS_EACH(Floats, (static_cast<void>(i), same4(a))); }
XRGS_INLINE Ints broadcast_int(std::int32_t a) {
  XRGS_EACH(Ints, (static_cast<void>(i), same4(a)));
}
XRGS_INLINE Floats load(const float* p) { XRGS_EACH(Floats, load4(p + 4 * i)); }
XRGS_INLINE void store(float* p, Floats a) { std::memcpy(p, a.v, sizeof a.v); }
XRGS_INLINE void store(std::int32_t* p, Ints a) { std::memcpy(p, a.v, sizeof a.v); }
XRGS_INLINE Floats load_first(const float* p, int count) {
  if (count == 16) return load(p);
  float lanes[16] = {};
  for (int i = 0; i < count; ++i) lanes[i] = p[i];
  return load(lanes);
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  if (count == 16) return store(p, a);
  float lanes[16];
  store(lanes, a);
  for (int i = 0; i < count; ++i) p[i] = lanes[i];
}
XRGS_INLINE void stream(float* p, Floats a) {
  for (int i = 0; i < 4; ++i) stream4(p + 4 * i, a.v[i]);
}

XRGS_INLINE Floats operator+(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] + b.v[i]); }
XRGS_INLINE Floats operator-(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] - b.v[i]); }
XRGS_INLINE Floats operator*(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] * b.v[i]); }
XRGS_INLINE Floats operator/(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] / b.v[i]); }
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, fma4(a.v[i], b.v[i], c.v[i]));
}
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, fnma4(a.v[i], b.v[i], c.v[i]));
}
XRGS_INLINE Floats min(Floats a, Floats b) { XRGS_EACH(Floats, min4(a.v[i], b.v[i])); }
XRGS_INLINE Floats max(Floats a, Floats b) { XRGS_EACH(Floats, max4(a.v[i], b.v[i])); }
XRGS_INLINE Floats min_positive(Floats a, Floats b) { return min(a, b); }
XRGS_INLINE Floats abs(Floats a) {
  XRGS_EACH(Floats, as_float4(as_int4(a.v[i]) & same4(0x7fffffff)));
}
XRGS_INLINE Floats sqrt(Floats a) { XRGS_EACH(Floats, sqrt4(a.v[i])); }
XRGS_INLINE Floats floor(Floats a) { XRGS_EACH(Floats, floor4(a.v[i])); }
XRGS_INLINE Floats ceil(Floats a) { XRGS_EACH(Floats, ceil4(a.v[i])); }

XRGS_INLINE Mask operator<(Floats a, Floats b) { XRGS_EACH(Mask, Int4(a.v[i] < b.v[i])); }
XRGS_INLINE Mask operator<=(Floats a, Floats b) { XRGS_EACH(Mask, Int4(a.v[i] <= b.v[i])); }
XRGS_INLINE Mask operator==(Floats a, Floats b) { XRGS_EACH(Mask, Int4(a.v[i] == b.v[i])); }
XRGS_INLINE Mask operator&(Mask a, Mask b) { XRGS_EACH(Mask, a.v[i] & b.v[i]); }
XRGS_INLINE Mask mask_from_bits(std::uint32_t bits) {
  const Int4 all = same4(static_cast<std::int32_t>(bits));
  const auto lanes = [all](Int4 bit) { return Int4((all & bit) == bit); };
  return {lanes(Int4{1, 2, 4, 8}), lanes(Int4{16, 32, 64, 128}), lanes(Int4{256, 512, 1024, 2048}),
          lanes(Int4{4096, 8192, 16384, 32768})};
}
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  XRGS_EACH(Floats, select4(m.v[i], a.v[i], b.v[i]));
}
XRGS_INLINE Floats select_or_zero(Mask m, Floats a) {
  XRGS_EACH(Floats, as_float4(m.v[i] & as_int4(a.v[i])));
}

// Sums and shifts of unsigned integers wrap around.
XRGS_INLINE UInt4 as_uint4(Int4 a) { return reinterpret_cast<UInt4>(a); }
XRGS_INLINE Ints operator+(Ints a, Ints b) {
  XRGS_EACH(Ints, reinterpret_cast<Int4>(as_uint4(a.v[i]) + as_uint4(b.v[i])));
}
XRGS_INLINE Ints operator-(Ints a, Ints b) {
  XRGS_EACH(Ints, reinterpret_cast<Int4>(as_uint4(a.v[i]) - as_uint4(b.v[i])));
}
template <int Count>
XRGS_INLINE Ints shift_left(Ints a) {
  XRGS_EACH(Ints, reinterpret_cast<Int4>(as_uint4(a.v[i]) << Count));
}
template <int Count>
XRGS_INLINE Ints shift_right(Ints a) {
  XRGS_EACH(Ints, a.v[i] >> Count);
}
XRGS_INLINE Ints as_ints(Floats a) { XRGS_EACH(Ints, as_int4(a.v[i])); }
XRGS_INLINE Floats as_floats(Ints a) { XRGS_EACH(Floats, as_float4(a.v[i])); }
XRGS_INLINE Floats to_floats(Ints a) { XRGS_EACH(Floats, __builtin_convertvector(a.v[i], Float4)); }
XRGS_INLINE Ints to_ints(Floats a) { XRGS_EACH(Ints, __builtin_convertvector(a.v[i], Int4)); }

XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  const auto first = [&](int i) { return XRGS_SHUFFLE(a.v[i], b.v[i], 0, 4, 1, 5); };
  const auto second = [&](int i) { return XRGS_SHUFFLE(a.v[i], b.v[i], 2, 6, 3, 7); };
  low = {first(0), second(0), first(1), second(1)};
  high = {first(2), second(2), first(3), second(3)};
}

XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  const auto even = [](Float4 x, Float4 y) { return XRGS_SHUFFLE(x, y, 0, 2, 4, 6); };
  const auto odd = [](Float4 x, Float4 y) { return XRGS_SHUFFLE(x, y, 1, 3, 5, 7); };
  a = {even(low.v[0], low.v[1]), even(low.v[2], low.v[3]), even(high.v[0], high.v[1]),
       even(high.v[2], high.v[3])};
  b = {odd(low.v[0], low.v[1]), odd(low.v[2], low.v[3]), odd(high.v[0], high.v[1]),
       odd(high.v[2], high.v[3])};
}

template <int C>
XRGS_INLINE Floats broadcast_column(Floats a) {
  XRGS_EACH(Floats, XRGS_SHUFFLE(a.v[i], a.v[i], C, C, C, C));
}
template <int R>
XRGS_INLINE Floats broadcast_row(Floats a) {
  return {a.v[R], a.v[R], a.v[R], a.v[R]};
}
// repeat_thrice has p[(16 C + k) / 3] in lane k, and may read up to p[16]. repeat_triple has
// p[(16 C + k) % 3] in lane k, and may read up to p[3]. C is 0 to 2.
template <int C>
XRGS_INLINE Floats repeat_thrice(const float* p) {
  const auto at = [p](int k) { return p[(16 * C + k) / 3]; };
  XRGS_EACH(Floats, (Float4{at(4 * i), at(4 * i + 1), at(4 * i + 2), at(4 * i + 3)}));
}
template <int C>
XRGS_INLINE Floats repeat_triple(const float* p) {
  const auto at = [p](int k) { return p[(16 * C + k) % 3]; };
  XRGS_EACH(Floats, (Float4{at(4 * i), at(4 * i + 1), at(4 * i + 2), at(4 * i + 3)}));
}
XRGS_INLINE Floats sum_rows(Floats a) {
  const Float4 sum = (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
  return {sum, sum, sum, sum};
}

XRGS_INLINE float sum_lanes(Floats a) {
  const Float4 quarter = (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]);
  return (quarter[0] + quarter[2]) + (quarter[1] + quarter[3]);
}

// Transposes the 4x4 block in column `from_column` of the four rows `from`, into column `to_column`
// of the rows `to`, which may be the same.
XRGS_INLINE void transpose_block(const Floats* from, int from_column, Floats* to, int to_column) {
  const Float4 a = from[0].v[from_column], b = from[1].v[from_column];
  const Float4 c = from[2].v[from_column], d = from[3].v[from_column];
  const Float4 ab_low = XRGS_SHUFFLE(a, b, 0, 4, 1, 5), ab_high = XRGS_SHUFFLE(a, b, 2, 6, 3, 7);
  const Float4 cd_low = XRGS_SHUFFLE(c, d, 0, 4, 1, 5), cd_high = XRGS_SHUFFLE(c, d, 2, 6, 3, 7);
  to[0].v[to_column] = XRGS_SHUFFLE(ab_low, cd_low, 0, 1, 4, 5);
  to[1].v[to_column] = XRGS_SHUFFLE(ab_low, cd_low, 2, 3, 6, 7);
  to[2].v[to_column] = XRGS_SHUFFLE(ab_high, cd_high, 0, 1, 4, 5);
  to[3].v[to_column] = XRGS_SHUFFLE(ab_high, cd_high, 2, 3, 6, 7);
}

XRGS_INLINE void transpose(Floats (&r)[16]) {
  Floats t[16];
#pragma GCC unroll 4
  for (int row = 0; row < 4; ++row)
#pragma GCC unroll 4
    for (int column = 0; column < 4; ++column)
      transpose_block(r + 4 * row, column, t + 4 * column, row);
#pragma GCC unroll 16
  for (int i = 0; i < 16; ++i) r[i] = t[i];
}

#undef XRGS_EACH
#undef XRGS_SHUFFLE

}  // namespace XRGS_NS
}  // namespace xrgs

// General forms of the remaining operations.
#include "simd/generic.h"
