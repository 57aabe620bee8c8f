// Resizes an image by multiplying it by a banded matrix along its rows and another along its
// columns.
#pragma once

#include <cstddef>

#include "isa.h"

namespace xrgs {

// A matrix [count, size] with `taps` adjacent non-zero weights in each row: output i is the sum
// over t of weights[i * taps + t] times input first[i] + t.
struct BandedMatrix {
  const int* first;      // [count]
  const float* weights;  // [count, taps]
  int count, taps;
};

struct ResampleKernels {
  // Resamples along the columns: writes rows first..last-1 of out [rows.count, columns], given
  // in [., columns].
  void (*down)(const BandedMatrix& rows, const float* in, std::size_t columns, int first, int last,
               float* out);
  // Resamples along the rows: writes `rows` (at most 16) rows of out [., columns.count, 3], given
  // the same number of rows of in [., width, 3].
  void (*across)(const BandedMatrix& columns, const float* in, int width, int rows, float* out,
                 float* scratch);
  // Returns the number of floats in the `scratch` of `across`, which must be 64-byte aligned.
  std::size_t (*scratch_size)(int width);
};

XRGS_DECLARE_TABLE(ResampleKernels, resample_kernels)

}  // namespace xrgs
