// The floating-point state of all kernels: denormal numbers count as zero.
//
// Arithmetic on denormal numbers (below 1.2e-38) is tens of times slower on many processors, and a
// moment of Adam without gradient would remain at the smallest of them forever. A thread inherits
// the state of the thread that started it, so without a fixed state results would depend on the
// caller.
#pragma once

#include <cstdint>

#ifdef XRGS_X86
#include <xmmintrin.h>
#endif

namespace xrgs {

// While an object of this class exists, its thread rounds to nearest and treats denormal operands
// and results as zeros. The destructor restores the previous state. On processors other than x86-64
// and AArch64 it does nothing.
class FlushDenormals {
 public:
  FlushDenormals() noexcept : saved_(read()) { write(kFlushing); }
  ~FlushDenormals() { write(saved_); }
  FlushDenormals(const FlushDenormals&) = delete;
  FlushDenormals& operator=(const FlushDenormals&) = delete;

 private:
#if defined(XRGS_X86)
  using State = std::uint32_t;
  // MXCSR: flush-to-zero, all exceptions masked, denormals-are-zeros.
  static constexpr State kFlushing = 1u << 15 | 0x3fu << 7 | 1u << 6;
  static State read() noexcept { return _mm_getcsr(); }
  static void write(State state) noexcept { _mm_setcsr(state); }
#elif defined(__aarch64__)
  using State = std::uint64_t;
  static constexpr State kFlushing = 1u << 24;  // FPCR.FZ
  static State read() noexcept {
    State state;
    __asm__ volatile("mrs %0, fpcr" : "=r"(state));
    return state;
  }
  static void write(State state) noexcept { __asm__ volatile("msr fpcr, %0" : : "r"(state)); }
#else
  using State = int;
  static constexpr State kFlushing = 0;
  static State read() noexcept { return 0; }
  static void write(State) noexcept {}
#endif

  State saved_;
};

}  // namespace xrgs
