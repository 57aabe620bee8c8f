// The rows of an image are read as they lie, three interleaved channels: a tap of the window is one
// row further down, or three floats further right.
//
// Down the image: for each group of kGroup rows, the moments of the window (x, x^2, x y) are summed
// down first, a chunk of columns at a time, then across while the chunk is in the nearest cache;
// SSIM and its derivatives by the three moments (A, B, C) go to a ring of rows. The gradient is the
// same window over A, B and C, transposed, from that ring:
//   dL/dx = window(A) + 2 x window(B) + y window(C) + the sign of x - y.
// Variances are differences of moments, so all is measured from kMiddle, the middle of the range:
// smaller squares, and a few times fewer digits lost.
#include "loss/photometric.h"
#include "simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

#if defined(__AVX512F__)
constexpr int kGroup = 4;  // rows that share their loads: 12 sums in 32 registers
#else
constexpr int kGroup = 2;
#endif
constexpr int kInputs = kGroup + kReach;  // rows that a group of rows is made of
constexpr int kRing = 16;                 // rows of A, B and C kept
static_assert(kRing >= kInputs, "a group needs all its rows in the ring");
constexpr int kStep = 3;               // floats from one pixel to the next
constexpr int kSpan = kStep * kReach;  // floats that a map's row is shorter than an image's
constexpr int kChunk = 192;            // columns (floats) summed down before they go across
constexpr int kMargin = 48;            // of a chunk's left neighbour, that its window reaches
constexpr int kAhead = 256;            // floats: how far ahead new rows are fetched
constexpr int kFields = 3;
constexpr float kMiddle = 0.5f;
constexpr float kC1 = 0.0001f, kC2 = 0.0009f;  // (0.01)^2 and (0.03)^2, for a data range of 1

struct Weights {
  Floats of[kTaps / 2 + 1];
  explicit Weights(const float* taps) {
    for (int i = 0; i <= kTaps / 2; ++i) of[i] = splat(taps[i]);
  }
  XRGS_INLINE Floats operator[](int tap) const {
    return of[tap < kTaps / 2 ? kTaps / 2 - tap : tap - kTaps / 2];
  }
};

// The sums of a chunk, kMargin columns of its left neighbour before it.
struct Chunk {
  alignas(64) float rows[kGroup][kFields][kMargin + kChunk];

  void clear() { std::memset(rows, 0, sizeof rows); }
  void shift() {
    for (auto& row : rows)
      for (float* field : row)
        for (int i = 0; i < kMargin; i += kLanes) store(field + i, load(field + kChunk + i));
  }
};

int padded(int floats) { return (floats + kLanes - 1) / kLanes * kLanes; }

// Floats of a row of the ring: an odd number of cache lines, so that rows do not share cache sets.
std::size_t ring_row(int width) {
  return static_cast<std::size_t>((padded(kStep * width) / kLanes | 1) * kLanes);
}

XRGS_INLINE Floats load_lanes(const float* p, int lanes) {
  return lanes == kLanes ? load(p) : load_first(p, lanes);
}

// One vector of columns of a group: the window down, over what read(input, value) yields.
template <class Read>
XRGS_INLINE void sum_down(const Weights& w, Chunk& chunk, int place, Read&& read) {
  Floats sum[kGroup][kFields];
  for (auto& row : sum)
    for (Floats& field : row) field = splat(0.0f);
#pragma GCC unroll 16
  for (int input = 0; input < kInputs; ++input) {
    Floats value[kFields];
    read(input, value);
#pragma GCC unroll 8
    for (int row = 0; row < kGroup; ++row) {
      const int tap = input - row;
      if (tap < 0 || tap >= kTaps) continue;
#pragma GCC unroll 3
      for (int f = 0; f < kFields; ++f) sum[row][f] = fma(w[tap], value[f], sum[row][f]);
    }
  }
  for (int row = 0; row < kGroup; ++row)
    for (int f = 0; f < kFields; ++f) store(&chunk.rows[row][f][place], sum[row][f]);
}

XRGS_INLINE Floats sum_across(const Weights& w, const float* p) {
  Floats sum = splat(0.0f);
#pragma GCC unroll 11
  for (int tap = 0; tap < kTaps; ++tap) sum = fma(w[tap], load(p + kStep * tap), sum);
  return sum;
}

class Band {
 public:
  Band(const Photometric& job, int first, int last, float* scratch)
      : job_(job),
        weights_(job.taps),
        first_(first),
        last_(last),
        columns_(kStep * job.width),
        map_columns_(columns_ - kSpan),
        map_rows_(job.height - kReach),
        row_(ring_row(job.width)),
        ring_(scratch),
        zeros_(scratch + kFields * kRing * row_) {
    std::memset(zeros_, 0, row_ * sizeof(float));
  }

