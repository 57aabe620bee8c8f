// Arrays handed to Python whose memory is used again.
//
// Fresh pages cost more than the kernels that fill them: a new 18 MB gradient is 4,400 page faults.
// A block given back (when the last tensor on it dies) waits here for the next one of its size.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <initializer_list>
#include <memory>

namespace xrgs {

// A block of at least `bytes`, on a 64-byte boundary, its contents anything. Throws std::bad_alloc.
void* take_block(std::size_t bytes);
void give_block(void* block) noexcept;

struct GiveBlock {
  void operator()(void* block) const noexcept { give_block(block); }
};

using Output = nanobind::ndarray<nanobind::pytorch, nanobind::device::cpu, nanobind::c_contig>;

// A tensor of the given shape on a block, contents anything. The caller holds the GIL.
template <class T>
Output new_array(std::initializer_list<std::size_t> shape) {
  std::size_t count = 1;
  for (std::size_t side : shape) count *= side;
  std::unique_ptr<void, GiveBlock> block(take_block(count * sizeof(T)));
  nanobind::capsule owner(block.get(), [](void* p) noexcept { give_block(p); });
  return Output(block.release(), shape, owner, {}, nanobind::dtype<T>());
}

}  // namespace xrgs
