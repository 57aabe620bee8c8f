#include "isa.h"

#ifdef XRGS_X86
#include <cpuid.h>
#endif

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace xrgs {
namespace {

constexpr const char* kNames[] = {"portable", "avx2", "avx512"};

#ifdef XRGS_X86
// The instruction sets that the processor has, and whose registers the operating system saves. They
// are read from the processor, because __builtin_cpu_supports uses the compiler's runtime library,
// and in Zig's it always returns false.
struct Processor {
  bool avx2 = false;
  bool avx512 = false;
};

bool all(unsigned features, unsigned wanted) { return (features & wanted) == wanted; }

Processor read_processor() {
  unsigned eax = 0, ebx = 0, ecx = 0, edx = 0;
  constexpr unsigned kLeaf1 = bit_OSXSAVE | bit_AVX | bit_FMA | bit_POPCNT;
  if (__get_cpuid(1, &eax, &ebx, &ecx, &edx) == 0 || !all(ecx, kLeaf1)) return {};
  if (__get_cpuid_count(7, 0, &eax, &ebx, &ecx, &edx) == 0) return {};
  unsigned saved = 0, high = 0;
  asm("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
  constexpr unsigned kYmm = 0x6, kZmm = 0xe6;  // bits of XCR0: SSE and AVX; opmask and ZMM as well
  Processor processor;
  processor.avx2 = all(saved, kYmm) && all(ebx, bit_AVX2 | bit_BMI | bit_BMI2);
  processor.avx512 = processor.avx2 && all(saved, kZmm) &&
                     all(ebx, bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL);
  return processor;
}
#endif

bool supported(Isa isa) {
#ifdef XRGS_X86
  static const Processor processor = read_processor();
  if (isa == Isa::avx512) return processor.avx512;
  if (isa == Isa::avx2) return processor.avx2;
#endif
  return isa == Isa::portable;
}

Isa parse(const std::string& name) {
  for (Isa isa : {Isa::portable, Isa::avx2, Isa::avx512}) {
    if (name != isa_name(isa)) continue;
    if (!supported(isa))
      throw std::invalid_argument("XRGS_ISA is " + name + ", which this machine does not have");
    return isa;
  }
  throw std::invalid_argument("XRGS_ISA must be portable, avx2 or avx512, got " + name);
}

Isa initial() {
  if (const char* name = std::getenv("XRGS_ISA"); name != nullptr && *name != '\0')
    return parse(name);
  for (Isa isa : {Isa::avx512, Isa::avx2})
    if (supported(isa)) return isa;
  return Isa::portable;
}

std::atomic<Isa>& active() {
  static std::atomic<Isa> isa{initial()};
  return isa;
}

}  // namespace

Isa active_isa() { return active().load(std::memory_order_relaxed); }

void set_isa(const std::string& name) { active().store(parse(name)); }

const char* isa_name(Isa isa) { return kNames[static_cast<int>(isa)]; }

std::vector<std::string> available_isas() {
  std::vector<std::string> names;
  for (Isa isa : {Isa::portable, Isa::avx2, Isa::avx512})
    if (supported(isa)) names.emplace_back(isa_name(isa));
  return names;
}

}  // namespace xrgs
