// Sixteen float lanes: one AVX-512 register, two AVX2 registers, or an array that the compiler
// vectorises as it can. Kernels are written once in these terms and compiled for each.
//
// Kernel files must not call inline functions of the standard library that are not surely inlined:
// the linker keeps one copy of such a function for the whole module, and it may keep the one
// compiled for a processor that we are not running on.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

namespace xrgs {
namespace XRGS_NS {

constexpr int kLanes = 16;

#define XRGS_INLINE inline __attribute__((always_inline))

#if defined(__AVX512F__)

struct Floats {
  __m512 v;
};
struct Ints {
  __m512i v;
};
struct Mask {
  __mmask16 v;
};

XRGS_INLINE Floats splat(float a) { return {_mm512_set1_ps(a)}; }
XRGS_INLINE Ints splat_int(std::int32_t a) { return {_mm512_set1_epi32(a)}; }
XRGS_INLINE Floats load(const float* p) { return {_mm512_loadu_ps(p)}; }
XRGS_INLINE void store(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
// The first `count` (0 to 16) lanes; the others are zero, or left alone.
XRGS_INLINE Floats load_first(const float* p, int count) {
  return {_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1), p)};
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1), a.v);
}
// Past the cache, to a place on a 64-byte boundary that nobody reads soon.
XRGS_INLINE void stream(float* p, Floats a) { _mm512_stream_ps(p, a.v); }

XRGS_INLINE Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator-(Floats a, Floats b) { return {_mm512_sub_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator/(Floats a, Floats b) { return {_mm512_div_ps(a.v, b.v)}; }
// a b + c and c - a b
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
XRGS_INLINE Floats min(Floats a, Floats b) { return {_mm512_min_ps(a.v, b.v)}; }
XRGS_INLINE Floats max(Floats a, Floats b) { return {_mm512_max_ps(a.v, b.v)}; }
// Of positive numbers (of others, anything): compared as integers, which more units can do.
XRGS_INLINE Floats min_positive(Floats a, Floats b) {
  return {
      _mm512_castsi512_ps(_mm512_min_epi32(_mm512_castps_si512(a.v), _mm512_castps_si512(b.v)))};
}
XRGS_INLINE Floats abs(Floats a) { return {_mm512_abs_ps(a.v)}; }
XRGS_INLINE Floats sqrt(Floats a) { return {_mm512_sqrt_ps(a.v)}; }
XRGS_INLINE Floats floor(Floats a) {
  return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};
}
XRGS_INLINE Floats ceil(Floats a) {
  return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC)};
}

XRGS_INLINE Mask operator<(Floats a, Floats b) {
  return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)};
}
XRGS_INLINE Mask operator<=(Floats a, Floats b) {
  return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)};
}
XRGS_INLINE Mask operator==(Floats a, Floats b) {
  return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_EQ_OQ)};
}
XRGS_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.v & b.v)}; }
XRGS_INLINE Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.v | b.v)}; }
XRGS_INLINE std::uint32_t bits(Mask m) { return m.v; }
XRGS_INLINE Mask mask_of(std::uint32_t bits) { return {static_cast<__mmask16>(bits)}; }
// m ? a : b, and m ? a : 0
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  return {_mm512_mask_mov_ps(b.v, m.v, a.v)};
}
XRGS_INLINE Floats keep(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m.v, a.v)}; }

XRGS_INLINE Ints operator+(Ints a, Ints b) { return {_mm512_add_epi32(a.v, b.v)}; }
XRGS_INLINE Ints operator-(Ints a, Ints b) { return {_mm512_sub_epi32(a.v, b.v)}; }
XRGS_INLINE Ints operator&(Ints a, Ints b) { return {_mm512_and_si512(a.v, b.v)}; }
XRGS_INLINE Ints operator|(Ints a, Ints b) { return {_mm512_or_si512(a.v, b.v)}; }
template <int Count>
XRGS_INLINE Ints shift_left(Ints a) {
  return {_mm512_slli_epi32(a.v, Count)};
}
template <int Count>
XRGS_INLINE Ints shift_right(Ints a) {
  return {_mm512_srai_epi32(a.v, Count)};
}
XRGS_INLINE Ints as_ints(Floats a) { return {_mm512_castps_si512(a.v)}; }
XRGS_INLINE Floats as_floats(Ints a) { return {_mm512_castsi512_ps(a.v)}; }
XRGS_INLINE Floats to_floats(Ints a) { return {_mm512_cvtepi32_ps(a.v)}; }
XRGS_INLINE Ints to_ints(Floats a) { return {_mm512_cvttps_epi32(a.v)}; }
XRGS_INLINE void store(std::int32_t* p, Ints a) { _mm512_storeu_si512(p, a.v); }

