// Allocation of large blocks of memory.
#pragma once

#include <cstddef>
#ifdef XRGS_FAULT_INJECTION
#include <cstdint>
#endif

namespace xrgs {

// Returns at least `bytes` of uninitialised memory with 64-byte alignment, or null if there is not
// enough. The caller frees it with deallocate(). For large blocks huge pages are requested, because
// projected Gaussians and pair_grads are read in random order: with 4 KB pages most reads would
// miss the TLB too.
void* allocate(std::size_t bytes) noexcept;
void deallocate(void* block) noexcept;

#ifdef XRGS_FAULT_INJECTION
// Only for tests: makes the number-th allocation of the module from now on fail (1 is the next
// allocation), and only this one; 0 makes none fail. Calls of `allocate` and of operator new count,
// on all threads.
void fail_allocation(std::int64_t number) noexcept;

// Whether the allocation chosen by the last call of fail_allocation has happened.
bool allocation_failed() noexcept;
#endif

}  // namespace xrgs
