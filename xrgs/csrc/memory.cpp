#include "memory.h"

#include <cstdlib>

#ifdef XRGS_FAULT_INJECTION
#include <atomic>
#include <new>
#endif

#if defined(__linux__)
#include <sys/mman.h>
#elif defined(_WIN32)
#include <malloc.h>
#endif

namespace xrgs {
namespace {

constexpr std::size_t kLine = 64;
[[maybe_unused]] constexpr std::size_t kHugePage = std::size_t{2} << 20;

#ifdef XRGS_FAULT_INJECTION
std::atomic<std::int64_t> allocations_left{0};  // up to and including the one that fails
std::atomic<bool> has_failed{false};

bool must_fail() noexcept {
  if (allocations_left.load() <= 0 || allocations_left.fetch_sub(1) != 1) return false;
  has_failed = true;
  return true;
}
#endif

}  // namespace

#ifdef XRGS_FAULT_INJECTION
void fail_allocation(std::int64_t number) noexcept {
  has_failed = false;
  allocations_left = number;
}

bool allocation_failed() noexcept { return has_failed; }
#endif

void* allocate(std::size_t bytes) noexcept {
#ifdef XRGS_FAULT_INJECTION
  if (must_fail()) return nullptr;
#endif
#if defined(__linux__) && defined(MADV_HUGEPAGE) && !defined(__SANITIZE_ADDRESS__)
  if (bytes >= 2 * kHugePage) {
    const std::size_t size = (bytes + kHugePage - 1) / kHugePage * kHugePage;
    void* block = std::aligned_alloc(kHugePage, size);
    // If this fails, the block works without huge pages, only more slowly.
    if (block != nullptr) (void)madvise(block, size, MADV_HUGEPAGE);
    return block;
  }
#endif
  const std::size_t size = (bytes + kLine - 1) / kLine * kLine;
#if defined(_WIN32)
  return _aligned_malloc(size, kLine);
#else
  return std::aligned_alloc(kLine, size);
#endif
}

void deallocate(void* block) noexcept {
#if defined(_WIN32)
  _aligned_free(block);
#else
  std::free(block);
#endif
}

}  // namespace xrgs

#ifdef XRGS_FAULT_INJECTION
// With the linker's option --wrap, calls of operator new in the module go to __wrap__Znwm, and
// __real__Znwm is the real operator new. A module can't replace operator new only for itself. _Znwm
// is the mangled name of operator new(unsigned long).
extern "C" {
void* __real__Znwm(std::size_t bytes);
void* __wrap__Znwm(std::size_t bytes);
}

void* __wrap__Znwm(std::size_t bytes) {
  if (xrgs::must_fail()) throw std::bad_alloc();
  return __real__Znwm(bytes);
}
#endif
