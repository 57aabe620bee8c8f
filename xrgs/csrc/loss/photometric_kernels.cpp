// The kernel reads the rows of an image with interleaved channels: the next tap of the window is
// one row below, or three floats to the right.
//
// SSIM compares an image x with its target t in a window, whose weighted mean is E. Near
// convergence x and t are almost equal, and the usual form of 1 - SSIM, with moments of x, loses
// all digits. So the moments of the difference d = x - t are used, and 1 - SSIM is a sum of small
// terms, without differences of large numbers:
//   p = E[d], q = E[d^2], r = E[t d];
//   var_d = max(0, q - p^2),             cov = r - mean_t p, the covariance of t and d,
//   mean_x = mean_t + p,                 var_x = max(0, var_t + 2 cov + var_d),
//   D = var_x + var_t + C2,              a = 1 - structure = var_d / D,
//   N = 2 mean_x mean_t + C1,            l = luminance = N / M,
//   M = mean_x^2 + mean_t^2 + C1 = p^2 + N,
//   1 - SSIM = 1 - (1 - a) l = a l + p^2 / M.
// D is the usual denominator, since var_t + cov is the covariance of t and x. Rounding can make the
// variances of flat images negative, hence the two maxima. The derivatives with respect to q, r and
// p are stored as these factors:
//   u = 2 (1 - a) l / D  = 2 by_q,
//   v = 2 a l / D        = -by_r,
//   by_p = 2 (1 - a) p (mean_t^2 + mean_t mean_x + C1) / M^2 - p u + mean_t v.
// The fraction is the derivative of p^2 / M, 2 p / M - 2 p^2 mean_x / M^2, without its
// cancellation: M - p mean_x = mean_t^2 + mean_t mean_x + C1. A variance that a maximum clamps has
// no derivative: if var_d is clamped, u is zero; if var_x is, v is zero and u is 2 l / D.
//
// For each group of kGroup rows, the moments are first summed down the image, for a chunk of
// columns at a time, and then across, while the chunk is in the first-level cache. by_p, u and v
// are stored in a ring of rows. The gradient is the transposed window applied to the ring:
//   dL/dx = ssim_slope (window(by_p) + d window(u) - t window(v)) + l1_slope sign(d).
// With pixel weights, by_p, u and v are multiplied by the weight of the window's central pixel, and
// l1_slope by that of the pixel.
#include <cstring>

#include "loss/photometric.h"
#include "simd/simd.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

// Rows that are summed together to share loads: 12 sums with AVX-512, else 6.
constexpr int kGroup = kVectorRegisters >= 32 ? 4 : 2;
constexpr int kInputRows = kGroup + kMapShrink;  // rows that the windows of a group cover
constexpr int kRing = 16;                        // rows of the derivatives that are kept
static_assert(kRing >= kInputRows, "a group needs all its rows in the ring");
constexpr int kChannels = 3;
constexpr int kRowShrink = kChannels * kMapShrink;  // floats by which a row of the map is shorter
constexpr int kChunk = 192;  // columns (floats) that are summed down before they are summed across
constexpr int kMargin = 48;  // columns of the chunk to the left that its windows cover
constexpr int kPrefetchDistance = 256;         // floats
constexpr int kFields = 3;                     // moments, or derivatives by them
constexpr float kC1 = 0.0001f, kC2 = 0.0009f;  // (0.01)^2 and (0.03)^2, for a data range of 1

// The window's weights along one axis, in all lanes. Loops use a local copy: for one in memory, the
// compiler would have to reload the weights after every store through a pointer.
struct WindowWeights {
  Floats of[kWindow / 2 + 1];
  explicit WindowWeights(const float* window) {
    for (int i = 0; i <= kWindow / 2; ++i) of[i] = broadcast(window[i]);
  }
  XRGS_INLINE Floats operator[](int tap) const {
    return of[tap < kWindow / 2 ? kWindow / 2 - tap : tap - kWindow / 2];
  }
};

// The sums of a chunk, preceded by the last kMargin columns of the chunk to its left.
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

// Number of floats in a row of the ring: an odd number of cache lines, so that rows do not share
// cache sets.
std::size_t ring_row_size(int width) {
  return static_cast<std::size_t>((round_up(kChannels * width) / kLanes | 1) * kLanes);
}

// Number of floats in a row of pixel weights, which are repeated for each channel.
int weight_row_size(int width) { return kChannels * round_up(width); }

