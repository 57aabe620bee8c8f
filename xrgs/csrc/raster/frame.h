// The memory of one rendered view, from its forward pass to its backward pass.
//
// Frames are kept and used again: fresh pages would cost as much as the kernels that write them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "raster/types.h"

namespace xrgs {

void* grow_block(void* block, std::size_t bytes);  // contents are lost; throws std::bad_alloc
void free_block(void* block) noexcept;

// An array that only ever grows, on a 64-byte boundary, its contents left as they are.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer&& other) noexcept
      : data_(other.data_), capacity_(other.capacity_), size_(other.size_) {
    other.data_ = nullptr;
    other.capacity_ = other.size_ = 0;
  }
  Buffer& operator=(Buffer&&) = delete;
  ~Buffer() { free_block(data_); }

  // Room for `size` elements; what was in it is lost where it has to grow.
  T* resize(std::size_t size) {
    if (size > capacity_) {
      const std::size_t wanted = kExactBuffers ? size : size + size / 8;
      capacity_ = 0;
      data_ = static_cast<T*>(grow_block(data_, wanted * sizeof(T)));
      capacity_ = wanted;
    }
    size_ = size;
    return data_;
  }
  void swap(Buffer& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(capacity_, other.capacity_);
    std::swap(size_, other.size_);
  }
  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](std::size_t i) { return data_[i]; }
  const T& operator[](std::size_t i) const { return data_[i]; }
  std::size_t size() const { return size_; }
  std::size_t bytes() const { return size_ * sizeof(T); }

 private:
#ifdef __SANITIZE_ADDRESS__
  static constexpr bool kExactBuffers = true;
#else
  static constexpr bool kExactBuffers = false;
#endif
  T* data_ = nullptr;
  std::size_t capacity_ = 0, size_ = 0;
};

// Milliseconds of each stage.
struct Timings {
  double project = 0, sort = 0, bin = 0, composite = 0;
  double composite_backward = 0, project_backward = 0;
};

struct Frame {
  View view;
  std::int64_t gaussians = 0;
  Buffer<Record> records;              // [N], of visible Gaussians only
  Buffer<std::uint16_t> visible;       // [N / 16] a bit a Gaussian
  Buffer<Shade> shades;                // [N / 16], where one of them is visible
  Buffer<Slots> slots;                 // [N]
  Buffer<std::uint64_t> order, spare;  // depth key << 32 | Gaussian; visible ones, front to back
  std::int64_t seen = 0;               // how many are visible
  Buffer<Entry> entries;               // [pairs] by tile, front to back
  Buffer<std::uint32_t> tile_begin;    // [tiles + 1] into entries
  Buffer<std::uint32_t> batch_begin;   // [tiles + 1] into batches
  Buffer<std::uint32_t> batches_done;  // [tiles] how many of a tile's batches were composited
  Buffer<Batch> batches;
  Buffer<std::int64_t> tile_evaluations;  // [tiles]
  Timings timings;

  std::int64_t pairs() const { return static_cast<std::int64_t>(entries.size()); }
  std::int64_t evaluations() const;
  std::int64_t bytes() const;
};

// Memory that no view keeps: used within one forward or one backward pass.
struct Workspace {
  // For each chunk of Gaussians in depth order its pairs, front to back, in pieces.
  std::vector<std::vector<Buffer<Pair>>> emitted;
  Buffer<std::uint32_t> places;     // [chunks, tiles]
  Buffer<std::uint32_t> histogram;  // of the sort
  Buffer<std::int32_t> chunk_seen;  // [chunks]
  Buffer<float> sums;               // [pairs, kSlotSize]
};

std::unique_ptr<Frame> take_frame();
void give_frame(std::unique_ptr<Frame> frame) noexcept;
std::unique_ptr<Workspace> take_workspace();
void give_workspace(std::unique_ptr<Workspace> workspace) noexcept;

}  // namespace xrgs
