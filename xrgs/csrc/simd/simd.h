// Vectors of sixteen float lanes: the only vector type of the kernels.
//
// A kernel is written once, in terms of the operations below, and compiled once for each
// instruction set. An instruction set is a file that defines these operations. To add one, add such
// a file, a line in the #if after this list, and its compiler flags in CMakeLists.txt.
//
// The file of an instruction set must define
//
//   struct Floats, Ints, Mask           sixteen float32, sixteen int32, sixteen booleans
//   int kVectorRegisters                number of Floats that fit in the registers
//   bool kFusedMultiplyAdd              fma() rounds once
//
//   Floats broadcast(float)             the same number in every lane
//   Ints broadcast_int(int32)
//   Floats load(const float*)           sixteen floats, of any alignment
//   void store(float*, Floats)
//   void store(int32*, Ints)
//   Floats load_first(p, count)         the first `count` (0 to 16) lanes; the others are zero and
//                                       their memory is not read
//   void store_first(p, a, count)       the first `count` lanes; other memory is left alone
//   void stream(float*, Floats)         stores past the cache, for memory that is not read soon,
//                                       to an address that is a multiple of 64 bytes
//   void stream_fence()                 makes the stores of stream() visible to other threads
//
//   + - * /, sqrt, abs, floor, ceil     lane by lane, as IEEE 754 rounds
//   Floats fma(a, b, c)                 a b + c, rounded once if kFusedMultiplyAdd, else twice
//   Floats fnma(a, b, c)                c - a b, likewise
//   Floats min(a, b), max(a, b)         b where a or b is NaN
//   Floats min_positive(a, b)           min of positive numbers; of others unspecified
//   <, <=, ==                           comparisons that are false for NaN
//   Mask & Mask
//   uint32 to_bits(Mask)                lane i as bit i
//   Mask mask_from_bits(uint32)
//   Floats select(m, a, b)              a where the mask is set, else b
//   Floats select_or_zero(m, a)         a where the mask is set, else 0, even where a is not finite
//   Floats multiply_where(m, a, b)      select_or_zero(m, a * b)
//   Floats min_positive_where(m, a, b)  select_or_zero(m, min_positive(a, b))
//
//   Ints + Ints, Ints - Ints            modulo 2^32
//   Ints shift_left<Count>(Ints)
//   Ints shift_right<Count>(Ints)       arithmetic: copies of the sign bit move in
//   as_ints(Floats), as_floats(Ints)    the same bits as the other type
//   to_floats(Ints)                     the nearest float
//   to_ints(Floats)                     rounded towards zero; of numbers that fit no int32
//                                       unspecified
//
//   float sum_lanes(a)                  upper half plus lower half, and so on down to one lane
//   void interleave(a, b, low, high)    low = a0 b0 a1 b1 ... a7 b7, high = a8 b8 ... a15 b15
//   void deinterleave(low, high, a, b)  the inverse
//   void transpose(Floats (&rows)[16])  row i, lane j becomes row j, lane i
//   void load_triples(p, x, y, z)       sixteen (x, y, z) that are adjacent in memory
//   void store_triples(p, x, y, z)
//
// and, with the lanes read as a 4x4 matrix, row by row,
//
//   Floats broadcast_column<C>(a)       in each row its own value of column C, four times
//   Floats broadcast_row<R>(a)          row R, in all four rows
//   Floats sum_rows(a)                  (row 0 + row 2) + (row 1 + row 3), in all four rows
//
// Every instruction set rounds in the same way and adds in the same order, and the compiler does
// not fuse operations (-ffp-contract=off). So all instruction sets with a fused multiply-add
// (kFusedMultiplyAdd) give the same bits.
//
// Kernel files must not call inline functions of the standard library unless they are certain to be
// inlined: the linker keeps one copy of such a function for the whole module, which may use
// instructions that the processor lacks.
#pragma once

namespace xrgs {
namespace XRGS_NS {

constexpr int kLanes = 16;

#define XRGS_INLINE inline __attribute__((always_inline))

}  // namespace XRGS_NS
}  // namespace xrgs

#if defined(__AVX512F__)
#include "simd/avx512.h"
#elif defined(__AVX2__)
#include "simd/avx2.h"
#else
#include "simd/vector16.h"
#endif