XRGS_INLINE Floats load_lanes(const float* p, int lanes) {
  return lanes == kLanes ? load(p) : load_first(p, lanes);
}
XRGS_INLINE void store_lanes(float* p, Floats a, int lanes) {
  if (lanes == kLanes)
    store(p, a);
  else
    store_first(p, a, lanes);
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

// The sums of the rows of a group: in float over the width of a chunk, and over chunks in double.
struct RowSums {
  Floats part[kGroup];
  double total[kGroup] = {};
  int vectors = 0;

  RowSums() { clear(); }
  void clear() {
    for (Floats& sum : part) sum = broadcast(0.0f);
    vectors = 0;
  }
  // Call after adding a vector to `part`. At the end of a chunk's width, `part` goes to `total`.
  XRGS_INLINE void next(bool last) {
    if (++vectors < kChunk / kLanes && !last) return;
    for (int row = 0; row < kGroup; ++row) total[row] += static_cast<double>(sum_lanes(part[row]));
    clear();
  }
};

template <bool kWeighted>
class Band {
 public:
  Band(const PhotometricJob& job, int first, int last, float* scratch)
      : job_(job),
        first_(first),
        last_(last),
        columns_(kChannels * job.width),
        map_columns_(columns_ - kRowShrink),
        map_rows_(job.height - kMapShrink),
        row_size_(ring_row_size(job.width)),
        ring_(scratch),
        zeros_(ring_ + kFields * kRing * row_size_),
        weight_rows_(zeros_ + row_size_) {
    std::memset(zeros_, 0, row_size_ * sizeof(float));
  }

  void compute() {
    // The gradient of the first rows also needs the rows of the map above, whose windows cover
    // them.
    const int start =
        job_.gradient == nullptr || first_ < kMapShrink ? first_ : first_ - kMapShrink;
    for (int y = start; y < last_; y += kGroup) {
      if (y < map_rows_) map_group(y);
      if (job_.gradient == nullptr)
        absolute_group(y);
      else if (y + kGroup > first_)
        gradient_group(y);
    }
  }

 private:
  // Calls down(column, lanes, chunk_index) for each vector of a group's `inputs` columns, and
  // across(column, lanes, chunk_index) for each vector of its `outputs` columns, as soon as the
  // chunk has the sums for it. The taps of an output start at `chunk_index`, `lead` columns to the
  // left of its column. Both are inlined twice, so that calls with kLanes lanes, nearly all of
  // them, need no masks.
  template <class Down, class Across>
  XRGS_INLINE void for_each_column(int inputs, int outputs, int lead, Down&& down,
                                   Across&& across) {
    chunk_.clear();
    int done = 0;
    for (int start = 0; done < outputs; start += kChunk) {
      chunk_.shift();
      const int end = start + kChunk < inputs ? start + kChunk : inputs;
      for (int c = start; c < end; c += kLanes)
        if (end - c >= kLanes)
          down(c, kLanes, kMargin + c - start);
        else
          down(c, end - c, kMargin + c - start);
      // Columns past the last input are zero.
      for (int c = end > start ? round_up(end) : start; c < start + kChunk; c += kLanes)
        for (auto& row : chunk_.rows)
          for (float* field : row) store(field + kMargin + c - start, broadcast(0.0f));
      // An output is ready when the last tap of its last lane is within the chunk.
      for (; done < outputs && done - lead + kRowShrink + kLanes <= start + kChunk; done += kLanes)
        if (outputs - done >= kLanes)
          across(done, kLanes, kMargin + done - lead - start);
        else
          across(done, outputs - done, kMargin + done - lead - start);
    }
  }

  // Writes the weights of a group of pixel rows, from row y on, to `rows`, once for each channel.
  void expand_weights(int y, float* rows) {
    const int size = weight_row_size(job_.width);
    for (int row = 0; row < kGroup && y + row < job_.height; ++row)
      for (int x = 0; x < job_.width; x += kLanes) {
        const float* from = job_.pixel_weight + static_cast<std::size_t>(y + row) * job_.width + x;
        const Floats w = load_lanes(from, job_.width - x < kLanes ? job_.width - x : kLanes);
        store_triples(rows + row * size + kChannels * x, w, w, w);
      }
  }

  bool is_own_row(int y) const { return y >= first_ && y < last_; }

  void store_totals(const RowSums& sums, int y, int rows, double* totals) const {
    for (int row = 0; row < rows; ++row)
      if (is_own_row(y + row)) totals[y + row] = sums.total[row];
  }

  // Sums the absolute differences of a group's rows, in the same order as gradient_group.
  void absolute_group(int y) {
    if (kWeighted) expand_weights(y, weight_rows_);
    RowSums sums;
    for (int c = 0; c < columns_; c += kLanes) {
      const int lanes = columns_ - c < kLanes ? columns_ - c : kLanes;
      for (int row = 0; row < kGroup; ++row) {
        if (!is_own_row(y + row)) continue;
        const std::size_t at = static_cast<std::size_t>(y + row) * columns_ + c;
        const Floats d = load_lanes(job_.image + at, lanes) - load_lanes(job_.target + at, lanes);
        sums.part[row] += kWeighted ? load_lanes(pixel_weights(row) + c, lanes) * abs(d) : abs(d);
      }
      sums.next(c + kLanes >= columns_);
    }
    store_totals(sums, y, kGroup, job_.l1_rows);
  }

  void map_group(int y) {
    if (kWeighted) expand_weights(y + kMapShrink / 2, pixel_weights(kGroup));
    const float *x[kInputRows], *t[kInputRows];
    for (int i = 0; i < kInputRows; ++i) {
      const int row =
          y + i < job_.height ? y + i : job_.height - 1;  // rows past the last are not used
      x[i] = job_.image + static_cast<std::size_t>(row) * columns_;
      t[i] = job_.target + static_cast<std::size_t>(row) * columns_;
    }
    const int rows = map_rows_ - y < kGroup ? map_rows_ - y : kGroup;
    const WindowWeights w(job_.window);
    RowSums sums;
    for_each_column(
        columns_, map_columns_, 0,
        [&](int c, int lanes, int chunk_index) __attribute__((always_inline)) {
          sum_down(w, chunk_, chunk_index, [&](int i, Floats* v) {
            moments(load_lanes(x[i] + c, lanes), load_lanes(t[i] + c, lanes), v);
          });
        },
        [&](int c, int lanes, int chunk_index) __attribute__((always_inline)) {
          for (int row = 0; row < rows; ++row)
            sums.part[row] += map_vector(w, y + row, row, c, lanes, chunk_index);
          sums.next(c + kLanes >= map_columns_);
        });
    store_totals(sums, y, rows, job_.ssim_rows);
  }

  static XRGS_INLINE void moments(Floats x, Floats t, Floats* v) {
    const Floats d = x - t;
    v[0] = d;
    v[1] = d * d;
    v[2] = t * d;
  }

  // Returns 1 - SSIM of one vector, times its weight, and stores by_p, u and v in the ring.
  XRGS_INLINE Floats map_vector(const WindowWeights& w, int y, int row, int c, int lanes,
                                int chunk_index) {
    const std::size_t at = static_cast<std::size_t>(y) * map_columns_ + c;
    const Floats p = sum_across(w, &chunk_.rows[row][0][chunk_index]);
    const Floats q = sum_across(w, &chunk_.rows[row][1][chunk_index]);
    const Floats r = sum_across(w, &chunk_.rows[row][2][chunk_index]);
    const Floats mean_t = load_lanes(job_.target_mean + at, lanes);
    const Floats var_t = load_lanes(job_.target_variance + at, lanes);
    prefetch(job_.target_mean + at + kPrefetchDistance);
    prefetch(job_.target_variance + at + kPrefetchDistance);
    const Floats zero = broadcast(0.0f), one = broadcast(1.0f), two = broadcast(2.0f);
    const Floats c1 = broadcast(kC1), c2 = broadcast(kC2);
    const Floats mean_x = mean_t + p;
    const Floats raw_d = fnma(p, p, q);
    const Floats var_d = max(zero, raw_d);  // max(0, NaN) is NaN
    const Floats raw_x = fma(two, fnma(mean_t, p, r), var_t + var_d);
    const Floats inv_d = one / (max(zero, raw_x) + (var_t + c2));
    const Floats means = mean_t * mean_x;
    const Floats n = fma(two, means, c1);
    const Floats inv_m = one / fma(p, p, n);
    const Floats a = var_d * inv_d, luminance = n * inv_m, p_by_m = p * inv_m;
    Floats lacking = fma(a, luminance, p * p_by_m);
    Floats weight = one;
    if (kWeighted) {
      weight = load_lanes(centre_weights(row) + c, lanes);
      lacking = lacking * weight;
    }
    if (job_.gradient != nullptr) {
      Floats common = two * luminance * inv_d;
      Floats by_luminance = two * p_by_m * inv_m * fma(mean_t, mean_t, means + c1) * (one - a);
      if (kWeighted) common = common * weight, by_luminance = by_luminance * weight;
      // A variance that was clamped at 0 has no gradient; a NaN stays NaN.
      const Floats v = select(raw_x < zero, zero, common * a);
      const Floats u = select(raw_d < zero, zero, common - v);
      const Floats by_p = fma(mean_t, v, fnma(p, u, by_luminance));
      store_lanes(ring(y, 0) + c, by_p, lanes);
      store_lanes(ring(y, 1) + c, u, lanes);
      store_lanes(ring(y, 2) + c, v, lanes);
    }
    return lanes == kLanes ? lacking : select_or_zero(mask_from_bits((1u << lanes) - 1), lacking);
  }

  void gradient_group(int y) {
    const float* map[kInputRows][kFields];
    for (int i = 0; i < kInputRows; ++i)
      for (int f = 0; f < kFields; ++f) {
        const int row = y - kMapShrink + i;
        map[i][f] = row >= 0 && row < map_rows_ ? ring(row, f) : zeros_;
      }
    if (kWeighted) expand_weights(y, weight_rows_);
    const WindowWeights w(job_.window);
    RowSums sums;
    for_each_column(
        map_columns_, columns_, kRowShrink,
        [&](int c, int lanes, int chunk_index) __attribute__((always_inline)) {
          sum_down(w, chunk_, chunk_index, [&](int i, Floats* v) {
            for (int f = 0; f < kFields; ++f) v[f] = load_lanes(map[i][f] + c, lanes);
          });
        },
        [&](int c, int lanes, int chunk_index) __attribute__((always_inline)) {
          for (int row = 0; row < kGroup; ++row)
            if (is_own_row(y + row))
              sums.part[row] += gradient_vector(w, y + row, row, c, lanes, chunk_index);
          sums.next(c + kLanes >= columns_);
        });
    store_totals(sums, y, kGroup, job_.l1_rows);
  }

  // Stores the gradient of one vector, and returns its |d|, times the weights.
  XRGS_INLINE Floats gradient_vector(const WindowWeights& w, int y, int row, int c, int lanes,
                                     int chunk_index) {
    const std::size_t at = static_cast<std::size_t>(y) * columns_ + c;
    const Floats by_p = sum_across(w, &chunk_.rows[row][0][chunk_index]);
    const Floats u = sum_across(w, &chunk_.rows[row][1][chunk_index]);
    const Floats v = sum_across(w, &chunk_.rows[row][2][chunk_index]);
    const Floats x = load_lanes(job_.image + at, lanes), t = load_lanes(job_.target + at, lanes);
    const Floats d = x - t;
    Floats difference = abs(d), slope = broadcast(job_.l1_slope);
    if (kWeighted) {
      const Floats weight = load_lanes(pixel_weights(row) + c, lanes);
      difference = weight * difference;
      slope = weight * slope;
    }
    const Floats sign = select_or_zero(t < x, slope) - select_or_zero(x < t, slope);
    const Floats by_ssim = fnma(t, v, fma(d, u, by_p));
    store_lanes(job_.gradient + at, fma(broadcast(job_.ssim_slope), by_ssim, sign), lanes);
    return difference;
  }

  // The pixel weights of a group's row, once for each channel.
  float* pixel_weights(int row) const { return weight_rows_ + row * weight_row_size(job_.width); }
  // The pixel weights at the centres of the windows of a group's row, once for each channel.
  float* centre_weights(int row) const { return pixel_weights(kGroup + row) + kRowShrink / 2; }
  float* ring(int y, int field) { return ring_ + (field * kRing + (y & (kRing - 1))) * row_size_; }

  const PhotometricJob& job_;
  const int first_, last_, columns_, map_columns_, map_rows_;
  const std::size_t row_size_;
  float* const ring_;
  float* const zeros_;
  float* const weight_rows_;  // of pixel_weights and centre_weights; only if kWeighted
  ColumnChunk chunk_;
};

std::size_t scratch_size(const PhotometricJob& job) {
  const int weight_rows = job.pixel_weight == nullptr ? 0 : 2 * kGroup;
  return (kFields * kRing + 1) * ring_row_size(job.width) +
         static_cast<std::size_t>(weight_rows) * weight_row_size(job.width);
}

void band(const PhotometricJob& job, int first, int last, float* memory) {
  if (job.pixel_weight == nullptr)
    Band<false>(job, first, last, memory).compute();
  else
    Band<true>(job, first, last, memory).compute();
}

}  // namespace

extern const PhotometricKernels photometric_kernels{scratch_size, band};

}  // namespace XRGS_NS
}  // namespace xrgs
