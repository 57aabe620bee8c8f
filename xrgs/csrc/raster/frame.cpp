#include "raster/frame.h"

#include <array>
#include <mutex>
#include <new>

#include "memory.h"

namespace xrgs {
namespace {

constexpr std::size_t kMaxUnused = 2;  // training renders one view at a time, or a pair

// Unused objects for reuse.
template <class T>
class FreeList {
 public:
  std::unique_ptr<T> acquire() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (count_ == 0) return std::make_unique<T>();
    return std::move(unused_[--count_]);
  }
  void release(std::unique_ptr<T> object) noexcept {
    std::lock_guard<std::mutex> lock(mutex_);
    if (count_ < kMaxUnused) unused_[count_++] = std::move(object);
  }
#ifdef XRGS_FAULT_INJECTION
  void clear() noexcept {
    std::lock_guard<std::mutex> lock(mutex_);
    while (count_ > 0) unused_[--count_].reset();
  }
#endif

 private:
  std::mutex mutex_;
  std::array<std::unique_ptr<T>, kMaxUnused> unused_;
  std::size_t count_ = 0;
};

// The list is never destroyed, because a frame may outlive every static when the interpreter exits.
template <class T>
FreeList<T>& free_list() {
  static FreeList<T>* instance = new FreeList<T>;
  return *instance;
}

}  // namespace

void* new_block(std::size_t bytes) {
  void* block = allocate(bytes);
  if (block == nullptr) throw std::bad_alloc();
  return block;
}

void free_block(void* block) noexcept { deallocate(block); }

std::int64_t Frame::evaluations() const {
  std::int64_t sum = 0;
  for (std::size_t i = 0; i < tile_evaluations.size(); ++i) sum += tile_evaluations[i];
  return sum;
}

std::int64_t Frame::bytes() const {
  return static_cast<std::int64_t>(
      projected.bytes() + visible.bytes() + color_derivatives.bytes() + pair_ranges.bytes() +
      order.bytes() + order_buffer.bytes() + entries.bytes() + tile_offsets.bytes() +
      batch_offsets.bytes() + composited_batches.bytes() + batches.bytes() +
      tile_evaluations.bytes() + entries.size() * kPairGradStride * sizeof(float));
}

std::unique_ptr<Frame> acquire_frame() { return free_list<Frame>().acquire(); }
void release_frame(std::unique_ptr<Frame> frame) noexcept {
  frame->rendered = false;
  free_list<Frame>().release(std::move(frame));
}
std::unique_ptr<Workspace> acquire_workspace() { return free_list<Workspace>().acquire(); }
void release_workspace(std::unique_ptr<Workspace> workspace) noexcept {
  free_list<Workspace>().release(std::move(workspace));
}

#ifdef XRGS_FAULT_INJECTION
void delete_unused_frames() noexcept {
  free_list<Frame>().clear();
  free_list<Workspace>().clear();
}
#endif

}  // namespace xrgs
