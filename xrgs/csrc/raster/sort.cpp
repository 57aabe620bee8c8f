// LSD radix sort of (depth key, Gaussian): up to 11 bits at a time, of as many as the keys differ
// in.
//
// In parallel each chunk counts its digits, and the counts are summed digit by digit, chunk by
// chunk: each chunk then knows its places, and the result is the stable one for any chunking.
#include "raster/sort.h"

#include <algorithm>
#include <vector>

#include "pool.h"

namespace xrgs {
namespace {

constexpr int kMostDigitBits = 11;
constexpr std::size_t kMostDigits = std::size_t{1} << kMostDigitBits;
constexpr std::int64_t kChunkLeast = 8192;  // smaller ones are not worth waking a thread

std::uint32_t key_of(std::uint64_t item) { return static_cast<std::uint32_t>(item >> 32); }

struct Range {
  std::uint32_t least, most;
};

// Of the keys of items first..last-1, at least one.
Range range_of(const std::uint64_t* items, std::int64_t first, std::int64_t last) {
  Range range{key_of(items[first]), key_of(items[first])};
  for (std::int64_t i = first + 1; i < last; ++i) {
    range.least = std::min(range.least, key_of(items[i]));
    range.most = std::max(range.most, key_of(items[i]));
  }
  return range;
}

// As few digits as can be, and as small as that allows.
int digit_bits(std::uint32_t range) {
  int bits = 1;
  while (bits < 32 && range >> bits != 0) ++bits;
  const int digits = (bits + kMostDigitBits - 1) / kMostDigitBits;
  return (bits + digits - 1) / digits;
}

}  // namespace

void sort_by_depth(int threads, Frame& frame, Workspace& workspace) {
  const std::int64_t count = frame.seen;
  if (count < 2) return;
  std::uint64_t* from = frame.order.data();
  std::uint64_t* to = frame.spare.data();
  const std::int64_t chunks =
      std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count / kChunkLeast));
  const std::int64_t size = (count + chunks - 1) / chunks;
  std::vector<Range> ranges(static_cast<std::size_t>(chunks));
  parallel_for(threads, chunks, [&](std::int64_t c) {
    ranges[static_cast<std::size_t>(c)] = range_of(from, c * size, std::min(count, (c + 1) * size));
  });
  Range all = ranges.front();
  for (const Range& range : ranges)
    all = {std::min(all.least, range.least), std::max(all.most, range.most)};
  const std::uint32_t least = all.least, range = all.most - all.least;
  const int bits = digit_bits(range);
  const std::size_t digits = std::size_t{1} << bits;
  const auto digit_of = [=](std::uint64_t item, int shift) {
    return ((key_of(item) - least) >> shift) & (digits - 1);
  };
  std::uint32_t* histogram =
      workspace.histogram.resize(static_cast<std::size_t>(chunks) * kMostDigits);
  bool swapped = false;
  for (int shift = 0; shift < 32 && range >> shift != 0; shift += bits) {
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* counts = histogram + static_cast<std::size_t>(c) * digits;
      std::fill(counts, counts + digits, 0u);
      for (std::int64_t i = c * size; i < std::min(count, (c + 1) * size); ++i)
        ++counts[digit_of(from[i], shift)];
    });
    std::uint32_t place = 0;
    for (std::size_t digit = 0; digit < digits; ++digit)
      for (std::int64_t c = 0; c < chunks; ++c) {
        std::uint32_t& here = histogram[static_cast<std::size_t>(c) * digits + digit];
        const std::uint32_t n = here;
        here = place;
        place += n;
      }
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* places = histogram + static_cast<std::size_t>(c) * digits;
      for (std::int64_t i = c * size; i < std::min(count, (c + 1) * size); ++i)
        to[places[digit_of(from[i], shift)]++] = from[i];
    });
    std::swap(from, to);
    swapped = !swapped;
  }
  if (swapped) frame.order.swap(frame.spare);
}

}  // namespace xrgs
