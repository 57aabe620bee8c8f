// A radix sort, least significant digit first, with digits of up to 11 bits that cover the range of
// the keys.
//
// Each chunk of items counts its digits. The counts are summed digit by digit and, within a digit,
// chunk by chunk, which gives each chunk the positions of its items. The sort is stable for any
// number of chunks.
#include "raster/depth_sort.h"

#include <algorithm>
#include <vector>

#include "thread_pool.h"

namespace xrgs {
namespace {

constexpr int kMaxDigitBits = 11;
constexpr std::size_t kMaxDigitValues = std::size_t{1} << kMaxDigitBits;
constexpr std::int64_t kMinChunk = 8192;  // for fewer items, waking a thread does not pay

std::uint32_t key_of(std::uint64_t item) { return static_cast<std::uint32_t>(item >> 32); }

struct KeyRange {
  std::uint32_t min, max;
};

// The range of the keys of items first..last-1, at least one item.
KeyRange key_range(const std::uint64_t* items, std::int64_t first, std::int64_t last) {
  KeyRange range{key_of(items[first]), key_of(items[first])};
  for (std::int64_t i = first + 1; i < last; ++i) {
    range.min = std::min(range.min, key_of(items[i]));
    range.max = std::max(range.max, key_of(items[i]));
  }
  return range;
}

// Bits of a digit: the least number that covers the range with the least number of digits.
int digit_bits(std::uint32_t range) {
  int bits = 1;
  while (bits < 32 && range >> bits != 0) ++bits;
  const int digits = (bits + kMaxDigitBits - 1) / kMaxDigitBits;
  return (bits + digits - 1) / digits;
}

// Converts counts [chunks, digit_values] to the first position of each chunk's items of each digit.
void counts_to_positions(std::uint32_t* counts, std::int64_t chunks, std::size_t digit_values) {
  std::uint32_t position = 0;
  for (std::size_t digit = 0; digit < digit_values; ++digit)
    for (std::int64_t c = 0; c < chunks; ++c) {
      std::uint32_t& entry = counts[static_cast<std::size_t>(c) * digit_values + digit];
      const std::uint32_t count = entry;
      entry = position;
      position += count;
    }
}

}  // namespace

void sort_by_depth(int threads, Frame& frame, Workspace& workspace) {
  const std::int64_t count = frame.visible_count;
  if (count < 2) return;
  std::uint64_t* from = frame.order.data();
  std::uint64_t* to = frame.order_buffer.data();
  const std::int64_t chunks =
      std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count / kMinChunk));
  const std::int64_t chunk_size = (count + chunks - 1) / chunks;
  const auto chunk_end = [=](std::int64_t c) { return std::min(count, (c + 1) * chunk_size); };
  std::vector<KeyRange> ranges(static_cast<std::size_t>(chunks));
  parallel_for(threads, chunks, [&](std::int64_t c) {
    ranges[static_cast<std::size_t>(c)] = key_range(from, c * chunk_size, chunk_end(c));
  });
  KeyRange all = ranges.front();
  for (const KeyRange& range : ranges)
    all = {std::min(all.min, range.min), std::max(all.max, range.max)};
  const std::uint32_t min = all.min, range = all.max - all.min;
  const int bits = digit_bits(range);
  const std::size_t digit_values = std::size_t{1} << bits;
  const auto digit_of = [=](std::uint64_t item, int shift) {
    return ((key_of(item) - min) >> shift) & (digit_values - 1);
  };
  std::uint32_t* histogram =
      workspace.histogram.resize(static_cast<std::size_t>(chunks) * kMaxDigitValues);
  bool swapped = false;
  for (int shift = 0; shift < 32 && range >> shift != 0; shift += bits) {
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* counts = histogram + static_cast<std::size_t>(c) * digit_values;
      std::fill(counts, counts + digit_values, 0u);
      for (std::int64_t i = c * chunk_size; i < chunk_end(c); ++i)
        ++counts[digit_of(from[i], shift)];
    });
    counts_to_positions(histogram, chunks, digit_values);
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* positions = histogram + static_cast<std::size_t>(c) * digit_values;
      for (std::int64_t i = c * chunk_size; i < chunk_end(c); ++i)
        to[positions[digit_of(from[i], shift)]++] = from[i];
    });
    std::swap(from, to);
    swapped = !swapped;
  }
  if (swapped) frame.order.swap(frame.order_buffer);
}

}  // namespace xrgs
