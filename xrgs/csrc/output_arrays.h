// Arrays for Python whose memory is reused.
//
// Touching new pages takes longer than filling them by the kernels: a new gradient of 18 MB causes
// 4,400 page faults. A block is released with the last tensor on it, and kept for the next array of
// its size.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>

namespace xrgs {

// Uninitialised memory with 64-byte alignment. The other members are for the list of unused blocks.
struct Block {
  void* data;
  std::size_t size;         // bytes
  std::uint64_t last_used;  // the number of the acquisition
  Block* next;              // the block that was released before this one
};

void release_block(Block* block) noexcept;

struct ReleaseBlock {
  void operator()(Block* block) const noexcept { release_block(block); }
};
using OwnedBlock = std::unique_ptr<Block, ReleaseBlock>;

// Returns a block of at least `bytes`. Throws std::bad_alloc.
OwnedBlock acquire_block(std::size_t bytes);

// Size of all unused blocks, bytes.
std::size_t unused_bytes();

using Output = nanobind::ndarray<nanobind::pytorch, nanobind::device::cpu, nanobind::c_contig>;

// Returns an uninitialised tensor of the given shape. The caller must hold the GIL. Throws
// std::bad_alloc.
template <class T>
Output new_array(std::initializer_list<std::size_t> shape) {
  std::size_t count = 1;
  for (std::size_t side : shape) count *= side;
  OwnedBlock block = acquire_block(count * sizeof(T));
  void* data = block->data;
  nanobind::capsule owner(block.get(),
                          [](void* p) noexcept { release_block(static_cast<Block*>(p)); });
  (void)block.release();  // the capsule owns it now
  return Output(data, shape, owner, {}, nanobind::dtype<T>());
}

}  // namespace xrgs
