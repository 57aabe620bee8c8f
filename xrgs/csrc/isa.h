// Which copy of the kernels runs: every kernel file is compiled once for each instruction set.
//
// A family of kernels is a struct of function pointers, filled once in each copy's namespace
// (`portable`, `avx2`, `avx512`); `pick` gives the copy for the machine at hand.
#pragma once

#include <string>
#include <vector>

namespace xrgs {

enum class Isa { portable, avx2, avx512 };

// The instruction set in use: the widest that the processor has, or the one that the environment
// variable XRGS_ISA names. Throws std::invalid_argument where that one is unknown or missing here.
Isa active_isa();

// Use another one from now on, in this process. Throws std::invalid_argument as above.
void set_isa(const std::string& name);

const char* isa_name(Isa isa);

// All that this machine can run, narrowest first.
std::vector<std::string> available_isas();

#ifdef XRGS_X86
#define XRGS_PICK(table)                                               \
  (::xrgs::active_isa() == ::xrgs::Isa::avx512 ? ::xrgs::avx512::table \
   : ::xrgs::active_isa() == ::xrgs::Isa::avx2 ? ::xrgs::avx2::table   \
                                               : ::xrgs::portable::table)
#define XRGS_DECLARE_TABLE(type, table) \
  namespace portable {                  \
  extern const type table;              \
  }                                     \
  namespace avx2 {                      \
  extern const type table;              \
  }                                     \
  namespace avx512 {                    \
  extern const type table;              \
  }
#else
#define XRGS_PICK(table) (::xrgs::portable::table)
#define XRGS_DECLARE_TABLE(type, table) \
  namespace portable {                  \
  extern const type table;              \
  }
#endif

}  // namespace xrgs
