// Allocation of large blocks of memory.
#pragma once

#include <cstddef>

namespace xrgs {

// Returns at least `bytes` of uninitialised memory on a 64-byte boundary, or null where there is
// not enough. The caller frees it with deallocate(). Large blocks ask for huge pages, because
// projected Gaussians and pair_grads are read in random order, where with pages of 4 KB most reads
// miss the TLB as well.
void* allocate(std::size_t bytes) noexcept;
void deallocate(void* block) noexcept;

}  // namespace xrgs
