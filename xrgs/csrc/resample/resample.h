// An image by a banded matrix down its rows and another across its columns: resizing, either way.
#pragma once

#include <cstddef>

#include "isa.h"

namespace xrgs {

// One matrix [count, old]: output i is the sum over t of weights[i * taps + t] times input
// first[i] + t.
struct Bands {
  const int* first;      // [count]
  const float* weights;  // [count, taps]
  int count, taps;
};

struct ResampleKernels {
  // Rows first..last-1 of out [rows.count, columns], from in [., columns].
  void (*down)(const Bands& rows, const float* in, std::size_t columns, int first, int last,
               float* out);
  // At most 16 rows of out [., columns.count, 3] from as many of in [., width, 3].
  void (*across)(const Bands& columns, const float* in, int width, int rows, float* out,
                 float* scratch);
  // Floats of scratch that one call of `across` needs, on a 64-byte boundary.
  std::size_t (*scratch)(int width);
};

XRGS_DECLARE_TABLE(ResampleKernels, resample_kernels)

}  // namespace xrgs
