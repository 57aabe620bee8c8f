// Allocation of large blocks of memory.
#pragma once

#include <cstddef>
#ifdef XRGS_FAULT_INJECTION
#include <cstdint>
#endif

namespace xrgs {

// Returns at least `bytes` of uninitialised memory on a 64-byte boundary, or null where there is
// not enough. The caller frees it with deallocate(). Large blocks ask for huge pages, because
// projected Gaussians and pair_grads are read in random order, where with pages of 4 KB most reads
// miss the TLB as well.
void* allocate(std::size_t bytes) noexcept;
void deallocate(void* block) noexcept;

#ifdef XRGS_FAULT_INJECTION
// For tests only: makes the number-th allocation of the module from now on fail, the next one being
// number 1, and no other. 0 stands for none. Calls of `allocate` and of operator new count, on any
// thread.
void fail_allocation(std::int64_t number) noexcept;

// Whether the allocation that the last call of fail_allocation chose was reached.
bool allocation_failed() noexcept;
#endif

}  // namespace xrgs
