// Along the columns, a vector is sixteen adjacent floats of a row. Along the rows, a vector is the
// same float of sixteen rows, so that a weight multiplies whole vectors for any distance between
// taps.
#include "resample/resample.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kChannels = 3;
constexpr int kUnroll = 4;  // vectors of a row that are multiplied by one weight

template <int Count>
XRGS_INLINE void down_vectors(const float* weights, int taps, const float* in, std::size_t columns,
                              int lanes, float* out) {
  Floats sum[Count];
  for (Floats& s : sum) s = broadcast(0.0f);
  for (int tap = 0; tap < taps; ++tap) {
    const Floats weight = broadcast(weights[tap]);
    const float* row = in + tap * columns;
    for (int i = 0; i < Count; ++i) {
      const Floats value = lanes == kLanes ? load(row + i * kLanes) : load_first(row, lanes);
      sum[i] = fma(weight, value, sum[i]);
    }
  }
  for (int i = 0; i < Count; ++i)
    if (lanes == kLanes)
      store(out + i * kLanes, sum[i]);
    else
      store_first(out, sum[i], lanes);
}

void down(const BandedMatrix& rows, const float* in, std::size_t columns, int first, int last,
          float* out) {
  constexpr std::size_t unrolled = kUnroll * kLanes;
  for (int y = first; y < last; ++y) {
    const float* weights = rows.weights + static_cast<std::size_t>(y) * rows.taps;
    const float* from = in + rows.first[y] * columns;
    float* to = out + y * columns;
    std::size_t c = 0;
    for (; c + unrolled <= columns; c += unrolled)
      down_vectors<kUnroll>(weights, rows.taps, from + c, columns, kLanes, to + c);
    for (; c < columns; c += kLanes) {
      const int lanes = columns - c < kLanes ? static_cast<int>(columns - c) : kLanes;
      down_vectors<1>(weights, rows.taps, from + c, columns, lanes, to + c);
    }
  }
}

std::size_t scratch_size(int width) {
  const std::size_t floats = static_cast<std::size_t>(kChannels) * width;
  return (floats + kLanes - 1) / kLanes * kLanes * kLanes;
}

void across(const BandedMatrix& columns, const float* in, int width, int rows, float* out,
            float* transposed) {
  const int in_floats = kChannels * width, out_floats = kChannels * columns.count;
  for (int c = 0; c < in_floats; c += kLanes) {
    const int lanes = in_floats - c < kLanes ? in_floats - c : kLanes;
    Floats block[kLanes];
    for (int row = 0; row < kLanes; ++row) {
      const float* at = in + static_cast<std::size_t>(row) * in_floats + c;
      block[row] = row >= rows       ? broadcast(0.0f)
                   : lanes == kLanes ? load(at)
                                     : load_first(at, lanes);
    }
    transpose(block);
    for (int i = 0; i < kLanes; ++i) store(transposed + (c + i) * kLanes, block[i]);
  }
  // Sixteen output pixels are three vectors of each row.
  for (int x = 0; x < columns.count; x += kLanes) {
    Floats block[kChannels][kLanes];
    for (int i = 0; i < kLanes; ++i) {
      Floats sum[kChannels] = {broadcast(0.0f), broadcast(0.0f), broadcast(0.0f)};
      const int taps = x + i < columns.count ? columns.taps : 0;
      const float* weights = columns.weights + static_cast<std::size_t>(x + i) * columns.taps;
      const float* from =
          taps == 0 ? transposed : transposed + kChannels * kLanes * columns.first[x + i];
      for (int tap = 0; tap < taps; ++tap) {
        const Floats weight = broadcast(weights[tap]);
        for (int k = 0; k < kChannels; ++k)
          sum[k] = fma(weight, load(from + (kChannels * tap + k) * kLanes), sum[k]);
      }
      for (int k = 0; k < kChannels; ++k) {
        const int index = kChannels * i + k;
        block[index / kLanes][index % kLanes] = sum[k];
      }
    }
    for (int part = 0; part < kChannels; ++part) {
      const int c = kChannels * x + part * kLanes;
      if (c >= out_floats) break;
      const int lanes = out_floats - c < kLanes ? out_floats - c : kLanes;
      transpose(block[part]);
      for (int row = 0; row < rows; ++row)
        store_first(out + static_cast<std::size_t>(row) * out_floats + c, block[part][row], lanes);
    }
  }
}

}  // namespace

extern const ResampleKernels resample_kernels{down, across, scratch_size};

}  // namespace XRGS_NS
}  // namespace xrgs