// a0 b0 a1 b1 ... a7 b7, and a8 b8 ... a15 b15
XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  const __m512i first = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const __m512i second = _mm512_add_epi32(first, _mm512_set1_epi32(8));
  low = {_mm512_permutex2var_ps(a.v, first, b.v)};
  high = {_mm512_permutex2var_ps(a.v, second, b.v)};
}

// The inverse: a0 a1 ... and b0 b1 ...
XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
  a = {_mm512_permutex2var_ps(low.v, even, high.v)};
  b = {_mm512_permutex2var_ps(low.v, odd, high.v)};
}

// The lanes as a 4x4 matrix, row by row: every row its own column C; row R in every row; and the
// sum of the rows in every row.
template <int C>
XRGS_INLINE Floats splat_column(Floats a) {
  return {_mm512_permute_ps(a.v, C * 0x55)};
}
template <int R>
XRGS_INLINE Floats splat_row(Floats a) {
  return {_mm512_shuffle_f32x4(a.v, a.v, R * 0x55)};
}
XRGS_INLINE Floats sum_rows(Floats a) {
  a = {_mm512_add_ps(a.v, _mm512_shuffle_f32x4(a.v, a.v, 0x4e))};
  return {_mm512_add_ps(a.v, _mm512_shuffle_f32x4(a.v, a.v, 0xb1))};
}
// a, but a + b in the last row.
XRGS_INLINE Floats add_last_row(Floats a, Floats b) {
  return {_mm512_mask_add_ps(a.v, 0xf000, a.v, b.v)};
}

XRGS_INLINE float sum(Floats a) {
  const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1));
  const __m128 quarter = _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  const __m128 pair = _mm_add_ps(quarter, _mm_movehl_ps(quarter, quarter));
  return _mm_cvtss_f32(_mm_add_ss(pair, _mm_movehdup_ps(pair)));
}

