// The operations of simd.h for AVX-512 (F, DQ, BW and VL): one register for each vector.
#pragma once

#include <immintrin.h>

#include <cstdint>

namespace xrgs {
namespace XRGS_NS {

// The number of vectors that fit in the registers.
constexpr int kVectorRegisters = 32;
constexpr bool kFusedMultiplyAdd = true;

struct Floats {
  __m512 v;
};
struct Ints {
  __m512i v;
};
struct Mask {
  __mmask16 v;
};

XRGS_INLINE Floats broadcast(float a) { return {_mm512_set1_ps(a)}; }
XRGS_INLINE Ints broadcast_int(std::int32_t a) { return {_mm512_set1_epi32(a)}; }
XRGS_INLINE Floats load(const float* p) { return {_mm512_loadu_ps(p)}; }
XRGS_INLINE void store(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
XRGS_INLINE Floats load_first(const float* p, int count) {
  return {_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1), p)};
}
XRGS_INLINE void store_first(float* p, Floats a, int count) {
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1), a.v);
}
XRGS_INLINE void stream(float* p, Floats a) { _mm512_stream_ps(p, a.v); }

XRGS_INLINE Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator-(Floats a, Floats b) { return {_mm512_sub_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
XRGS_INLINE Floats operator/(Floats a, Floats b) { return {_mm512_div_ps(a.v, b.v)}; }
XRGS_INLINE Floats fma(Floats a, Floats b, Floats c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
XRGS_INLINE Floats fnma(Floats a, Floats b, Floats c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
XRGS_INLINE Floats min(Floats a, Floats b) { return {_mm512_min_ps(a.v, b.v)}; }
XRGS_INLINE Floats max(Floats a, Floats b) { return {_mm512_max_ps(a.v, b.v)}; }
// Positive floats have the same order as their bits as integers, and more execution units compare
// integers.
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
XRGS_INLINE std::uint32_t to_bits(Mask m) { return m.v; }
XRGS_INLINE Mask mask_from_bits(std::uint32_t bits) { return {static_cast<__mmask16>(bits)}; }
XRGS_INLINE Floats select(Mask m, Floats a, Floats b) {
  return {_mm512_mask_mov_ps(b.v, m.v, a.v)};
}
XRGS_INLINE Floats select_or_zero(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m.v, a.v)}; }
XRGS_INLINE Floats multiply_where(Mask m, Floats a, Floats b) {
  return {_mm512_maskz_mul_ps(m.v, a.v, b.v)};
}
XRGS_INLINE Floats min_positive_where(Mask m, Floats a, Floats b) {
  return {_mm512_castsi512_ps(
      _mm512_maskz_min_epi32(m.v, _mm512_castps_si512(a.v), _mm512_castps_si512(b.v)))};
}

XRGS_INLINE Ints operator+(Ints a, Ints b) { return {_mm512_add_epi32(a.v, b.v)}; }
XRGS_INLINE Ints operator-(Ints a, Ints b) { return {_mm512_sub_epi32(a.v, b.v)}; }
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

XRGS_INLINE void interleave(Floats a, Floats b, Floats& low, Floats& high) {
  const __m512i first = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const __m512i second = _mm512_add_epi32(first, _mm512_set1_epi32(8));
  low = {_mm512_permutex2var_ps(a.v, first, b.v)};
  high = {_mm512_permutex2var_ps(a.v, second, b.v)};
}

XRGS_INLINE void deinterleave(Floats low, Floats high, Floats& a, Floats& b) {
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
  a = {_mm512_permutex2var_ps(low.v, even, high.v)};
  b = {_mm512_permutex2var_ps(low.v, odd, high.v)};
}

template <int C>
XRGS_INLINE Floats broadcast_column(Floats a) {
  return {_mm512_permute_ps(a.v, C * 0x55)};
}
template <int R>
XRGS_INLINE Floats broadcast_row(Floats a) {
  return {_mm512_shuffle_f32x4(a.v, a.v, R * 0x55)};
}
// repeat_thrice has p[(16 C + k) / 3] in lane k, and may read up to p[16]. repeat_triple has
// p[(16 C + k) % 3] in lane k, and may read up to p[3]. C is 0 to 2.
template <int C>
XRGS_INLINE Floats repeat_thrice(const float* p) {
  constexpr int k = 16 * C;
  const __m512i at = _mm512_setr_epi32(k / 3, (k + 1) / 3, (k + 2) / 3, (k + 3) / 3, (k + 4) / 3,
                                       (k + 5) / 3, (k + 6) / 3, (k + 7) / 3, (k + 8) / 3,
                                       (k + 9) / 3, (k + 10) / 3, (k + 11) / 3, (k + 12) / 3,
                                       (k + 13) / 3, (k + 14) / 3, (k + 15) / 3);
  return {_mm512_permutexvar_ps(at, _mm512_loadu_ps(p))};
}
template <int C>
XRGS_INLINE Floats repeat_triple(const float* p) {
  constexpr int k = C % 3;  // as 16 C % 3
  const __m512i at =
      _mm512_setr_epi32(k, (k + 1) % 3, (k + 2) % 3, k, (k + 1) % 3, (k + 2) % 3, k, (k + 1) % 3,
                        (k + 2) % 3, k, (k + 1) % 3, (k + 2) % 3, k, (k + 1) % 3, (k + 2) % 3, k);
  return {_mm512_permutexvar_ps(at, _mm512_broadcast_f32x4(_mm_loadu_ps(p)))};
}
XRGS_INLINE Floats sum_rows(Floats a) {
  a = {_mm512_add_ps(a.v, _mm512_shuffle_f32x4(a.v, a.v, 0x4e))};
  return {_mm512_add_ps(a.v, _mm512_shuffle_f32x4(a.v, a.v, 0xb1))};
}

XRGS_INLINE float sum_lanes(Floats a) {
  const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(a.v), _mm512_extractf32x8_ps(a.v, 1));
  const __m128 quarter = _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  const __m128 pair = _mm_add_ps(quarter, _mm_movehl_ps(quarter, quarter));
  return _mm_cvtss_f32(_mm_add_ss(pair, _mm_movehdup_ps(pair)));
}

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

XRGS_INLINE void stream_fence() { _mm_sfence(); }

XRGS_INLINE void load_triples(const float* p, Floats& x, Floats& y, Floats& z) {
  const __m512 a = _mm512_loadu_ps(p), b = _mm512_loadu_ps(p + 16), c = _mm512_loadu_ps(p + 32);
  // The first permutation takes ten or eleven lanes from a and b, the second the rest from c.
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

}  // namespace XRGS_NS
}  // namespace xrgs