// The functions below use the operations above, and are the same for every instruction set.
namespace xrgs {
namespace XRGS_NS {

XRGS_INLINE Floats operator-(Floats a) { return broadcast(0.0f) - a; }
XRGS_INLINE Floats& operator+=(Floats& a, Floats b) { return a = a + b; }
XRGS_INLINE Floats clamp(Floats a, Floats low, Floats high) { return min(max(a, low), high); }
XRGS_INLINE bool any(Mask m) { return to_bits(m) != 0; }

// Sixteen (w, x, y, z) that are adjacent in memory.
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

// 2^x with a relative error below 1.1e-7 for -126 <= x <= 127, and exactly 1 at 0; for other x
// unspecified.
//
// 2^x = 2^n 2^f, with n the integer nearest to x: 2^f is a polynomial of degree 6 whose constant is
// 1, and n is added to its exponent. The polynomial's relative error is 2.0e-9; the rest is
// rounding. Each step is computed for all `Count` vectors before the next step, to hide latency.
template <int Count>
XRGS_INLINE void exp2(const Floats (&x)[Count], Floats (&result)[Count]) {
  constexpr float kCoefficients[] = {0.00015353362f, 0.0013398874f, 0.0096184374f, 0.0555033247f,
                                     0.2402264791f,  0.6931472029f, 1.0f};
  const Floats magic = broadcast(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
  Floats t[Count], f[Count], p[Count];
  for (int i = 0; i < Count; ++i) {
    t[i] = x[i] + magic;
    f[i] = x[i] - (t[i] - magic);  // -1/2 to 1/2
    p[i] = broadcast(kCoefficients[0]);
  }
  for (int k = 1; k < 7; ++k)
    for (int i = 0; i < Count; ++i) p[i] = fma(f[i], p[i], broadcast(kCoefficients[k]));
  for (int i = 0; i < Count; ++i)
    result[i] = as_floats(as_ints(p[i]) + shift_left<23>(as_ints(t[i])));
}
XRGS_INLINE Floats exp2(Floats x) {
  const Floats in[1] = {x};
  Floats out[1];
  exp2(in, out);
  return out[0];
}

// e^x with a relative error below 1.0e-7, and exactly 1 at 0: 0 if e^x is below 2^-126, infinite if
// it is above the largest float, NaN for NaN. No intermediate value is denormal, so the result does
// not depend on whether the processor flushes denormal numbers to 0.
//
// e^x = 2^n e^r, with n the integer nearest to x / ln 2 and r = x - n ln 2. ln 2 is subtracted in
// two parts, the first of which has so few bits that its product with n is exact. e^r is a
// polynomial of degree 6 whose first two coefficients are 1. Its relative error is 3.1e-9; the rest
// is rounding.
XRGS_INLINE Floats exp(Floats x) {
  const Floats magic = broadcast(12582912.0f);  // as in exp2
  const Floats t = fma(x, broadcast(1.44269504f), magic);
  const Floats n = t - magic;
  const Floats r = fnma(n, broadcast(-2.12194440e-4f), fnma(n, broadcast(0.693359375f), x));
  Floats p = fma(r, broadcast(0.0013814539f), broadcast(0.008368745f));
  p = fma(r, p, broadcast(0.04166839f));
  p = fma(r, p, broadcast(0.16666521f));
  p = fma(r, p, broadcast(0.49999994f));
  p = fma(r, p, broadcast(1.0f));
  p = fma(r, p, broadcast(1.0f));
  const Floats y = as_floats(as_ints(p) + shift_left<23>(as_ints(t)));
  // Outside these bounds, the first and last floats with a normal result, n overflows the exponent.
  const Floats small = select(x < broadcast(-87.336540f), broadcast(0.0f), y);
  const Floats all = select(broadcast(88.722831f) < x, broadcast(__builtin_inff()), small);
  return select(x == x, all, x);
}

// 1 / (1 + e^-x): 0 if it is below 2^-126, NaN for NaN.
//
// It is computed as e^-|x| / (1 + e^-|x|) for negative x, else as 1 / (1 + e^-|x|). No intermediate
// value overflows or is denormal, so the result does not depend on whether the processor flushes
// denormal numbers to 0.
XRGS_INLINE Floats logistic(Floats x) {
  const Floats one = broadcast(1.0f);
  const Floats e = exp(-abs(x));
  return select(x < broadcast(0.0f), e, one) / (one + e);
}

// The derivatives of exp and logistic, in terms of their value y, times `gradient`.
XRGS_INLINE Floats exp_gradient(Floats gradient, Floats y) { return gradient * y; }
XRGS_INLINE Floats logistic_gradient(Floats gradient, Floats y) {
  return gradient * (y * (broadcast(1.0f) - y));
}

// For a >= 0: at least sqrt(max(a, 1e-20)), and at most 0.2% more.
//
// The approximate inverse square roots of instruction sets differ, so this one starts from the bits
// of a, with an error of at most 3.5%. After one step of Newton's method it is at most 0.18% below
// the inverse root, and never above; the last factor compensates for this.
XRGS_INLINE Floats sqrt_upper_bound(Floats a) {
  a = max(a, broadcast(1e-20f));
  const Floats start = as_floats(broadcast_int(0x5f3759df) - shift_right<1>(as_ints(a)));
  const Floats a_start = a * start;
  return a_start * fnma(broadcast(0.5f * 1.0019f) * a_start, start, broadcast(1.5f * 1.0019f));
}

// The base-2 logarithm of finite x >= 2^-126, with a relative error below 2.1e-7 (2.4e-7 if fma()
// rounds twice), and exact at powers of two.
//
// log2(x) = n + log2(m), with m in [sqrt(1/2), sqrt(2)). With s = (m - 1) / (m + 1), |s| < 0.172,
// the series log2(m) = 2/ln 2 (s + s^3/3 + s^5/5 + ...) is cut after s^9. Its relative error is
// 1.6e-8, most of it from coefficients in float32; the rest of the error is rounding.
XRGS_INLINE Floats log2(Floats x) {
  // n is the exponent of x / sqrt(1/2), so that m lies on both sides of 1.
  const Ints n = shift_right<23>(as_ints(x) - broadcast_int(0x3f3504f3));
  const Floats m = as_floats(as_ints(x) - shift_left<23>(n));
  const Floats s = (m - broadcast(1.0f)) / (m + broadcast(1.0f));
  const Floats s2 = s * s;
  Floats p = fma(s2, broadcast(0.3205989f), broadcast(0.4121986f));
  p = fma(s2, p, broadcast(0.5770780f));
  p = fma(s2, p, broadcast(0.9617967f));
  p = fma(s2, p, broadcast(2.8853900818f));
  return fma(s, p, to_floats(n));
}

XRGS_INLINE void prefetch(const void* p) { __builtin_prefetch(p, 0, 3); }
XRGS_INLINE void prefetch_to_write(const void* p) { __builtin_prefetch(p, 1, 3); }

}  // namespace XRGS_NS
}  // namespace xrgs
