#include "isa.h"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace xrgs {
namespace {

constexpr const char* kNames[] = {"portable", "avx2", "avx512"};

bool supported(Isa isa) {
#ifdef XRGS_X86
  // The builtins also check that the operating system saves the wide registers.
  if (isa == Isa::avx512)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
           __builtin_cpu_supports("bmi2");
  if (isa == Isa::avx2)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
           __builtin_cpu_supports("bmi2");
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