// Row i, lane j becomes row j, lane i.
XRGS_INLINE void transpose(Floats (&r)[16]) {
  __m512 t[16], u[16];
  for (int i = 0; i < 16; i += 2) {
    t[i] = _mm512_unpacklo_ps(r[i].v, r[i + 1].v);
    t[i + 1] = _mm512_unpackhi_ps(r[i].v, r[i + 1].v);
  }
  for (int i = 0; i < 16; i += 4) {
    const __m512d a = _mm512_castps_pd(t[i]), b = _mm512_castps_pd(t[i + 1]);
    const __m512d c = _mm512_castps_pd(t[i + 2]), d = _mm512_castps_pd(t[i + 3]);
    u[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
    u[i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
    u[i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
    u[i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
  }
  for (int i = 0; i < 4; ++i) {
    t[i] = _mm512_shuffle_f32x4(u[i], u[i + 4], 0x88);
    t[i + 4] = _mm512_shuffle_f32x4(u[i], u[i + 4], 0xdd);
    t[i + 8] = _mm512_shuffle_f32x4(u[i + 8], u[i + 12], 0x88);
    t[i + 12] = _mm512_shuffle_f32x4(u[i + 8], u[i + 12], 0xdd);
  }
  for (int i = 0; i < 4; ++i) {
    r[i] = {_mm512_shuffle_f32x4(t[i], t[i + 8], 0x88)};
    r[i + 8] = {_mm512_shuffle_f32x4(t[i], t[i + 8], 0xdd)};
    r[i + 4] = {_mm512_shuffle_f32x4(t[i + 4], t[i + 12], 0x88)};
    r[i + 12] = {_mm512_shuffle_f32x4(t[i + 4], t[i + 12], 0xdd)};
  }
}

#elif defined(__AVX2__)

struct Floats {
  __m256 lo, hi;
};
struct Ints {
  __m256i lo, hi;
};
struct Mask {
  __m256 lo, hi;
};

XRGS_INLINE Floats splat(float a) { return {_mm256_set1_ps(a), _mm256_set1_ps(a)}; }
XRGS_INLINE Ints splat_int(std::int32_t a) { return {_mm256_set1_epi32(a), _mm256_set1_epi32(a)}; }
XRGS_INLINE Floats load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
XRGS_INLINE void store(float* p, Floats a) {
  _mm256_storeu_ps(p, a.lo);
  _mm256_storeu_ps(p + 8, a.hi);
}
// Lanes from..from+7 that are below `count`.
XRGS_INLINE __m256i lanes_below(int count, int from) {
  const __m256i lane =
      _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(from));
  return _mm256_cmpgt_epi32(_mm256_set1_epi32(count), lane);
}
// The first `count` (0 to 16) lanes; the others are zero, or left alone.
XRGS_INLINE Floats load_first(const float* p, int count) {
  return {_mm256_maskload_ps(p, lanes_below(count, 0)),
          _mm256_maskload_ps(p + 8, lanes_below(count, 8))};
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  _mm256_maskstore_ps(p, lanes_below(count, 0), a.lo);
  _mm256_maskstore_ps(p + 8, lanes_below(count, 8), a.hi);
}
// Past the cache, to a place on a 64-byte boundary that nobody reads soon.
XRGS_INLINE void stream(float* p, Floats a) {
  _mm256_stream_ps(p, a.lo);
  _mm256_stream_ps(p + 8, a.hi);
}

XRGS_INLINE Floats operator+(Floats a, Floats b) {
  return {_mm256_add_ps(a.lo, b.lo), _mm256_add_ps(a.hi, b.hi)};
}
XRGS_INLINE Floats operator-(Floats a, Floats b) {
  return {_mm256_sub_ps(a.lo, b.lo), _mm256_sub_ps(a.hi, b.hi)};
}
XRGS_INLINE Floats operator*(Floats a, Floats b) {
  return {_mm256_mul_ps(a.lo, b.lo), _mm256_mul_ps(a.hi, b.hi)};
}
XRGS_INLINE Floats operator/(Floats a, Floats b) {
  return {_mm256_div_ps(a.lo, b.lo), _mm256_div_ps(a.hi, b.hi)};
}
// a b + c and c - a b
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) {
  return {_mm256_fmadd_ps(a.lo, b.lo, c.lo), _mm256_fmadd_ps(a.hi, b.hi, c.hi)};
}
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) {
  return {_mm256_fnmadd_ps(a.lo, b.lo, c.lo), _mm256_fnmadd_ps(a.hi, b.hi, c.hi)};
}
XRGS_INLINE Floats min(Floats a, Floats b) {
  return {_mm256_min_ps(a.lo, b.lo), _mm256_min_ps(a.hi, b.hi)};
}
XRGS_INLINE Floats max(Floats a, Floats b) {
  return {_mm256_max_ps(a.lo, b.lo), _mm256_max_ps(a.hi, b.hi)};
}
// Of positive numbers (of others, anything).
XRGS_INLINE Floats min_positive(Floats a, Floats b) { return min(a, b); }
XRGS_INLINE Floats abs(Floats a) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(sign, a.lo), _mm256_andnot_ps(sign, a.hi)};
}
XRGS_INLINE Floats sqrt(Floats a) { return {_mm256_sqrt_ps(a.lo), _mm256_sqrt_ps(a.hi)}; }
XRGS_INLINE Floats floor(Floats a) { return {_mm256_floor_ps(a.lo), _mm256_floor_ps(a.hi)}; }
XRGS_INLINE Floats ceil(Floats a) { return {_mm256_ceil_ps(a.lo), _mm256_ceil_ps(a.hi)}; }

