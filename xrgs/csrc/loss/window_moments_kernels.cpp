// A variance is a small difference of squares, so all sums are in double. Terms are added one by
// one, in the order of the taps, without fused multiply-add, so every instruction set gives the
// same bits. The compiler vectorises the loops over adjacent floats.
#include <cstddef>

#include "loss/window_moments.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kChannels = 3;
// Columns (floats) of a strip: its eleven rows and their sums stay in the first-level cache.
constexpr int kStrip = 512;
constexpr int kRowShrink = kChannels * kMapShrink;  // floats by which a row of moments is shorter

// Sums `count` adjacent columns, and their squares, down the image.
XRGS_INLINE void sum_down(const float* __restrict in, std::size_t row_size, const double* weights,
                          int count, double* __restrict mean, double* __restrict square) {
  for (int c = 0; c < count; ++c) {
    const double top = in[c];
    double sum = top * weights[0], sum_of_squares = top * top * weights[0];
#pragma GCC unroll 11
    for (int tap = 1; tap < kWindow; ++tap) {
      const double value = in[tap * row_size + c];
      sum += value * weights[tap];
      sum_of_squares += value * value * weights[tap];
    }
    mean[c] = sum;
    square[c] = sum_of_squares;
  }
}

// Sums the results of sum_down across the image, and stores `count` adjacent moments.
XRGS_INLINE void sum_across(const double* __restrict means, const double* __restrict squares,
                            const double* weights, int count, float* __restrict mean,
                            float* __restrict variance) {
  for (int c = 0; c < count; ++c) {
    double sum = means[c] * weights[0], sum_of_squares = squares[c] * weights[0];
#pragma GCC unroll 11
    for (int tap = 1; tap < kWindow; ++tap) {
      sum += means[c + kChannels * tap] * weights[tap];
      sum_of_squares += squares[c + kChannels * tap] * weights[tap];
    }
    const double difference = sum_of_squares - sum * sum;
    mean[c] = static_cast<float>(sum);
    variance[c] = static_cast<float>(difference < 0 ? 0 : difference);  // a NaN stays NaN
  }
}

void rows(const WindowMomentsJob& job, int first, int last) {
  const int columns = kChannels * job.width, map_columns = columns - kRowShrink;
  double weights[kWindow];  // a local copy, which no store through a pointer can change
  for (int tap = 0; tap < kWindow; ++tap) weights[tap] = job.window[tap];
  double means[kStrip + kRowShrink], squares[kStrip + kRowShrink];
  for (int c = 0; c < map_columns; c += kStrip) {
    const int count = map_columns - c < kStrip ? map_columns - c : kStrip;
    for (int y = first; y < last; ++y) {
      const std::size_t at = static_cast<std::size_t>(y) * map_columns + c;
      sum_down(job.image + static_cast<std::size_t>(y) * columns + c, columns, weights,
               count + kRowShrink, means, squares);
      sum_across(means, squares, weights, count, job.mean + at, job.variance + at);
    }
  }
}

}  // namespace

extern const WindowMomentsKernels window_moments_kernels{rows};

}  // namespace XRGS_NS
}  // namespace xrgs
