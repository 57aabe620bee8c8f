#include "memory.h"

#include <cstdlib>

#if defined(__linux__)
#include <sys/mman.h>
#elif defined(_WIN32)
#include <malloc.h>
#endif

namespace xrgs {
namespace {

constexpr std::size_t kLine = 64;
[[maybe_unused]] constexpr std::size_t kHugePage = std::size_t{2} << 20;

}  // namespace

void* allocate(std::size_t bytes) noexcept {
#if defined(__linux__) && defined(MADV_HUGEPAGE) && !defined(__SANITIZE_ADDRESS__)
  if (bytes >= 2 * kHugePage) {
    const std::size_t size = (bytes + kHugePage - 1) / kHugePage * kHugePage;
    void* block = std::aligned_alloc(kHugePage, size);
    // A failure is no error: the block works without huge pages, only more slowly.
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