XRGS_INLINE Mask operator<(Floats a, Floats b) {
  return {_mm256_cmp_ps(a.lo, b.lo, _CMP_LT_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_LT_OQ)};
}
XRGS_INLINE Mask operator<=(Floats a, Floats b) {
  return {_mm256_cmp_ps(a.lo, b.lo, _CMP_LE_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_LE_OQ)};
}
XRGS_INLINE Mask operator==(Floats a, Floats b) {
  return {_mm256_cmp_ps(a.lo, b.lo, _CMP_EQ_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_EQ_OQ)};
}
XRGS_INLINE Mask operator&(Mask a, Mask b) {
  return {_mm256_and_ps(a.lo, b.lo), _mm256_and_ps(a.hi, b.hi)};
}
XRGS_INLINE Mask operator|(Mask a, Mask b) {
  return {_mm256_or_ps(a.lo, b.lo), _mm256_or_ps(a.hi, b.hi)};
}
XRGS_INLINE std::uint32_t bits(Mask m) {
  return static_cast<std::uint32_t>(_mm256_movemask_ps(m.lo)) |
         static_cast<std::uint32_t>(_mm256_movemask_ps(m.hi)) << 8;
}
XRGS_INLINE Mask mask_of(std::uint32_t bits) {
  const __m256i lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
  const auto half = [lane](std::uint32_t byte) {
    const __m256i all = _mm256_set1_epi32(static_cast<std::int32_t>(byte));
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, lane), lane));
  };
  return {half(bits & 255u), half(bits >> 8)};
}
// m ? a : b, and m ? a : 0
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  return {_mm256_blendv_ps(b.lo, a.lo, m.lo), _mm256_blendv_ps(b.hi, a.hi, m.hi)};
}
XRGS_INLINE Floats keep(Mask m, Floats a) {
  return {_mm256_and_ps(m.lo, a.lo), _mm256_and_ps(m.hi, a.hi)};
}

XRGS_INLINE Ints operator+(Ints a, Ints b) {
  return {_mm256_add_epi32(a.lo, b.lo), _mm256_add_epi32(a.hi, b.hi)};
}
XRGS_INLINE Ints operator-(Ints a, Ints b) {
  return {_mm256_sub_epi32(a.lo, b.lo), _mm256_sub_epi32(a.hi, b.hi)};
}
XRGS_INLINE Ints operator&(Ints a, Ints b) {
  return {_mm256_and_si256(a.lo, b.lo), _mm256_and_si256(a.hi, b.hi)};
}
XRGS_INLINE Ints operator|(Ints a, Ints b) {
  return {_mm256_or_si256(a.lo, b.lo), _mm256_or_si256(a.hi, b.hi)};
}
template <int Count>
XRGS_INLINE Ints shift_left(Ints a) {
  return {_mm256_slli_epi32(a.lo, Count), _mm256_slli_epi32(a.hi, Count)};
}
template <int Count>
XRGS_INLINE Ints shift_right(Ints a) {
  return {_mm256_srai_epi32(a.lo, Count), _mm256_srai_epi32(a.hi, Count)};
}
XRGS_INLINE Ints as_ints(Floats a) {
  return {_mm256_castps_si256(a.lo), _mm256_castps_si256(a.hi)};
}
XRGS_INLINE Floats as_floats(Ints a) {
  return {_mm256_castsi256_ps(a.lo), _mm256_castsi256_ps(a.hi)};
}
XRGS_INLINE Floats to_floats(Ints a) {
  return {_mm256_cvtepi32_ps(a.lo), _mm256_cvtepi32_ps(a.hi)};
}
XRGS_INLINE Ints to_ints(Floats a) {
  return {_mm256_cvttps_epi32(a.lo), _mm256_cvttps_epi32(a.hi)};
}
XRGS_INLINE void store(std::int32_t* p, Ints a) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), a.lo);
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + 8), a.hi);
}

// a0 b0 a1 b1 ... a7 b7, and a8 b8 ... a15 b15
XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  const auto half = [](__m256 x, __m256 y) -> Floats {
    const __m256 even = _mm256_unpacklo_ps(x, y), odd = _mm256_unpackhi_ps(x, y);
    return {_mm256_permute2f128_ps(even, odd, 0x20), _mm256_permute2f128_ps(even, odd, 0x31)};
  };
  low = half(a.lo, b.lo);
  high = half(a.hi, b.hi);
}

// The inverse: a0 a1 ... and b0 b1 ...
XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  const auto ordered = [](__m256 x) {
    return _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(x), 0xd8));
  };
  a = {ordered(_mm256_shuffle_ps(low.lo, low.hi, 0x88)),
       ordered(_mm256_shuffle_ps(high.lo, high.hi, 0x88))};
  b = {ordered(_mm256_shuffle_ps(low.lo, low.hi, 0xdd)),
       ordered(_mm256_shuffle_ps(high.lo, high.hi, 0xdd))};
}

