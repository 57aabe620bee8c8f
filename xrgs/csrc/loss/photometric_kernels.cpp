// The kernel reads the rows of an image as they are stored, with interleaved channels: a tap of the
// window is one row further down, or three floats further right.
//
// For each group of kGroup rows, the moments of the window (x, x^2 and x t, of the image x and the
// target t) are summed down the image first, for a chunk of columns at a time, and then across
// while the chunk is in the first-level cache. SSIM gives the derivatives A, B and C of the loss by
// the three moments, which go to a ring of rows. The gradient is the same window over A, B and C,
// transposed, taken from that ring:
//   dL/dx = window(A) + 2 x window(B) + t window(C) + l1_slope sign(x - t).
// Variances are differences of moments, so all values are measured from kMidpoint, the middle of
// the range: the squares are smaller, and fewer digits cancel.
#include <cstring>

#include "loss/photometric.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Rows that are summed together and share their loads: 12 sums with AVX-512, else 6.
constexpr int kGroup = kVectorRegisters >= 32 ? 4 : 2;
constexpr int kInputRows = kGroup + kMapShrink;  // rows that the windows of a group cover
constexpr int kRing = 16;                        // rows of A, B and C that are kept
static_assert(kRing >= kInputRows, "a group needs all its rows in the ring");
constexpr int kChannels = 3;
constexpr int kRowShrink = kChannels * kMapShrink;  // floats by which a row of the map is shorter
constexpr int kChunk = 192;  // columns (floats) that are summed down before they are summed across
constexpr int kMargin = 48;  // columns of the chunk to the left that its windows cover
constexpr int kPrefetchDistance = 256;  // floats
constexpr int kFields = 3;              // moments, or derivatives by them
constexpr float kMidpoint = 0.5f;
constexpr float kC1 = 0.0001f, kC2 = 0.0009f;  // (0.01)^2 and (0.03)^2, for a data range of 1

// The window along one axis, in all lanes.
struct WindowWeights {
  Floats of[kWindow / 2 + 1];
  explicit WindowWeights(const float* window) {
    for (int i = 0; i <= kWindow / 2; ++i) of[i] = broadcast(window[i]);
  }
  XRGS_INLINE Floats operator[](int tap) const {
    return of[tap < kWindow / 2 ? kWindow / 2 - tap : tap - kWindow / 2];
  }
};

// The sums of a chunk, after the last kMargin columns of the chunk to its left.
struct ColumnChunk {
  alignas(64) float rows[kGroup][kFields][kMargin + kChunk];

  void clear() { std::memset(rows, 0, sizeof rows); }
  void shift() {
    for (auto& row : rows)
      for (float* field : row)
        for (int i = 0; i < kMargin; i += kLanes) store(field + i, load(field + kChunk + i));
  }
};

int round_up(int floats) { return (floats + kLanes - 1) / kLanes * kLanes; }

// The floats of a row of the ring: an odd number of cache lines, so that rows do not share cache
// sets.
std::size_t ring_row_size(int width) {
  return static_cast<std::size_t>((round_up(kChannels * width) / kLanes | 1) * kLanes);
}

XRGS_INLINE Floats load_lanes(const float* p, int lanes) {
  return lanes == kLanes ? load(p) : load_first(p, lanes);
}

// Sums one vector of columns down the image, for each row of a group. read(input_row, value) loads
// the three fields of one input row.
template <class Read>
XRGS_INLINE void sum_down(const WindowWeights& w, ColumnChunk& chunk, int chunk_index,
                          Read&& read) {
  Floats sum[kGroup][kFields];
  for (auto& row : sum)
    for (Floats& field : row) field = broadcast(0.0f);
#pragma GCC unroll 16
  for (int input = 0; input < kInputRows; ++input) {
    Floats value[kFields];
    read(input, value);
#pragma GCC unroll 8
    for (int row = 0; row < kGroup; ++row) {
      const int tap = input - row;
      if (tap < 0 || tap >= kWindow) continue;
#pragma GCC unroll 3
      for (int f = 0; f < kFields; ++f) sum[row][f] = fma(w[tap], value[f], sum[row][f]);
    }
  }
  for (int row = 0; row < kGroup; ++row)
    for (int f = 0; f < kFields; ++f) store(&chunk.rows[row][f][chunk_index], sum[row][f]);
}

XRGS_INLINE Floats sum_across(const WindowWeights& w, const float* p) {
  Floats sum = broadcast(0.0f);
#pragma GCC unroll 11
  for (int tap = 0; tap < kWindow; ++tap) sum = fma(w[tap], load(p + kChannels * tap), sum);
  return sum;
}

