#include "raster/driver.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <numeric>
#include <vector>

#include "pool.h"
#include "raster/kernels.h"
#include "raster/lists.h"
#include "raster/sort.h"

namespace xrgs {
namespace {

// Milliseconds since the last call.
class Clock {
 public:
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
    last_ = now;
    return ms;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

class Borrowed {
 public:
  Borrowed() : workspace_(take_workspace()) {}
  ~Borrowed() { give_workspace(std::move(workspace_)); }
  Borrowed(const Borrowed&) = delete;
  Borrowed& operator=(const Borrowed&) = delete;
  Workspace& operator*() { return *workspace_; }

 private:
  std::unique_ptr<Workspace> workspace_;
};

// Close up the sort keys: chunk c's seen[c] from its own place in `spare` to `order`.
void close_up(int threads, std::int64_t chunks, const std::int32_t* seen, Frame& frame) {
  constexpr std::int64_t kTogether = 32;  // chunks a task
  std::vector<std::int64_t> place(static_cast<std::size_t>(chunks) + 1, 0);
  for (std::size_t c = 0; c < static_cast<std::size_t>(chunks); ++c)
    place[c + 1] = place[c] + seen[c];
  frame.seen = place.back();
  parallel_for(threads, (chunks + kTogether - 1) / kTogether, [&](std::int64_t task) {
    for (std::int64_t c = task * kTogether; c < std::min(chunks, (task + 1) * kTogether); ++c)
      std::memcpy(frame.order.data() + place[static_cast<std::size_t>(c)],
                  frame.spare.data() + c * kChunk,
                  static_cast<std::size_t>(seen[c]) * sizeof(std::uint64_t));
  });
}

// Chunks project into places of their own in `spare`, which are then closed up.
bool project_all(int threads, const RasterKernels& kernels, const Parameters& p, Frame& frame,
                 Workspace& workspace) {
  const std::size_t count = static_cast<std::size_t>(p.count);
  frame.gaussians = p.count;
  frame.records.resize(count);
  frame.visible.resize((count + 15) / 16);
  frame.shades.resize((count + 15) / 16);
  frame.slots.resize(count);
  frame.order.resize(count);
  frame.spare.resize(count);
  const std::int64_t chunks = (p.count + kChunk - 1) / kChunk;
  std::int32_t* seen = workspace.chunk_seen.resize(static_cast<std::size_t>(chunks));
  std::atomic<bool> all_good{true};
  parallel_for(threads, chunks, [&](std::int64_t c) {
    const std::int64_t first = c * kChunk, last = std::min(p.count, first + kChunk);
    bool good = true;
    seen[c] = static_cast<std::int32_t>(
        kernels.project(p, frame.view, first, last, frame, frame.spare.data() + first, &good));
    if (!good) all_good = false;
  });
  close_up(threads, chunks, seen, frame);
  return all_good;
}

// body(tile) for every tile. Where each thread has few of them, those with the longest lists go
// first, so that no thread is left with one when the others are done.
template <class Body>
void for_each_tile(int threads, const Frame& frame, Body&& body) {
  constexpr std::int64_t kFewTiles = 128;  // a thread
  const std::int64_t tiles = std::int64_t{frame.view.columns()} * frame.view.rows();
  if (threads == 1 || tiles > kFewTiles * threads) {
    parallel_for(threads, tiles, [&](std::int64_t tile) { body(static_cast<int>(tile)); });
    return;
  }
  const auto length = [&](int tile) {
    const auto i = static_cast<std::size_t>(tile);
    return frame.tile_begin[i + 1] - frame.tile_begin[i];
  };
  std::vector<int> order(static_cast<std::size_t>(tiles));
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](int a, int b) { return length(a) > length(b); });
  parallel_for(threads, tiles, [&](std::int64_t i) { body(order[static_cast<std::size_t>(i)]); });
}

}  // namespace

bool render(int threads, const Parameters& parameters, const View& view, Frame& frame, float* image,
            float* alpha) {
  const RasterKernels& kernels = XRGS_PICK(raster_kernels);
  Borrowed workspace;
  frame.view = view;
  Clock clock;
  if (!project_all(threads, kernels, parameters, frame, *workspace)) return false;
  frame.timings.project = clock.lap();
  sort_by_depth(threads, frame, *workspace);
  frame.timings.sort = clock.lap();
  make_lists(threads, kernels, frame, *workspace);
  frame.timings.bin = clock.lap();
  for_each_tile(threads, frame, [&](int tile) { kernels.composite(frame, tile, image, alpha); });
  frame.timings.composite = clock.lap();
  return true;
}

void render_backward(int threads, const Parameters& parameters, Frame& frame,
                     const float* image_gradient, const float* alpha_gradient,
                     const Gradients& gradients) {
  const RasterKernels& kernels = XRGS_PICK(raster_kernels);
  Borrowed workspace;
  Clock clock;
  float* sums = (*workspace).sums.resize(frame.entries.size() * kSlotSize);
  for_each_tile(threads, frame, [&](int tile) {
    kernels.composite_backward(frame, tile, image_gradient, alpha_gradient, sums);
  });
  frame.timings.composite_backward = clock.lap();
  const std::int64_t chunks = (parameters.count + kChunk - 1) / kChunk;
  parallel_for(threads, chunks, [&](std::int64_t c) {
    const std::int64_t first = c * kChunk, last = std::min(parameters.count, first + kChunk);
    kernels.project_backward(parameters, frame, sums, first, last, gradients);
  });
  frame.timings.project_backward = clock.lap();
}

}  // namespace xrgs