// The lanes as a 4x4 matrix, row by row: every row its own column C; row R in every row; and the
// sum of the rows in every row.
template <int C>
XRGS_INLINE Floats splat_column(Floats a) {
  return {_mm256_permute_ps(a.lo, C * 0x55), _mm256_permute_ps(a.hi, C * 0x55)};
}
template <int R>
XRGS_INLINE Floats splat_row(Floats a) {
  const __m256 half = R < 2 ? a.lo : a.hi;
  const __m256 row = _mm256_permute2f128_ps(half, half, (R & 1) * 0x11);
  return {row, row};
}
XRGS_INLINE Floats sum_rows(Floats a) {
  const __m256 pairs = _mm256_add_ps(a.lo, a.hi);
  const __m256 all = _mm256_add_ps(pairs, _mm256_permute2f128_ps(pairs, pairs, 0x01));
  return {all, all};
}
// a, but a + b in the last row.
XRGS_INLINE Floats add_last_row(Floats a, Floats b) {
  return {a.lo, _mm256_blend_ps(a.hi, _mm256_add_ps(a.hi, b.hi), 0xf0)};
}

XRGS_INLINE float sum(Floats a) {
  const __m256 half = _mm256_add_ps(a.lo, a.hi);
  const __m128 quarter = _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  const __m128 pair = _mm_add_ps(quarter, _mm_movehl_ps(quarter, quarter));
  return _mm_cvtss_f32(_mm_add_ss(pair, _mm_movehdup_ps(pair)));
}

XRGS_INLINE void transpose8(__m256 (&r)[8]) {
  __m256 t[8], u[8];
  for (int i = 0; i < 8; i += 2) {
    t[i] = _mm256_unpacklo_ps(r[i], r[i + 1]);
    t[i + 1] = _mm256_unpackhi_ps(r[i], r[i + 1]);
  }
  for (int i = 0; i < 8; i += 4) {
    u[i] = _mm256_shuffle_ps(t[i], t[i + 2], 0x44);
    u[i + 1] = _mm256_shuffle_ps(t[i], t[i + 2], 0xee);
    u[i + 2] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0x44);
    u[i + 3] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0xee);
  }
  for (int i = 0; i < 4; ++i) {
    r[i] = _mm256_permute2f128_ps(u[i], u[i + 4], 0x20);
    r[i + 4] = _mm256_permute2f128_ps(u[i], u[i + 4], 0x31);
  }
}

// Row i, lane j becomes row j, lane i.
XRGS_INLINE void transpose(Floats (&r)[16]) {
  __m256 block[4][8];
  for (int i = 0; i < 8; ++i) {
    block[0][i] = r[i].lo;
    block[1][i] = r[i].hi;
    block[2][i] = r[i + 8].lo;
    block[3][i] = r[i + 8].hi;
  }
  for (auto& b : block) transpose8(b);
  for (int i = 0; i < 8; ++i) {
    r[i] = {block[0][i], block[2][i]};
    r[i + 8] = {block[1][i], block[3][i]};
  }
}

#else

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