class Band {
 public:
  Band(const PhotometricJob& job, int first, int last, float* scratch)
      : job_(job),
        weights_(job.window),
        first_(first),
        last_(last),
        columns_(kChannels * job.width),
        map_columns_(columns_ - kRowShrink),
        map_rows_(job.height - kMapShrink),
        row_size_(ring_row_size(job.width)),
        ring_(scratch),
        zeros_(scratch + kFields * kRing * row_size_) {
    std::memset(zeros_, 0, row_size_ * sizeof(float));
  }

  void compute() {
    // The gradient of the first rows needs the map's rows above, whose windows cover them.
    const int start =
        job_.gradient == nullptr || first_ < kMapShrink ? first_ : first_ - kMapShrink;
    for (int y = start; y < last_; y += kGroup) {
      if (y < map_rows_) map_group(y);
      for (int row = y; row < y + kGroup; ++row)
        if (row >= first_ && row < last_) absolute_row(row);
      if (job_.gradient != nullptr && y + kGroup > first_) gradient_group(y);
    }
  }

 private:
  // Calls down(column, lanes, chunk_index) for each vector of a group's `inputs` columns, and
  // across(column, lanes, chunk_index) for each of its `outputs` as soon as the sums that it reads
  // are in the chunk. Its taps start at `chunk_index`, which is `lead` columns to the left of its
  // own column.
  template <class Down, class Across>
  XRGS_INLINE void for_each_column(int inputs, int outputs, int lead, Down&& down,
                                   Across&& across) {
    chunk_.clear();
    int done = 0;
    for (int start = 0; done < outputs; start += kChunk) {
      chunk_.shift();
      const int end = start + kChunk < inputs ? start + kChunk : inputs;
      for (int c = start; c < end; c += kLanes)
        down(c, end - c < kLanes ? end - c : kLanes, kMargin + c - start);
      // Columns past the last input are zero.
      for (int c = end > start ? round_up(end) : start; c < start + kChunk; c += kLanes)
        for (auto& row : chunk_.rows)
          for (float* field : row) store(field + kMargin + c - start, broadcast(0.0f));
      // An output is ready when the last tap of its last lane is within the chunk.
      for (; done < outputs && done - lead + kRowShrink + kLanes <= start + kChunk; done += kLanes)
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
      Floats sum = broadcast(0.0f);
      for (int c = start; c < end; c += kLanes) {
        const int lanes = end - c < kLanes ? end - c : kLanes;
        sum += abs(load_lanes(x + c, lanes) - load_lanes(t + c, lanes));
      }
      total += static_cast<double>(sum_lanes(sum));
    }
    job_.l1_rows[y] = total;
  }

  void map_group(int y) {
    const float *x[kInputRows], *t[kInputRows];
    for (int i = 0; i < kInputRows; ++i) {
      const int row =
          y + i < job_.height ? y + i : job_.height - 1;  // rows past the last are not used
      x[i] = job_.image + static_cast<std::size_t>(row) * columns_;
      t[i] = job_.target + static_cast<std::size_t>(row) * columns_;
    }
    const int rows = map_rows_ - y < kGroup ? map_rows_ - y : kGroup;
    Floats sum[kGroup];
    for (Floats& s : sum) s = broadcast(0.0f);
    double total[kGroup] = {};
    int in_sum = 0;
    for_each_column(
        columns_, map_columns_, 0,
        [&](int c, int lanes, int chunk_index) {
          if (lanes == kLanes)
            sum_down(weights_, chunk_, chunk_index,
                     [&](int i, Floats* v) { moments(load(x[i] + c), load(t[i] + c), v); });
          else
            sum_down(weights_, chunk_, chunk_index, [&](int i, Floats* v) {
              moments(load_first(x[i] + c, lanes), load_first(t[i] + c, lanes), v);
            });
        },
        [&](int c, int lanes, int chunk_index) {
          for (int row = 0; row < rows; ++row)
            sum[row] += map_vector(y + row, row, c, lanes, chunk_index);
          if (++in_sum == kChunk / kLanes || c + kLanes >= map_columns_) {
            for (int row = 0; row < rows; ++row) {
              total[row] += static_cast<double>(sum_lanes(sum[row]));
              sum[row] = broadcast(0.0f);
            }
            in_sum = 0;
          }
        });
    for (int row = 0; row < rows; ++row)
      if (y + row >= first_ && y + row < last_) job_.ssim_rows[y + row] = total[row];
  }

  static XRGS_INLINE void moments(Floats x, Floats t, Floats* v) {
    v[0] = x - broadcast(kMidpoint);
    v[1] = v[0] * v[0];
    v[2] = v[0] * (t - broadcast(kMidpoint));
  }

