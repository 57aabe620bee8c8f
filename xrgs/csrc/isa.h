// The choice of the instruction set at run time. Every kernel file is compiled once for each
// instruction set.
//
// A family of kernels is a struct of function pointers, with an instance in the namespace of each
// instruction set (`portable`, `avx2`, `avx512`). XRGS_DECLARE_TABLE declares these instances, and
// XRGS_SELECT is the instance of the instruction set in use.
#pragma once

#include <string>
#include <vector>

namespace xrgs {

enum class Isa { portable, avx2, avx512 };

// The instruction set in use: the one in the environment variable XRGS_ISA, else the widest of the
// processor. Throws std::invalid_argument if this machine does not have the one in XRGS_ISA.
Isa active_isa();

// Selects another instruction set for the whole process. Throws std::invalid_argument as above.
void set_isa(const std::string& name);

const char* isa_name(Isa isa);

// The instruction sets of this machine, narrowest first.
std::vector<std::string> available_isas();

#ifdef XRGS_X86
#define XRGS_SELECT(table)                                             \
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
#define XRGS_SELECT(table) (::xrgs::portable::table)
#define XRGS_DECLARE_TABLE(type, table) \
  namespace portable {                  \
  extern const type table;              \
  }
#endif

}  // namespace xrgs