XRGS_INLINE Floats splat(float a) { XRGS_EACH(Floats, a); }
XRGS_INLINE Ints splat_int(std::int32_t a) { XRGS_EACH(Ints, a); }
XRGS_INLINE Floats load(const float* p) { XRGS_EACH(Floats, p[i]); }
XRGS_INLINE void store(float* p, Floats a) {
  for (int i = 0; i < 16; ++i) p[i] = a.v[i];
}
// The first `count` (0 to 16) lanes; the others are zero, or left alone.
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
// a b + c and c - a b
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, a.v[i] * b.v[i] + c.v[i]);
}
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) {
  XRGS_EACH(Floats, c.v[i] - a.v[i] * b.v[i]);
}
XRGS_INLINE Floats min(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
XRGS_INLINE Floats max(Floats a, Floats b) { XRGS_EACH(Floats, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
// Of positive numbers (of others, anything).
XRGS_INLINE Floats min_positive(Floats a, Floats b) { return min(a, b); }
XRGS_INLINE Floats abs(Floats a) { XRGS_EACH(Floats, __builtin_fabsf(a.v[i])); }
XRGS_INLINE Floats sqrt(Floats a) { XRGS_EACH(Floats, __builtin_sqrtf(a.v[i])); }
XRGS_INLINE Floats floor(Floats a) { XRGS_EACH(Floats, __builtin_floorf(a.v[i])); }
XRGS_INLINE Floats ceil(Floats a) { XRGS_EACH(Floats, __builtin_ceilf(a.v[i])); }

XRGS_INLINE Mask operator<(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] < b.v[i])); }
XRGS_INLINE Mask operator<=(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] <= b.v[i])); }
XRGS_INLINE Mask operator==(Floats a, Floats b) { XRGS_EACH(Mask, -(a.v[i] == b.v[i])); }
XRGS_INLINE Mask operator&(Mask a, Mask b) { XRGS_EACH(Mask, a.v[i] & b.v[i]); }
XRGS_INLINE Mask operator|(Mask a, Mask b) { XRGS_EACH(Mask, a.v[i] | b.v[i]); }
XRGS_INLINE std::uint32_t bits(Mask m) {
  std::uint32_t r = 0;
  for (int i = 0; i < 16; ++i) r |= (static_cast<std::uint32_t>(m.v[i]) & 1u) << i;
  return r;
}
XRGS_INLINE Mask mask_of(std::uint32_t bits) {
  XRGS_EACH(Mask, -static_cast<std::int32_t>((bits >> i) & 1u));
}
// m ? a : b, and m ? a : 0
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  XRGS_EACH(Floats, m.v[i] ? a.v[i] : b.v[i]);
}
XRGS_INLINE Floats keep(Mask m, Floats a) { XRGS_EACH(Floats, m.v[i] ? a.v[i] : 0.0f); }

// Sums wrap around, as those of the vectors do.
XRGS_INLINE std::uint32_t unsigned_of(std::int32_t a) { return static_cast<std::uint32_t>(a); }
XRGS_INLINE Ints operator+(Ints a, Ints b) {
  XRGS_EACH(Ints, static_cast<std::int32_t>(unsigned_of(a.v[i]) + unsigned_of(b.v[i])));
}
XRGS_INLINE Ints operator-(Ints a, Ints b) {
  XRGS_EACH(Ints, static_cast<std::int32_t>(unsigned_of(a.v[i]) - unsigned_of(b.v[i])));
}
XRGS_INLINE Ints operator&(Ints a, Ints b) { XRGS_EACH(Ints, a.v[i] & b.v[i]); }
XRGS_INLINE Ints operator|(Ints a, Ints b) { XRGS_EACH(Ints, a.v[i] | b.v[i]); }
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

// a0 b0 a1 b1 ... a7 b7, and a8 b8 ... a15 b15
XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  for (int i = 0; i < 8; ++i) {
    low.v[2 * i] = a.v[i];
    low.v[2 * i + 1] = b.v[i];
    high.v[2 * i] = a.v[i + 8];
    high.v[2 * i + 1] = b.v[i + 8];
  }
}

// The inverse: a0 a1 ... and b0 b1 ...
XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  for (int i = 0; i < 8; ++i) {
    a.v[i] = low.v[2 * i];
    b.v[i] = low.v[2 * i + 1];
    a.v[i + 8] = high.v[2 * i];
    b.v[i + 8] = high.v[2 * i + 1];
  }
}

// The lanes as a 4x4 matrix, row by row: every row its own column C; row R in every row; and the
// sum of the rows in every row.
template <int C>
XRGS_INLINE Floats splat_column(Floats a) {
  XRGS_EACH(Floats, a.v[i / 4 * 4 + C]);
}
template <int R>
XRGS_INLINE Floats splat_row(Floats a) {
  XRGS_EACH(Floats, a.v[4 * R + i % 4]);
}
XRGS_INLINE Floats sum_rows(Floats a) {
  XRGS_EACH(Floats, (a.v[i % 4] + a.v[8 + i % 4]) + (a.v[4 + i % 4] + a.v[12 + i % 4]));
}
// a, but a + b in the last row.
XRGS_INLINE Floats add_last_row(Floats a, Floats b) {
  XRGS_EACH(Floats, i < 12 ? a.v[i] : a.v[i] + b.v[i]);
}

