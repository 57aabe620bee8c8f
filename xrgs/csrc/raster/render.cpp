#include "raster/render.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <numeric>
#include <vector>

#include "raster/depth_sort.h"
#include "raster/raster_kernels.h"
#include "raster/tile_lists.h"
#include "thread_pool.h"

namespace xrgs {
namespace {

// Measures the time since its construction, or since the last call, ms.
class StageTimer {
 public:
  double elapsed_ms() {
    const auto now = std::chrono::steady_clock::now();
    const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
    last_ = now;
    return ms;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

// A workspace that is returned at the end of the scope.
class ScopedWorkspace {
 public:
  ScopedWorkspace() : workspace_(acquire_workspace()) {}
  ~ScopedWorkspace() { release_workspace(std::move(workspace_)); }
  ScopedWorkspace(const ScopedWorkspace&) = delete;
  ScopedWorkspace& operator=(const ScopedWorkspace&) = delete;
  Workspace& operator*() { return *workspace_; }

 private:
  std::unique_ptr<Workspace> workspace_;
};

// Copies the sort keys of each chunk, visible_counts[c] of them at c * kProjectChunk of
// frame.order_buffer, to frame.order without the gaps between chunks.
void compact_sort_keys(int threads, std::int64_t chunks, const std::int32_t* visible_counts,
                       Frame& frame) {
  constexpr std::int64_t kChunksPerTask = 32;
  std::vector<std::int64_t> offsets(static_cast<std::size_t>(chunks) + 1, 0);
  for (std::size_t c = 0; c < static_cast<std::size_t>(chunks); ++c)
    offsets[c + 1] = offsets[c] + visible_counts[c];
  frame.visible_count = offsets.back();
  parallel_for(threads, (chunks + kChunksPerTask - 1) / kChunksPerTask, [&](std::int64_t task) {
    for (std::int64_t c = task * kChunksPerTask; c < std::min(chunks, (task + 1) * kChunksPerTask);
         ++c)
      std::memcpy(frame.order.data() + offsets[static_cast<std::size_t>(c)],
                  frame.order_buffer.data() + c * kProjectChunk,
                  static_cast<std::size_t>(visible_counts[c]) * sizeof(std::uint64_t));
  });
}

// Projects all Gaussians. Returns the bits of their faults.
std::uint32_t project_chunks(int threads, const RasterKernels& kernels,
                             const GaussianParameters& p, Frame& frame, Workspace& workspace) {
  const std::size_t count = static_cast<std::size_t>(p.count);
  frame.gaussian_count = p.count;
  frame.projected.resize(count);
  frame.visible.resize((count + 15) / 16);
  frame.color_derivatives.resize((count + 15) / 16);
  frame.pair_ranges.resize(count);
  frame.order.resize(count);
  frame.order_buffer.resize(count);
  const std::int64_t chunks = (p.count + kProjectChunk - 1) / kProjectChunk;
  std::int32_t* visible_counts =
      workspace.chunk_visible_counts.resize(static_cast<std::size_t>(chunks));
  std::atomic<std::uint32_t> all_faults{0};
  parallel_for(threads, chunks, [&](std::int64_t c) {
    const std::int64_t first = c * kProjectChunk, last = std::min(p.count, first + kProjectChunk);
    std::uint32_t faults = 0;
    visible_counts[c] = static_cast<std::int32_t>(kernels.project(
        p, frame.config, first, last, frame, frame.order_buffer.data() + first, &faults));
    if (faults != 0) all_faults |= faults;
  });
  compact_sort_keys(threads, chunks, visible_counts, frame);
  return all_faults.load();
}

// Calls body(tile) for every tile. A task has several adjacent tiles, because these share cache
// lines of the image, and each tile prefetches the next one. If there are few tiles for each
// thread, tiles with the longest lists are started first, one by one, so that the threads finish
// together.
template <class Body>
void for_each_tile(int threads, const Frame& frame, Body&& body) {
  constexpr std::int64_t kFewTilesPerThread = 128;
  const std::int64_t tiles = frame.config.tile_count();
  if (threads == 1 || tiles > kFewTilesPerThread * threads) {
    constexpr std::int64_t kTilesPerTask = 8;
    parallel_for(threads, (tiles + kTilesPerTask - 1) / kTilesPerTask, [&](std::int64_t task) {
      const std::int64_t last = std::min(tiles, (task + 1) * kTilesPerTask);
      for (std::int64_t tile = task * kTilesPerTask; tile < last; ++tile)
        body(static_cast<int>(tile));
    });
    return;
  }
  const auto length = [&](int tile) {
    const auto i = static_cast<std::size_t>(tile);
    return frame.tile_offsets[i + 1] - frame.tile_offsets[i];
  };
  std::vector<int> order(static_cast<std::size_t>(tiles));
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](int a, int b) { return length(a) > length(b); });
  parallel_for(threads, tiles, [&](std::int64_t i) { body(order[static_cast<std::size_t>(i)]); });
}

}  // namespace

std::uint32_t render(int threads, const GaussianParameters& parameters, const RenderConfig& config,
                     Frame& frame, float* image, float* alpha) {
  const RasterKernels& kernels = XRGS_SELECT(raster_kernels);
  frame.rendered = false;
  ScopedWorkspace workspace;
  frame.config = config;
  frame.visible_count = 0;
  StageTimer timer;
  const std::uint32_t faults = project_chunks(threads, kernels, parameters, frame, *workspace);
  if (faults != 0) return faults;
  frame.timings.project = timer.elapsed_ms();
  sort_by_depth(threads, frame, *workspace);
  frame.timings.sort = timer.elapsed_ms();
  build_tile_lists(threads, kernels, frame, *workspace);
  frame.timings.intersect_tiles = timer.elapsed_ms();
  for_each_tile(threads, frame, [&](int tile) { kernels.composite(frame, tile, image, alpha); });
  frame.timings.composite = timer.elapsed_ms();
  frame.rendered = true;
  return 0;
}

bool render_backward(int threads, const GaussianParameters& parameters, Frame& frame,
                     const float* v_image, const float* v_alpha,
                     const ParameterGradients& gradients) {
  const RasterKernels& kernels = XRGS_SELECT(raster_kernels);
  ScopedWorkspace workspace;
  StageTimer timer;
  float* pair_grads = (*workspace).pair_grads.resize(frame.entries.size() * kPairGradStride);
  for_each_tile(threads, frame, [&](int tile) {
    kernels.composite_backward(frame, tile, v_image, v_alpha, pair_grads);
  });
  frame.timings.composite_backward = timer.elapsed_ms();
  const std::int64_t chunks = (parameters.count + kProjectChunk - 1) / kProjectChunk;
  std::atomic<bool> all_finite{true};
  parallel_for(threads, chunks, [&](std::int64_t c) {
    const std::int64_t first = c * kProjectChunk;
    const std::int64_t last = std::min(parameters.count, first + kProjectChunk);
    if (!kernels.project_backward(parameters, frame, pair_grads, first, last, gradients))
      all_finite = false;
  });
  frame.timings.project_backward = timer.elapsed_ms();
  return all_finite;
}

}  // namespace xrgs
