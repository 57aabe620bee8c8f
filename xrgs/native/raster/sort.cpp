// LSD radix sort of (depth key, Gaussian): 11 bits at a time, of as many as the keys differ in.
//
// In parallel each chunk counts its digits, and the counts are summed digit by digit, chunk by
// chunk: each chunk then knows its places, and the result is the stable one for any chunking.
#include "raster/sort.h"

#include <algorithm>

#include "pool.h"

namespace xrgs {
namespace {

constexpr int kDigitBits = 11;
constexpr std::size_t kDigits = std::size_t{1} << kDigitBits;
constexpr std::int64_t kChunkLeast = 8192;  // smaller ones are not worth waking a thread

std::uint32_t key_of(std::uint64_t item) { return static_cast<std::uint32_t>(item >> 32); }

std::size_t digit_of(std::uint64_t item, std::uint32_t least, int shift) {
  return ((key_of(item) - least) >> shift) & (kDigits - 1);
}

}  // namespace

void sort_by_depth(int threads, Frame& frame, Workspace& workspace) {
  const std::int64_t count = frame.seen;
  if (count < 2) return;
  std::uint64_t* from = frame.order.data();
  std::uint64_t* to = frame.spare.data();
  std::uint32_t least = key_of(from[0]), most = least;
  for (std::int64_t i = 1; i < count; ++i) {
    least = std::min(least, key_of(from[i]));
    most = std::max(most, key_of(from[i]));
  }
  const std::int64_t chunks =
      std::max<std::int64_t>(1, std::min<std::int64_t>(threads, count / kChunkLeast));
  const std::int64_t size = (count + chunks - 1) / chunks;
  std::uint32_t* histogram = workspace.histogram.resize(static_cast<std::size_t>(chunks) * kDigits);
  bool swapped = false;
  for (int shift = 0; shift < 32 && (most - least) >> shift != 0; shift += kDigitBits) {
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* counts = histogram + static_cast<std::size_t>(c) * kDigits;
      std::fill(counts, counts + kDigits, 0u);
      for (std::int64_t i = c * size; i < std::min(count, (c + 1) * size); ++i)
        ++counts[digit_of(from[i], least, shift)];
    });
    std::uint32_t place = 0;
    for (std::size_t digit = 0; digit < kDigits; ++digit)
      for (std::int64_t c = 0; c < chunks; ++c) {
        std::uint32_t& here = histogram[static_cast<std::size_t>(c) * kDigits + digit];
        const std::uint32_t n = here;
        here = place;
        place += n;
      }
    parallel_for(threads, chunks, [&](std::int64_t c) {
      std::uint32_t* places = histogram + static_cast<std::size_t>(c) * kDigits;
      for (std::int64_t i = c * size; i < std::min(count, (c + 1) * size); ++i)
        to[places[digit_of(from[i], least, shift)]++] = from[i];
    });
    std::swap(from, to);
    swapped = !swapped;
  }
  if (swapped) frame.order.swap(frame.spare);
}

}  // namespace xrgs
