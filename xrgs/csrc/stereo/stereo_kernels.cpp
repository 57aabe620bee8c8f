// A plane is computed row by row, all other views in turn, so that what five rows need stays in the
// caches. Sums are in the order of numpy's, and products are not fused with them.
#include "simd/simd.h"
#include "stereo/stereo.h"

namespace xrgs {
namespace XRGS_NS {
namespace {

constexpr int kReach = 2;  // windows reach this many px to each side
constexpr int kRows = 2 * kReach + 1;
constexpr int kMoments = 3;          // sums of J, J J and I J
constexpr int kKept = kMoments + 1;  // and whether the pixel is in the other view

std::size_t padded(int width) {
  return (static_cast<std::size_t>(width) + kLanes - 1) / kLanes * kLanes;
}

int lanes_at(std::size_t column, std::size_t width) {
  return width - column < kLanes ? static_cast<int>(width - column) : kLanes;
}

std::size_t costs_scratch(const CostJob& job) {
  const std::size_t width = padded(job.width);
  return width * kRows * kKept * job.count + (width + 2 * kLanes) * kMoments + width * job.best;
}

struct Bilinear {
  Ints before;   // the sample before the position, clamped to the image
  Floats after;  // the weight of the next sample
};

XRGS_INLINE Bilinear bilinear(Floats position, int size) {
  const Floats zero = broadcast(0.0f), last = broadcast(static_cast<float>(size - 1));
  position = clamp(position - broadcast(0.5f), zero, last);
  const Ints before = to_ints(position);
  return {before, position - to_floats(before)};
}

// The lanes whose pixel (x, y) of the other view, px, is inside its mask.
Mask inside_mask(const OtherView& other, Floats x, Floats y) {
  const Floats zero = broadcast(0.0f);
  std::int32_t column[kLanes], row[kLanes];
  store(column, to_ints(clamp(x, zero, broadcast(static_cast<float>(other.width - 1)))));
  store(row, to_ints(clamp(y, zero, broadcast(static_cast<float>(other.height - 1)))));
  std::uint32_t bits = 0;
  for (int lane = 0; lane < kLanes; ++lane) {
    const std::size_t at = static_cast<std::size_t>(row[lane]) * other.width + column[lane];
    bits |= static_cast<std::uint32_t>(other.used[at] != 0) << lane;
  }
  return mask_from_bits(bits);
}

// Samples another view at the pixels of a row: writes J, J J and I J to rows of `stride` floats,
// and to `inside` 1 where the pixel is in the other view, else 0.
void sample_row(const CostJob& job, const OtherView& other, int plane, int y, float* moments,
                std::size_t stride, float* inside) {
  const std::size_t pixels = static_cast<std::size_t>(job.height) * job.width;
  const std::size_t row = static_cast<std::size_t>(y) * job.width;
  const std::size_t pitch = static_cast<std::size_t>(other.width) + 1;
  const Floats zero = broadcast(0.0f), one = broadcast(1.0f), half = broadcast(0.5f);
  for (int c = 0; c < job.width; c += kLanes) {
    const int lanes = lanes_at(c, job.width);
    const Mask there = mask_from_bits((1u << lanes) - 1);
    const Floats q = job.per_pixel
                         ? load_first(job.inverse_depths + plane * pixels + row + c, lanes)
                         : broadcast(job.inverse_depths[plane]);
    Floats at[3];
    for (int k = 0; k < 3; ++k)
      at[k] = load_first(other.a + k * pixels + row + c, lanes) + broadcast(other.b[k]) * q;
    const Floats nearest = broadcast(job.nearest);
    const Floats depth = max(at[2], nearest);
    const Floats px = at[0] / depth, py = at[1] / depth;
    Mask in = (nearest < at[2]) & (zero <= px) & (zero <= py) &
              (px <= broadcast(static_cast<float>(other.width))) &
              (py <= broadcast(static_cast<float>(other.height)));
    if (other.used != nullptr) in = in & inside_mask(other, px, py);
    const Bilinear across = bilinear(px, other.width), down = bilinear(py, other.height);
    std::int32_t column[kLanes], line[kLanes];
    store(column, across.before);
    store(line, down.before);
    float corner[4][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const float* from = other.image + line[lane] * pitch + column[lane];
      corner[0][lane] = from[0];
      corner[1][lane] = from[1];
      corner[2][lane] = from[pitch];
      corner[3][lane] = from[pitch + 1];
    }
    const Floats left = load(corner[0]), low = load(corner[2]);
    const Floats top = left + across.after * (load(corner[1]) - left);
    const Floats bottom = low + across.after * (load(corner[3]) - low);
    const Floats sample = select_or_zero(there, top + down.after * (bottom - top) - half);
    store(moments + c, sample);
    store(moments + stride + c, sample * sample);
    store(moments + 2 * stride + c, load_first(job.image + row + c, lanes) * sample);
    store(inside + c, select(in, one, zero));
  }
}

// Sums each float of a row, which has zeros on both sides, with its neighbours.
void sum_across(const float* row, std::size_t width, float* sums) {
  for (std::size_t c = 0; c < width; c += kLanes) {
    const float* at = row + c;
    Floats sum = load(at);
    for (int shift = 1; shift <= kReach; ++shift) sum = (sum + load(at - shift)) + load(at + shift);
    store(sums + c, sum);
  }
}

// Puts the correlations of a row with one other view among the highest, [best, padded width].
void score_row(const CostJob& job, int y, const float* ring, std::size_t width, float* highest) {
  const auto kept = [=](int row, int what) {
    return ring + (static_cast<std::size_t>((row + kRows) % kRows) * kKept + what) * width;
  };
  const std::size_t row = static_cast<std::size_t>(y) * job.width;
  const Floats zero = broadcast(0.0f);
  for (int c = 0; c < job.width; c += kLanes) {
    const int lanes = lanes_at(c, job.width);
    const auto own = [&](const float* of) { return load_first(of + row + c, lanes); };
    Floats moment[kMoments];
    for (int k = 0; k < kMoments; ++k) {
      Floats sum = load(kept(y, k) + c);
      for (int shift = 1; shift <= kReach; ++shift)
        sum = (sum + load(kept(y - shift, k) + c)) + load(kept(y + shift, k) + c);
      moment[k] = sum * own(job.share);
    }
    const Floats mean = moment[0];
    const Floats variance = max(moment[1] - mean * mean, zero) + broadcast(job.noise);
    const Floats covariance = moment[2] - own(job.mean) * mean;
    const Floats correlation = covariance / sqrt(own(job.variance) * variance);
    Floats score = select_or_zero(zero < load(kept(y, kMoments) + c), correlation);
    for (int b = 0; b < job.best; ++b) {
      float* place = highest + b * width + c;
      const Floats best = load(place);
      store(place, max(best, score));
      score = min(best, score);
    }
  }
}

void set_zero(float* from, std::size_t count) {
  for (std::size_t i = 0; i < count; i += kLanes) store(from + i, broadcast(0.0f));
}

void costs(const CostJob& job, int plane, float* scratch) {
  const std::size_t width = padded(job.width), stride = width + 2 * kLanes;
  const std::size_t ring = width * kRows * kKept;
  float* rings = scratch;                     // of each other view
  float* moments = rings + ring * job.count;  // with margins of zeros
  float* highest = moments + stride * kMoments;
  set_zero(scratch, costs_scratch(job));
  for (int y = 0; y < job.height + kReach; ++y) {
    const int centre = y - kReach;  // all rows of its windows are there
    set_zero(highest, width * job.best);
    for (int k = 0; k < job.count; ++k) {
      float* slot = rings + ring * k + width * kKept * (y % kRows);
      if (y < job.height) {
        sample_row(job, job.others[k], plane, y, moments + kLanes, stride, slot + kMoments * width);
        for (int m = 0; m < kMoments; ++m)
          sum_across(moments + kLanes + m * stride, width, slot + m * width);
      } else {
        set_zero(slot, width * kMoments);
      }
      if (centre >= 0) score_row(job, centre, rings + ring * k, width, highest);
    }
    if (centre < 0) continue;
    float* out = job.costs + (static_cast<std::size_t>(plane) * job.height + centre) * job.width;
    for (int c = 0; c < job.width; c += kLanes) {
      Floats total = load(highest + c);
      for (int b = 1; b < job.best; ++b) total = total + load(highest + b * width + c);
      const Floats score = total / broadcast(static_cast<float>(job.best));
      store_first(out + c, broadcast(1.0f) - score, lanes_at(c, job.width));
    }
  }
}

// One step along m lines: L of the next pixels, [planes, m], of L of the pixels before them.
void step_along(const float* before, const float* costs, std::size_t planes, std::size_t m,
                float jump, float step, float* next) {
  for (std::size_t c = 0; c < m; c += kLanes) {
    const int lanes = lanes_at(c, m);
    const auto at = [&](std::size_t plane) { return load_first(before + plane * m + c, lanes); };
    Floats least = at(0);
    for (std::size_t plane = 1; plane < planes; ++plane) least = min(least, at(plane));
    const Floats far = least + broadcast(jump), penalty = broadcast(step);
    Floats above = far, here = at(0);
    for (std::size_t plane = 0; plane < planes; ++plane) {
      Floats reached = min(min(here, far), above);
      above = here + penalty;
      if (plane + 1 < planes) {
        here = at(plane + 1);
        reached = min(reached, here + penalty);
      }
      const Floats cost = load_first(costs + plane * m + c, lanes);
      store_first(next + plane * m + c, (reached - least) + cost, lanes);
    }
  }
}

void sum_along(const float* costs, std::size_t n, std::size_t planes, std::size_t m, float jump,
               float step, float* sums, float* scratch) {
  const std::size_t size = planes * m;
  for (std::size_t i = 0; i < size; ++i) sums[i] = costs[i];
  for (std::size_t place = 1; place < n; ++place)
    step_along(sums + (place - 1) * size, costs + place * size, planes, m, jump, step,
               sums + place * size);
  const float* path = costs + (n - 1) * size;
  for (std::size_t i = 0; i < size; ++i) sums[(n - 1) * size + i] += path[i];
  float* next = scratch;
  for (std::size_t place = n - 1; place-- > 0;) {
    step_along(path, costs + place * size, planes, m, jump, step, next);
    for (std::size_t i = 0; i < size; ++i) sums[place * size + i] += next[i];
    path = next;
    next = next == scratch ? scratch + size : scratch;
  }
}

}  // namespace

extern const StereoKernels stereo_kernels{costs, costs_scratch, sum_along};

}  // namespace XRGS_NS
}  // namespace xrgs