  void run() {
    // Of the rows above, those whose windows reach the first row.
    const int start = job_.gradient == nullptr || first_ < kReach ? first_ : first_ - kReach;
    for (int y = start; y < last_; y += kGroup) {
      if (y < map_rows_) map_group(y);
      for (int row = y; row < y + kGroup; ++row)
        if (row >= first_ && row < last_) absolute_row(row);
      if (job_.gradient != nullptr && y + kGroup > first_) gradient_group(y);
    }
  }

 private:
  // Calls down(column, lanes, place) for each vector of a group's `inputs` columns, and
  // across(column, lanes, place) for each of its `outputs` once the sums it reads are there: its
  // taps start at `place`, which is `lead` columns left of its own column.
  template <class Down, class Across>
  XRGS_INLINE void sweep(int inputs, int outputs, int lead, Down&& down, Across&& across) {
    chunk_.clear();
    int done = 0;
    for (int start = 0; done < outputs; start += kChunk) {
      chunk_.shift();
      const int end = start + kChunk < inputs ? start + kChunk : inputs;
      for (int c = start; c < end; c += kLanes)
        down(c, end - c < kLanes ? end - c : kLanes, kMargin + c - start);
      // Columns past the inputs count as zero.
      for (int c = end > start ? padded(end) : start; c < start + kChunk; c += kLanes)
        for (auto& row : chunk_.rows)
          for (float* field : row) store(field + kMargin + c - start, splat(0.0f));
      // The last tap of the last lane must be within the chunk.
      for (; done < outputs && done - lead + kSpan + kLanes <= start + kChunk; done += kLanes)
        across(done, outputs - done < kLanes ? outputs - done : kLanes,
               kMargin + done - lead - start);
    }
  }

  void absolute_row(int y) {
    const float* x = job_.image + static_cast<std::size_t>(y) * columns_;
    const float* t = job_.target + static_cast<std::size_t>(y) * columns_;
    double total = 0;
    for (int start = 0; start < columns_; start += kChunk) {
      const int end = start + kChunk < columns_ ? start + kChunk : columns_;
      Floats sum = splat(0.0f);
      for (int c = start; c < end; c += kLanes) {
        const int lanes = end - c < kLanes ? end - c : kLanes;
        sum += abs(load_lanes(x + c, lanes) - load_lanes(t + c, lanes));
      }
      total += static_cast<double>(xrgs::XRGS_NS::sum(sum));
    }
    job_.l1_rows[y] = total;
  }

  void map_group(int y) {
    const float *x[kInputs], *t[kInputs];
    for (int i = 0; i < kInputs; ++i) {
      const int row = y + i < job_.height ? y + i : job_.height - 1;  // past the last: not used
      x[i] = job_.image + static_cast<std::size_t>(row) * columns_;
      t[i] = job_.target + static_cast<std::size_t>(row) * columns_;
    }
    const int rows = map_rows_ - y < kGroup ? map_rows_ - y : kGroup;
    Floats sum[kGroup];
    for (Floats& s : sum) s = splat(0.0f);
    double total[kGroup] = {};
    int in_sum = 0;
    sweep(
        columns_, map_columns_, 0,
        [&](int c, int lanes, int place) {
          if (lanes == kLanes)
            sum_down(weights_, chunk_, place,
                     [&](int i, Floats* v) { moments(load(x[i] + c), load(t[i] + c), v); });
          else
            sum_down(weights_, chunk_, place, [&](int i, Floats* v) {
              moments(load_first(x[i] + c, lanes), load_first(t[i] + c, lanes), v);
            });
        },
        [&](int c, int lanes, int place) {
          for (int row = 0; row < rows; ++row)
            sum[row] += map_vector(y + row, row, c, lanes, place);
          if (++in_sum == kChunk / kLanes || c + kLanes >= map_columns_) {
            for (int row = 0; row < rows; ++row) {
              total[row] += static_cast<double>(xrgs::XRGS_NS::sum(sum[row]));
              sum[row] = splat(0.0f);
            }
            in_sum = 0;
          }
        });
    for (int row = 0; row < rows; ++row)
      if (y + row >= first_ && y + row < last_) job_.ssim_rows[y + row] = total[row];
  }

  static XRGS_INLINE void moments(Floats x, Floats t, Floats* v) {
    v[0] = x - splat(kMiddle);
    v[1] = v[0] * v[0];
    v[2] = v[0] * (t - splat(kMiddle));
  }

