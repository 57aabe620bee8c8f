// A stable counting sort of the pairs by tile: they come front to back, so each list is, too.
//
// A pair has a slot, too: those of a Gaussian lie side by side, in the order of the Gaussians.
#include "raster/lists.h"

#include <algorithm>
#include <atomic>
#include <limits>
#include <new>

#include "pool.h"

namespace xrgs {
namespace {

constexpr std::int64_t kChunkLeast = 4096;
constexpr std::int64_t kPiece = 1 << 16;  // pairs

// Emit a chunk's pairs, piece by piece. False where memory ran out.
bool emit_chunk(const RasterKernels& kernels, Frame& frame, std::int64_t first, std::int64_t last,
                std::vector<Buffer<Pair>>& pieces, std::uint32_t* counts) {
  const std::int64_t tiles = std::int64_t{frame.view.columns()} * frame.view.rows();
  std::size_t used = 0;
  try {
    for (std::int64_t next = first; next < last; ++used) {
      if (used == pieces.size()) pieces.emplace_back();
      const std::int64_t room = 16 * tiles + kPiece;
      Pair* pairs = pieces[used].resize(static_cast<std::size_t>(room));
      const std::int64_t n = kernels.emit(frame, &next, last, pairs, room, counts);
      pieces[used].resize(static_cast<std::size_t>(n));
    }
  } catch (const std::bad_alloc&) {
    return false;
  }
  for (; used < pieces.size(); ++used) pieces[used].resize(0);
  return true;
}

// Turn counts [chunks, tiles] into each chunk's first place in each tile's list.
void sum_counts(std::int64_t chunks, std::int64_t tiles, std::uint32_t* counts, Frame& frame) {
  std::int64_t place = 0, batch = 0;
  for (std::int64_t tile = 0; tile < tiles; ++tile) {
    frame.tile_begin[static_cast<std::size_t>(tile)] = static_cast<std::uint32_t>(place);
    frame.batch_begin[static_cast<std::size_t>(tile)] = static_cast<std::uint32_t>(batch);
    const std::int64_t begin = place;
    for (std::int64_t c = 0; c < chunks; ++c) {
      std::uint32_t& here = counts[c * tiles + tile];
      const std::uint32_t n = here;
      here = static_cast<std::uint32_t>(place);
      place += n;
    }
    batch += (place - begin + kBatch - 1) / kBatch;
  }
  frame.tile_begin[static_cast<std::size_t>(tiles)] = static_cast<std::uint32_t>(place);
  frame.batch_begin[static_cast<std::size_t>(tiles)] = static_cast<std::uint32_t>(batch);
}

// Give each Gaussian its slots, as many as it has pairs. Returns how many there are.
std::int64_t assign_slots(int threads, Frame& frame) {
  constexpr std::int64_t kTogether = 1 << 15;  // Gaussians a task
  const auto count = static_cast<std::int64_t>(frame.slots.size());
  const std::int64_t tasks = (count + kTogether - 1) / kTogether;
  std::vector<std::int64_t> first(static_cast<std::size_t>(tasks) + 1, 0);  // slot of each task
  parallel_for(threads, tasks, [&](std::int64_t t) {
    std::int64_t sum = 0;
    for (std::int64_t i = t * kTogether; i < std::min(count, (t + 1) * kTogether); ++i)
      sum += frame.slots[static_cast<std::size_t>(i)].count;
    first[static_cast<std::size_t>(t) + 1] = sum;
  });
  for (std::size_t t = 0; t < static_cast<std::size_t>(tasks); ++t) first[t + 1] += first[t];
  parallel_for(threads, tasks, [&](std::int64_t t) {
    std::int64_t next = first[static_cast<std::size_t>(t)];
    for (std::int64_t i = t * kTogether; i < std::min(count, (t + 1) * kTogether); ++i) {
      Slots& slots = frame.slots[static_cast<std::size_t>(i)];
      slots.first = static_cast<std::uint32_t>(next);
      next += slots.count;
    }
  });
  return first.back();
}

// Send a chunk's pairs to their lists.
void scatter_chunk(const std::vector<Buffer<Pair>>& pieces, std::uint32_t* places, Frame& frame) {
  const Slots* slots = frame.slots.data();
  Entry* entries = frame.entries.data();
  std::int64_t current = -1;
  std::uint32_t slot = 0;
  for (const Buffer<Pair>& piece : pieces)
    for (std::size_t i = 0; i < piece.size(); ++i) {
      const Pair pair = piece[i];
      if (pair.gaussian != current) {
        current = pair.gaussian;
        slot = slots[current].first;
      }
      entries[places[pair.tile]++] = {pair.gaussian, slot++};
    }
}

}  // namespace

void make_lists(int threads, const RasterKernels& kernels, Frame& frame, Workspace& workspace) {
  const std::int64_t tiles = std::int64_t{frame.view.columns()} * frame.view.rows();
  const std::int64_t chunks = std::max<std::int64_t>(
      1, std::min<std::int64_t>(threads == 1 ? 1 : 4 * threads, frame.seen / kChunkLeast));
  const std::int64_t size = (frame.seen + chunks - 1) / chunks;
  if (static_cast<std::int64_t>(workspace.emitted.size()) < chunks)
    workspace.emitted.resize(static_cast<std::size_t>(chunks));
  std::uint32_t* counts = workspace.places.resize(static_cast<std::size_t>(chunks * tiles));
  std::atomic<bool> enough{true};
  parallel_for(threads, chunks, [&](std::int64_t c) {
    std::fill(counts + c * tiles, counts + (c + 1) * tiles, 0u);
    if (!emit_chunk(kernels, frame, std::min(frame.seen, c * size),
                    std::min(frame.seen, (c + 1) * size),
                    workspace.emitted[static_cast<std::size_t>(c)], counts + c * tiles))
      enough = false;
  });
  if (!enough) throw std::bad_alloc();

  // Places are 32-bit; far below that bound the sums of the backward pass (64 bytes a pair) and
  // the lists end the memory, which their own allocation says.
  const std::int64_t pairs = assign_slots(threads, frame);
  if (pairs > std::numeric_limits<std::uint32_t>::max()) throw std::bad_alloc();

  frame.tile_begin.resize(static_cast<std::size_t>(tiles) + 1);
  frame.batch_begin.resize(static_cast<std::size_t>(tiles) + 1);
  frame.batches_done.resize(static_cast<std::size_t>(tiles));
  frame.tile_evaluations.resize(static_cast<std::size_t>(tiles));
  sum_counts(chunks, tiles, counts, frame);
  frame.entries.resize(static_cast<std::size_t>(pairs));
  frame.batches.resize(frame.batch_begin[static_cast<std::size_t>(tiles)]);
  parallel_for(threads, chunks, [&](std::int64_t c) {
    scatter_chunk(workspace.emitted[static_cast<std::size_t>(c)], counts + c * tiles, frame);
  });
}

}  // namespace xrgs