XRGS_INLINE float sum(Floats a) {
  for (int width = 8; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) a.v[i] += a.v[i + width];
  return a.v[0];
}

// Row i, lane j becomes row j, lane i.
XRGS_INLINE void transpose(Floats (&r)[16]) {
  for (int i = 0; i < 16; ++i)
    for (int j = 0; j < i; ++j) {
      const float t = r[i].v[j];
      r[i].v[j] = r[j].v[i];
      r[j].v[i] = t;
    }
}

#undef XRGS_EACH
#endif

// Sixteen triples or quadruples side by side, to and from a vector for each part.
#if defined(__AVX512F__)
XRGS_INLINE void load_triples(const float* p, Floats& x, Floats& y, Floats& z) {
  const __m512 a = _mm512_loadu_ps(p), b = _mm512_loadu_ps(p + 16), c = _mm512_loadu_ps(p + 32);
  // Lanes 0-10 or so come from a and b, the rest from c.
  const __m512i x1 = _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
  const __m512i x2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
  const __m512i y1 = _mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
  const __m512i y2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
  const __m512i z1 = _mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
  const __m512i z2 = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);
  x = {_mm512_permutex2var_ps(_mm512_permutex2var_ps(a, x1, b), x2, c)};
  y = {_mm512_permutex2var_ps(_mm512_permutex2var_ps(a, y1, b), y2, c)};
  z = {_mm512_permutex2var_ps(_mm512_permutex2var_ps(a, z1, b), z2, c)};
}
XRGS_INLINE void store_triples(float* p, Floats x, Floats y, Floats z) {
  const __m512i a1 = _mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5);
  const __m512i a2 = _mm512_setr_epi32(0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
  const __m512i b1 = _mm512_setr_epi32(21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26);
  const __m512i b2 = _mm512_setr_epi32(0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
  const __m512i c1 = _mm512_setr_epi32(0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0);
  const __m512i c2 = _mm512_setr_epi32(26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
  const __m512 a = _mm512_permutex2var_ps(x.v, a1, y.v), b = _mm512_permutex2var_ps(x.v, b1, y.v);
  const __m512 c = _mm512_permutex2var_ps(x.v, c1, y.v);
  _mm512_storeu_ps(p, _mm512_permutex2var_ps(a, a2, z.v));
  _mm512_storeu_ps(p + 16, _mm512_permutex2var_ps(b, b2, z.v));
  _mm512_storeu_ps(p + 32, _mm512_permutex2var_ps(c, c2, z.v));
}
#else
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
#endif
XRGS_INLINE void load_quadruples(const float* p, Floats& w, Floats& x, Floats& y, Floats& z) {
  Floats wy[2], xz[2];
  deinterleave(load(p), load(p + 16), wy[0], xz[0]);
  deinterleave(load(p + 32), load(p + 48), wy[1], xz[1]);
  deinterleave(wy[0], wy[1], w, y);
  deinterleave(xz[0], xz[1], x, z);
}
XRGS_INLINE void store_quadruples(float* p, Floats w, Floats x, Floats y, Floats z) {
  Floats wy[2], xz[2], out[4];
  interleave(w, y, wy[0], wy[1]);
  interleave(x, z, xz[0], xz[1]);
  interleave(wy[0], xz[0], out[0], out[1]);
  interleave(wy[1], xz[1], out[2], out[3]);
  for (int i = 0; i < 4; ++i) store(p + 16 * i, out[i]);
}

XRGS_INLINE Floats operator-(Floats a) { return splat(0.0f) - a; }
XRGS_INLINE Floats& operator+=(Floats& a, Floats b) { return a = a + b; }
XRGS_INLINE Floats clamp(Floats a, Floats low, Floats high) { return min(max(a, low), high); }
XRGS_INLINE bool any(Mask m) { return bits(m) != 0; }

// Make the stores of `stream` visible to other threads.
XRGS_INLINE void stream_fence() {
#if defined(__AVX2__)
  _mm_sfence();
#endif
}

XRGS_INLINE void prefetch(const void* p) { __builtin_prefetch(p, 0, 3); }

}  // namespace XRGS_NS
}  // namespace xrgs
