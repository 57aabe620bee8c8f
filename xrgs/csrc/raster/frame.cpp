// The stores of frames and workspaces: a few of each are kept.
#include "raster/frame.h"

#include <cstdlib>
#include <mutex>
#include <new>

#include "memory.h"

namespace xrgs {
namespace {

constexpr std::size_t kKept = 2;  // training renders one view at a time, or a pair

template <class T>
class Store {
 public:
  std::unique_ptr<T> take() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (free_.empty()) return std::make_unique<T>();
    std::unique_ptr<T> last = std::move(free_.back());
    free_.pop_back();
    return last;
  }
  void give(std::unique_ptr<T> used) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (free_.size() < kKept) free_.push_back(std::move(used));
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<T>> free_;
};

// Never destroyed: a frame may outlive every static at the interpreter's exit.
template <class T>
Store<T>& store() {
  static Store<T>* instance = new Store<T>;
  return *instance;
}

}  // namespace

void* grow_block(void* block, std::size_t bytes) {
  std::free(block);
  void* grown = allocate(bytes);
  if (grown == nullptr) throw std::bad_alloc();
  return grown;
}

void free_block(void* block) noexcept { std::free(block); }

std::int64_t Frame::evaluations() const {
  std::int64_t sum = 0;
  for (std::size_t i = 0; i < tile_evaluations.size(); ++i) sum += tile_evaluations[i];
  return sum;
}

std::int64_t Frame::bytes() const {
  return static_cast<std::int64_t>(records.bytes() + visible.bytes() + shades.bytes() +
                                   slots.bytes() + order.bytes() + spare.bytes() + entries.bytes() +
                                   tile_begin.bytes() + batch_begin.bytes() + batches_done.bytes() +
                                   batches.bytes() + tile_evaluations.bytes() +
                                   entries.size() * kSlotSize * sizeof(float));
}

std::unique_ptr<Frame> take_frame() { return store<Frame>().take(); }
void give_frame(std::unique_ptr<Frame> frame) noexcept { store<Frame>().give(std::move(frame)); }
std::unique_ptr<Workspace> take_workspace() { return store<Workspace>().take(); }
void give_workspace(std::unique_ptr<Workspace> workspace) noexcept {
  store<Workspace>().give(std::move(workspace));
}

}  // namespace xrgs
