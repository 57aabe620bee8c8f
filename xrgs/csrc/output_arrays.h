// Arrays that are handed to Python, on memory that is used again.
//
// Touching new pages takes longer than the kernels that fill them: a new gradient of 18 MB is 4,400
// page faults. A block is released when the last tensor on it dies, and waits here for the next one
// of its size.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <initializer_list>
#include <memory>

namespace xrgs {

// Returns an uninitialised block of at least `bytes` on a 64-byte boundary. Throws std::bad_alloc.
void* acquire_block(std::size_t bytes);
void release_block(void* block) noexcept;

struct ReleaseBlock {
  void operator()(void* block) const noexcept { release_block(block); }
};

using Output = nanobind::ndarray<nanobind::pytorch, nanobind::device::cpu, nanobind::c_contig>;

// Returns an uninitialised tensor of the given shape. The caller must hold the GIL.
template <class T>
Output new_array(std::initializer_list<std::size_t> shape) {
  std::size_t count = 1;
  for (std::size_t side : shape) count *= side;
  std::unique_ptr<void, ReleaseBlock> block(acquire_block(count * sizeof(T)));
  nanobind::capsule owner(block.get(), [](void* p) noexcept { release_block(p); });
  return Output(block.release(), shape, owner, {}, nanobind::dtype<T>());
}

}  // namespace xrgs