  // S of one vector, and its derivatives by the moments into the ring.
  XRGS_INLINE Floats map_vector(int y, int row, int c, int lanes, int place) {
    const std::size_t at = static_cast<std::size_t>(y) * map_columns_ + c;
    const Floats offset = sum_across(weights_, &chunk_.rows[row][0][place]);  // mean - kMiddle
    const Floats square = sum_across(weights_, &chunk_.rows[row][1][place]);
    const Floats product = sum_across(weights_, &chunk_.rows[row][2][place]);
    const Floats m = offset + splat(kMiddle);
    const Floats mt = load_lanes(job_.mean + at, lanes);
    const Floats offset_t = mt - splat(kMiddle);
    const Floats vt = load_lanes(job_.variance + at, lanes);
    prefetch(job_.mean + at + kAhead);
    prefetch(job_.variance + at + kAhead);
    const Floats zero = splat(0.0f), one = splat(1.0f), two = splat(2.0f);
    const Floats raw = fnma(offset, offset, square);
    const Floats v = max(zero, raw);  // of a NaN the NaN
    const Floats covariance = fnma(offset, offset_t, product);
    const Floats inv_l = one / (fma(m, m, mt * mt) + splat(kC1));
    const Floats inv_s = one / (v + vt + splat(kC2));
    const Floats luminance = fma(two * m, mt, splat(kC1)) * inv_l;
    const Floats structure = fma(two, covariance, splat(kC2)) * inv_s;
    const Floats s = luminance * structure;
    if (job_.gradient != nullptr) {
      const Floats slope = splat(job_.ssim_slope);
      const Floats by_product = slope * two * luminance * inv_s;
      // Where the variance was clamped it does not move; of a NaN, NaN.
      const Floats by_square = select(raw < zero, zero, -(slope * s * inv_s));
      const Floats explicit_part = slope * two * structure * inv_l * fnma(m, luminance, mt);
      const Floats by_mean = explicit_part - fma(two * offset, by_square, offset_t * by_product);
      store_first(ring(y, 0) + c, by_mean, lanes);
      store_first(ring(y, 1) + c, by_square, lanes);
      store_first(ring(y, 2) + c, by_product, lanes);
    }
    return lanes == kLanes ? s : keep(mask_of((1u << lanes) - 1), s);
  }

  void gradient_group(int y) {
    const float* map[kInputs][kFields];
    for (int i = 0; i < kInputs; ++i)
      for (int f = 0; f < kFields; ++f) {
        const int row = y - kReach + i;
        map[i][f] = row >= 0 && row < map_rows_ ? ring(row, f) : zeros_;
      }
    sweep(
        map_columns_, columns_, kSpan,
        [&](int c, int lanes, int place) {
          if (lanes == kLanes)
            sum_down(weights_, chunk_, place, [&](int i, Floats* v) {
              for (int f = 0; f < kFields; ++f) v[f] = load(map[i][f] + c);
            });
          else
            sum_down(weights_, chunk_, place, [&](int i, Floats* v) {
              for (int f = 0; f < kFields; ++f) v[f] = load_first(map[i][f] + c, lanes);
            });
        },
        [&](int c, int lanes, int place) {
          for (int row = 0; row < kGroup; ++row)
            if (y + row >= first_ && y + row < last_)
              gradient_vector(y + row, row, c, lanes, place);
        });
  }

  XRGS_INLINE void gradient_vector(int y, int row, int c, int lanes, int place) {
    const std::size_t at = static_cast<std::size_t>(y) * columns_ + c;
    const Floats a = sum_across(weights_, &chunk_.rows[row][0][place]);
    const Floats b = sum_across(weights_, &chunk_.rows[row][1][place]);
    const Floats p = sum_across(weights_, &chunk_.rows[row][2][place]);
    const Floats x = load_lanes(job_.image + at, lanes), t = load_lanes(job_.target + at, lanes);
    const Floats slope = splat(job_.l1_slope), two = splat(2.0f), middle = splat(kMiddle);
    const Floats sign = keep(t < x, slope) - keep(x < t, slope);
    store_first(job_.gradient + at, fma(t - middle, p, fma(two * (x - middle), b, a + sign)),
                lanes);
  }

  float* ring(int y, int field) { return ring_ + (field * kRing + (y & (kRing - 1))) * row_; }

  const Photometric& job_;
  const Weights weights_;
  const int first_, last_, columns_, map_columns_, map_rows_;
  const std::size_t row_;
  float* const ring_;
  float* const zeros_;
  Chunk chunk_;
};

std::size_t scratch(int width) { return (kFields * kRing + 1) * ring_row(width); }

void band(const Photometric& job, int first, int last, float* memory) {
  Band(job, first, last, memory).run();
}

}  // namespace

extern const PhotometricKernels photometric_kernels{scratch, band};

}  // namespace XRGS_NS
}  // namespace xrgs
