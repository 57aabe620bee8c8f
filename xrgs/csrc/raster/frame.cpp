#include "raster/frame.h"

#include <mutex>
#include <new>

#include "memory.h"

namespace xrgs {
namespace {

constexpr std::size_t kMaxUnused = 2;  // training renders one view at a time, or a pair

// Objects that are not in use and wait to be used again.
template <class T>
class FreeList {
 public:
  std::unique_ptr<T> acquire() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (unused_.empty()) return std::make_unique<T>();
    std::unique_ptr<T> last = std::move(unused_.back());
    unused_.pop_back();
    return last;
  }
  void release(std::unique_ptr<T> object) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (unused_.size() < kMaxUnused) unused_.push_back(std::move(object));
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<T>> unused_;
};

// The list is never destroyed, because a frame may outlive every static when the interpreter exits.
template <class T>
FreeList<T>& free_list() {
  static FreeList<T>* instance = new FreeList<T>;
  return *instance;
}

}  // namespace

void* replace_block(void* block, std::size_t bytes) {
  deallocate(block);
  void* replacement = allocate(bytes);
  if (replacement == nullptr) throw std::bad_alloc();
  return replacement;
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
  free_list<Frame>().release(std::move(frame));
}
std::unique_ptr<Workspace> acquire_workspace() { return free_list<Workspace>().acquire(); }
void release_workspace(std::unique_ptr<Workspace> workspace) noexcept {
  free_list<Workspace>().release(std::move(workspace));
}

}  // namespace xrgs
