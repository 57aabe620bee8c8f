// Arrays that are handed to Python, on memory that is used again.
//
// Touching new pages takes longer than the kernels that fill them: a new gradient of 18 MB is 4,400
// page faults. A block is released when the last tensor on it dies, and waits here for the next one
// of its size.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>

namespace xrgs {

// Memory on a 64-byte boundary, uninitialised. The members below `data` are those of the list in
// which the block waits while it is not in use.
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

// The bytes of all blocks that are not in use.
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
  (void)block.release();  // it is the capsule's from here on
  return Output(data, shape, owner, {}, nanobind::dtype<T>());
}

}  // namespace xrgs
