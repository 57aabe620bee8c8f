// The operations of simd.h for AVX2 with FMA: two registers for each vector.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace xrgs {
namespace XRGS_NS {

// The number of vectors that fit in the registers.
constexpr int kVectorRegisters = 8;
constexpr bool kFusedMultiplyAdd = true;

struct Floats {
  __m256 lo, hi;
};
struct Ints {
  __m256i lo, hi;
};
struct Mask {
  __m256 lo, hi;
};

XRGS_INLINE Floats broadcast(float a) { return {_mm256_set1_ps(a), _mm256_set1_ps(a)}; }
XRGS_INLINE Ints broadcast_int(std::int32_t a) {
  return {_mm256_set1_epi32(a), _mm256_set1_epi32(a)};
}
XRGS_INLINE Floats load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
XRGS_INLINE void store(float* p, Floats a) {
  _mm256_storeu_ps(p, a.lo);
  _mm256_storeu_ps(p + 8, a.hi);
}
// A mask of lanes from..from+7: all bits are set in lanes with an index below `count`.
XRGS_INLINE __m256i lanes_below(int count, int from) {
  const __m256i lane =
      _mm256_add_epi32(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(from));
  return _mm256_cmpgt_epi32(_mm256_set1_epi32(count), lane);
}
XRGS_INLINE Floats load_first(const float* p, int count) {
  return {_mm256_maskload_ps(p, lanes_below(count, 0)),
          _mm256_maskload_ps(p + 8, lanes_below(count, 8))};
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  _mm256_maskstore_ps(p, lanes_below(count, 0), a.lo);
  _mm256_maskstore_ps(p + 8, lanes_below(count, 8), a.hi);
}
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
XRGS_INLINE std::uint32_t to_bits(Mask m) {
  return static_cast<std::uint32_t>(_mm256_movemask_ps(m.lo)) |
         static_cast<std::uint32_t>(_mm256_movemask_ps(m.hi)) << 8;
}
XRGS_INLINE Mask mask_from_bits(std::uint32_t bits) {
  const __m256i lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
  const auto half = [lane](std::uint32_t byte) {
    const __m256i all = _mm256_set1_epi32(static_cast<std::int32_t>(byte));
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, lane), lane));
  };
  return {half(bits & 255u), half(bits >> 8)};
}
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  return {_mm256_blendv_ps(b.lo, a.lo, m.lo), _mm256_blendv_ps(b.hi, a.hi, m.hi)};
}
XRGS_INLINE Floats select_or_zero(Mask m, Floats a) {
  return {_mm256_and_ps(m.lo, a.lo), _mm256_and_ps(m.hi, a.hi)};
}

XRGS_INLINE Ints operator+(Ints a, Ints b) {
  return {_mm256_add_epi32(a.lo, b.lo), _mm256_add_epi32(a.hi, b.hi)};
}
XRGS_INLINE Ints operator-(Ints a, Ints b) {
  return {_mm256_sub_epi32(a.lo, b.lo), _mm256_sub_epi32(a.hi, b.hi)};
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

XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  const auto half = [](__m256 x, __m256 y) -> Floats {
    const __m256 even = _mm256_unpacklo_ps(x, y), odd = _mm256_unpackhi_ps(x, y);
    return {_mm256_permute2f128_ps(even, odd, 0x20), _mm256_permute2f128_ps(even, odd, 0x31)};
  };
  low = half(a.lo, b.lo);
  high = half(a.hi, b.hi);
}

XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  const auto ordered = [](__m256 x) {
    return _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(x), 0xd8));
  };
  a = {ordered(_mm256_shuffle_ps(low.lo, low.hi, 0x88)),
       ordered(_mm256_shuffle_ps(high.lo, high.hi, 0x88))};
  b = {ordered(_mm256_shuffle_ps(low.lo, low.hi, 0xdd)),
       ordered(_mm256_shuffle_ps(high.lo, high.hi, 0xdd))};
}

template <int C>
XRGS_INLINE Floats broadcast_column(Floats a) {
  return {_mm256_permute_ps(a.lo, C * 0x55), _mm256_permute_ps(a.hi, C * 0x55)};
}
template <int R>
XRGS_INLINE Floats broadcast_row(Floats a) {
  const __m256 half = R < 2 ? a.lo : a.hi;
  const __m256 row = _mm256_permute2f128_ps(half, half, (R & 1) * 0x11);
  return {row, row};
}
// repeat_thrice has p[(16 C + k) / 3] in lane k, and may read up to p[16]. repeat_triple has
// p[(16 C + k) % 3] in lane k, and may read up to p[3]. C is 0 to 2.
template <int K>  // eight lanes from K on
XRGS_INLINE __m256 repeat_thrice8(const float* p) {
  constexpr int first = K / 3, r = K % 3;
  const __m256i at = _mm256_setr_epi32(0, (r + 1) / 3, (r + 2) / 3, (r + 3) / 3, (r + 4) / 3,
                                       (r + 5) / 3, (r + 6) / 3, (r + 7) / 3);
  return _mm256_permutevar_ps(_mm256_broadcast_ps(reinterpret_cast<const __m128*>(p + first)), at);
}
template <int C>
XRGS_INLINE Floats repeat_thrice(const float* p) {
  return {repeat_thrice8<16 * C>(p), repeat_thrice8<16 * C + 8>(p)};
}
template <int K>
XRGS_INLINE __m256 repeat_triple8(__m256 triple) {
  constexpr int a = K % 3, b = (K + 1) % 3, c = (K + 2) % 3;
  return _mm256_permutevar_ps(triple, _mm256_setr_epi32(a, b, c, a, b, c, a, b));
}
template <int C>
XRGS_INLINE Floats repeat_triple(const float* p) {
  const __m256 triple = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p));
  return {repeat_triple8<16 * C>(triple), repeat_triple8<16 * C + 8>(triple)};
}
XRGS_INLINE Floats sum_rows(Floats a) {
  const __m256 pairs = _mm256_add_ps(a.lo, a.hi);
  const __m256 all = _mm256_add_ps(pairs, _mm256_permute2f128_ps(pairs, pairs, 0x01));
  return {all, all};
}

XRGS_INLINE float sum_lanes(Floats a) {
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

XRGS_INLINE void stream_fence() { _mm_sfence(); }

}  // namespace XRGS_NS
}  // namespace xrgs

// General forms of the remaining operations.
#include "simd/generic.h"
