// A stable counting sort of the (tile, Gaussian) pairs by tile. The pairs are in depth order, so
// each list is in depth order too; gsplat sorts (tile, depth) keys instead.
//
// Each pair has a row of pair_grads. The rows are sorted by Gaussian.
#include "raster/tile_lists.h"

#include <algorithm>
#include <atomic>
#include <limits>
#include <new>

#include "thread_pool.h"

namespace xrgs {
namespace {

constexpr std::int64_t kMinChunk = 4096;  // Gaussians
constexpr std::int64_t kSegmentPairs = 1 << 16;
// Alignment of the counts of each chunk, so that two chunks never share a pair of cache lines:
// threads that write to the same line wait for each other at each write.
constexpr std::int64_t kCountsAlignment = 32;

// Writes the pairs of Gaussians first..last-1 of the depth order, segment by segment. Returns false
// if memory is exhausted.
bool intersect_chunk(const RasterKernels& kernels, Frame& frame, std::int64_t first,
                     std::int64_t last, std::vector<Buffer<TileIntersection>>& segments,
                     std::uint32_t* tile_counts) {
  std::size_t used = 0;
  try {
    for (std::int64_t next = first; next < last; ++used) {
      if (used == segments.size()) segments.emplace_back();
      const std::int64_t capacity = 16 * frame.config.tile_count() + kSegmentPairs;
      TileIntersection* out = segments[used].resize(static_cast<std::size_t>(capacity));
      const std::int64_t count =
          kernels.intersect_tiles(frame, &next, last, out, capacity, tile_counts);
      segments[used].resize(static_cast<std::size_t>(count));
    }
  } catch (const std::bad_alloc&) {
    return false;
  }
  for (; used < segments.size(); ++used) segments[used].resize(0);
  return true;
}

// Converts counts [chunks, stride], with `tiles` used columns, to the position of each chunk's
// first entry in each tile's list, and fills tile_offsets and batch_offsets.
void counts_to_positions(std::int64_t chunks, std::int64_t tiles, std::int64_t stride,
                         std::uint32_t* counts, Frame& frame) {
  std::int64_t position = 0, batch = 0;
  for (std::int64_t tile = 0; tile < tiles; ++tile) {
    frame.tile_offsets[static_cast<std::size_t>(tile)] = static_cast<std::uint32_t>(position);
    frame.batch_offsets[static_cast<std::size_t>(tile)] = static_cast<std::uint32_t>(batch);
    const std::int64_t begin = position;
    for (std::int64_t c = 0; c < chunks; ++c) {
      std::uint32_t& entry = counts[c * stride + tile];
      const std::uint32_t count = entry;
      entry = static_cast<std::uint32_t>(position);
      position += count;
    }
    batch += (position - begin + kBatchSize - 1) / kBatchSize;
  }
  frame.tile_offsets[static_cast<std::size_t>(tiles)] = static_cast<std::uint32_t>(position);
  frame.batch_offsets[static_cast<std::size_t>(tiles)] = static_cast<std::uint32_t>(batch);
}

// Assigns a row of pair_grads to each pair of each Gaussian. Returns the total number of pairs.
std::int64_t assign_pair_ranges(int threads, Frame& frame) {
  constexpr std::int64_t kGaussiansPerTask = 1 << 15;
  const auto count = static_cast<std::int64_t>(frame.pair_ranges.size());
  const std::int64_t tasks = (count + kGaussiansPerTask - 1) / kGaussiansPerTask;
  const auto task_end = [=](std::int64_t t) {
    return std::min(count, (t + 1) * kGaussiansPerTask);
  };
  std::vector<std::int64_t> first(static_cast<std::size_t>(tasks) + 1, 0);  // row of each task
  parallel_for(threads, tasks, [&](std::int64_t t) {
    std::int64_t sum = 0;
    for (std::int64_t i = t * kGaussiansPerTask; i < task_end(t); ++i)
      sum += frame.pair_ranges[static_cast<std::size_t>(i)].count;
    first[static_cast<std::size_t>(t) + 1] = sum;
  });
  for (std::size_t t = 0; t < static_cast<std::size_t>(tasks); ++t) first[t + 1] += first[t];
  parallel_for(threads, tasks, [&](std::int64_t t) {
    std::int64_t next = first[static_cast<std::size_t>(t)];
    for (std::int64_t i = t * kGaussiansPerTask; i < task_end(t); ++i) {
      PairRange& range = frame.pair_ranges[static_cast<std::size_t>(i)];
      range.first = static_cast<std::uint32_t>(next);
      next += range.count;
    }
  });
  return first.back();
}

// Moves the pairs of a chunk to the lists of their tiles.
void scatter_chunk(const std::vector<Buffer<TileIntersection>>& segments, std::uint32_t* positions,
                   Frame& frame) {
  const PairRange* pair_ranges = frame.pair_ranges.data();
  TileEntry* entries = frame.entries.data();
  std::int64_t current = -1;
  std::uint32_t pair = 0;
  for (const Buffer<TileIntersection>& segment : segments)
    for (std::size_t i = 0; i < segment.size(); ++i) {
      const TileIntersection intersection = segment[i];
      if (intersection.gaussian != current) {
        current = intersection.gaussian;
        pair = pair_ranges[current].first;
      }
      entries[positions[intersection.tile]++] = {intersection.gaussian, pair++};
    }
}

}  // namespace

void build_tile_lists(int threads, const RasterKernels& kernels, Frame& frame,
                      Workspace& workspace) {
  const std::int64_t tiles = frame.config.tile_count();
  const std::int64_t chunks = std::max<std::int64_t>(
      1, std::min<std::int64_t>(threads == 1 ? 1 : 4 * threads, frame.visible_count / kMinChunk));
  const std::int64_t chunk_size = (frame.visible_count + chunks - 1) / chunks;
  if (static_cast<std::int64_t>(workspace.intersections.size()) < chunks)
    workspace.intersections.resize(static_cast<std::size_t>(chunks));
  const std::int64_t stride = (tiles + kCountsAlignment - 1) / kCountsAlignment * kCountsAlignment;
  std::uint32_t* counts =
      workspace.list_positions.resize(static_cast<std::size_t>(chunks * stride));
  std::atomic<bool> allocation_ok{true};
  parallel_for(threads, chunks, [&](std::int64_t c) {
    std::fill(counts + c * stride, counts + (c + 1) * stride, 0u);
    if (!intersect_chunk(kernels, frame, std::min(frame.visible_count, c * chunk_size),
                         std::min(frame.visible_count, (c + 1) * chunk_size),
                         workspace.intersections[static_cast<std::size_t>(c)], counts + c * stride))
      allocation_ok = false;
  });
  if (!allocation_ok) throw std::bad_alloc();

  // Positions have 32 bits. Memory is exhausted far below that limit: the backward pass needs 64
  // bytes for each pair.
  const std::int64_t pairs = assign_pair_ranges(threads, frame);
  if (pairs > std::numeric_limits<std::uint32_t>::max()) throw std::bad_alloc();

  frame.tile_offsets.resize(static_cast<std::size_t>(tiles) + 1);
  frame.batch_offsets.resize(static_cast<std::size_t>(tiles) + 1);
  frame.composited_batches.resize(static_cast<std::size_t>(tiles));
  frame.tile_evaluations.resize(static_cast<std::size_t>(tiles));
  counts_to_positions(chunks, tiles, stride, counts, frame);
  frame.entries.resize(static_cast<std::size_t>(pairs));
  frame.batches.resize(frame.batch_offsets[static_cast<std::size_t>(tiles)]);
  parallel_for(threads, chunks, [&](std::int64_t c) {
    scatter_chunk(workspace.intersections[static_cast<std::size_t>(c)], counts + c * stride, frame);
  });
}

}  // namespace xrgs
