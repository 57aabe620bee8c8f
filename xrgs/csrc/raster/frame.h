// The memory of one rendered view, from its forward pass to its backward pass.
//
// Frames are reused for later views, because touching new pages takes as long as the kernels that
// write them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "raster/types.h"

namespace xrgs {

// Returns an uninitialised block of at least `bytes`. Throws std::bad_alloc.
void* new_block(std::size_t bytes);
void free_block(void* block) noexcept;

// A 64-byte aligned array whose memory only grows, and is not initialised.
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

  // Makes room for `size` elements. The contents are lost if the memory has to grow. If it throws
  // std::bad_alloc, the buffer is empty.
  T* resize(std::size_t size) {
    if (size > capacity_) {
      const std::size_t new_capacity = kExactBuffers ? size : size + size / 8;
      // The old block is freed first, so that both are never in memory together.
      free_block(std::exchange(data_, nullptr));
      capacity_ = size_ = 0;
      data_ = static_cast<T*>(new_block(new_capacity * sizeof(T)));
      capacity_ = new_capacity;
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
  static constexpr bool kExactBuffers = true;  // so that a sanitizer detects accesses past the end
#else
  static constexpr bool kExactBuffers = false;
#endif
  T* data_ = nullptr;
  std::size_t capacity_ = 0, size_ = 0;
};

// The duration of each stage, in milliseconds.
struct Timings {
  double project = 0, sort = 0, intersect_tiles = 0, composite = 0;
  double composite_backward = 0, project_backward = 0;
};

struct Frame {
  bool rendered = false;  // whether the members below are of a completed render
  RenderConfig config;
  std::int64_t gaussian_count = 0;             // N
  std::int64_t visible_count = 0;              // M
  Buffer<ProjectedGaussian> projected;         // [N], written for visible Gaussians only
  Buffer<std::uint16_t> visible;               // [N / 16], one bit for each Gaussian
  Buffer<ColorDerivatives> color_derivatives;  // [N / 16], written if any of the 16 is visible
  Buffer<PairRange> pair_ranges;               // [N]
  Buffer<std::uint64_t> order;                 // [M] depth key << 32 | Gaussian, front to back
  Buffer<std::uint64_t> order_buffer;          // [N] the second array of the sort
  Buffer<TileEntry> entries;                   // [pairs] by tile, each tile front to back
  Buffer<std::uint32_t> tile_offsets;          // [tiles + 1] into entries
  Buffer<std::uint32_t> batch_offsets;         // [tiles + 1] into batches
  Buffer<std::uint32_t> composited_batches;    // [tiles] batches before the tile was saturated
  Buffer<SavedBatch> batches;                  // [batches]
  Buffer<std::int64_t> tile_evaluations;       // [tiles] number of computed alphas
  Timings timings;

  std::int64_t pair_count() const { return static_cast<std::int64_t>(entries.size()); }
  std::int64_t evaluations() const;
  // The memory in use, including the pair_grads of the backward pass.
  std::int64_t bytes() const;
};

// Temporary memory of one forward or backward pass.
struct Workspace {
  // The pairs of each chunk of Gaussians, front to back, in several segments.
  std::vector<std::vector<Buffer<TileIntersection>>> intersections;
  Buffer<std::uint32_t> list_positions;       // [chunks, tiles], rows padded
  Buffer<std::uint32_t> histogram;            // of the depth sort
  Buffer<std::int32_t> chunk_visible_counts;  // [chunks]
  Buffer<float> pair_grads;                   // [pairs, kPairGradStride]
};

// Returns a released frame or workspace, or a new one. Throws std::bad_alloc.
std::unique_ptr<Frame> acquire_frame();
void release_frame(std::unique_ptr<Frame> frame) noexcept;
std::unique_ptr<Workspace> acquire_workspace();
void release_workspace(std::unique_ptr<Workspace> workspace) noexcept;

#ifdef XRGS_FAULT_INJECTION
// Only for tests: the next render has to allocate all memory.
void delete_unused_frames() noexcept;
#endif

}  // namespace xrgs