  // Returns S of one vector, and stores its derivatives by the moments in the ring.
  XRGS_INLINE Floats map_vector(int y, int row, int c, int lanes, int chunk_index) {
    const std::size_t at = static_cast<std::size_t>(y) * map_columns_ + c;
    const Floats offset =
        sum_across(weights_, &chunk_.rows[row][0][chunk_index]);  // mean - kMidpoint
    const Floats square = sum_across(weights_, &chunk_.rows[row][1][chunk_index]);
    const Floats product = sum_across(weights_, &chunk_.rows[row][2][chunk_index]);
    const Floats m = offset + broadcast(kMidpoint);
    const Floats mt = load_lanes(job_.target_mean + at, lanes);
    const Floats offset_t = mt - broadcast(kMidpoint);
    const Floats vt = load_lanes(job_.target_variance + at, lanes);
    prefetch(job_.target_mean + at + kPrefetchDistance);
    prefetch(job_.target_variance + at + kPrefetchDistance);
    const Floats zero = broadcast(0.0f), one = broadcast(1.0f), two = broadcast(2.0f);
    const Floats raw = fnma(offset, offset, square);
    const Floats v = max(zero, raw);  // max(0, NaN) is NaN
    const Floats covariance = fnma(offset, offset_t, product);
    const Floats inv_l = one / (fma(m, m, mt * mt) + broadcast(kC1));
    const Floats inv_s = one / (v + vt + broadcast(kC2));
    const Floats luminance = fma(two * m, mt, broadcast(kC1)) * inv_l;
    const Floats structure = fma(two, covariance, broadcast(kC2)) * inv_s;
    const Floats s = luminance * structure;
    if (job_.gradient != nullptr) {
      const Floats slope = broadcast(job_.ssim_slope);
      const Floats by_product = slope * two * luminance * inv_s;
      // A variance that was clamped at 0 has no gradient; a NaN stays NaN.
      const Floats by_square = select(raw < zero, zero, -(slope * s * inv_s));
      const Floats explicit_part = slope * two * structure * inv_l * fnma(m, luminance, mt);
      const Floats by_mean = explicit_part - fma(two * offset, by_square, offset_t * by_product);
      store_first(ring(y, 0) + c, by_mean, lanes);
      store_first(ring(y, 1) + c, by_square, lanes);
      store_first(ring(y, 2) + c, by_product, lanes);
    }
    return lanes == kLanes ? s : select_or_zero(mask_from_bits((1u << lanes) - 1), s);
  }

  void gradient_group(int y) {
    const float* map[kInputRows][kFields];
    for (int i = 0; i < kInputRows; ++i)
      for (int f = 0; f < kFields; ++f) {
        const int row = y - kMapShrink + i;
        map[i][f] = row >= 0 && row < map_rows_ ? ring(row, f) : zeros_;
      }
    for_each_column(
        map_columns_, columns_, kRowShrink,
        [&](int c, int lanes, int chunk_index) {
          if (lanes == kLanes)
            sum_down(weights_, chunk_, chunk_index, [&](int i, Floats* v) {
              for (int f = 0; f < kFields; ++f) v[f] = load(map[i][f] + c);
            });
          else
            sum_down(weights_, chunk_, chunk_index, [&](int i, Floats* v) {
              for (int f = 0; f < kFields; ++f) v[f] = load_first(map[i][f] + c, lanes);
            });
        },
        [&](int c, int lanes, int chunk_index) {
          for (int row = 0; row < kGroup; ++row)
            if (y + row >= first_ && y + row < last_)
              gradient_vector(y + row, row, c, lanes, chunk_index);
        });
  }

  XRGS_INLINE void gradient_vector(int y, int row, int c, int lanes, int chunk_index) {
    const std::size_t at = static_cast<std::size_t>(y) * columns_ + c;
    const Floats a = sum_across(weights_, &chunk_.rows[row][0][chunk_index]);
    const Floats b = sum_across(weights_, &chunk_.rows[row][1][chunk_index]);
    const Floats p = sum_across(weights_, &chunk_.rows[row][2][chunk_index]);
    const Floats x = load_lanes(job_.image + at, lanes), t = load_lanes(job_.target + at, lanes);
    const Floats slope = broadcast(job_.l1_slope), two = broadcast(2.0f),
                 middle = broadcast(kMidpoint);
    const Floats sign = select_or_zero(t < x, slope) - select_or_zero(x < t, slope);
    store_first(job_.gradient + at, fma(t - middle, p, fma(two * (x - middle), b, a + sign)),
                lanes);
  }

  float* ring(int y, int field) { return ring_ + (field * kRing + (y & (kRing - 1))) * row_size_; }

  const PhotometricJob& job_;
  const WindowWeights weights_;
  const int first_, last_, columns_, map_columns_, map_rows_;
  const std::size_t row_size_;
  float* const ring_;
  float* const zeros_;
  ColumnChunk chunk_;
};

std::size_t scratch_size(int width) { return (kFields * kRing + 1) * ring_row_size(width); }

void band(const PhotometricJob& job, int first, int last, float* memory) {
  Band(job, first, last, memory).compute();
}

}  // namespace

extern const PhotometricKernels photometric_kernels{scratch_size, band};

}  // namespace XRGS_NS
}  // namespace xrgs
