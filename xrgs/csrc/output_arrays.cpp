// Blocks that are not in use are kept in one list for each size class, at most kMaxCachedBytes in
// all.
#include "output_arrays.h"

#include <map>
#include <mutex>
#include <new>
#include <unordered_map>
#include <vector>

#include "memory.h"

namespace xrgs {
namespace {

constexpr std::size_t kAlignment = 64;

#ifdef __SANITIZE_ADDRESS__
// Every block is new and has the exact size, so that the sanitizer sees a step past its end.
constexpr std::size_t kMaxCachedBytes = 0;
constexpr bool kExactSizes = true;
#else
constexpr std::size_t kMaxCachedBytes = std::size_t{1} << 30;
constexpr bool kExactSizes = false;
#endif

struct BlockCache {
  std::mutex mutex;
  std::unordered_map<void*, std::size_t> in_use;  // the size class of each block
  std::map<std::size_t, std::vector<void*>> unused;
  std::size_t unused_bytes = 0;
};

// The cache is never destroyed, because tensors may outlive every static when the interpreter
// exits.
BlockCache& block_cache() {
  static BlockCache* instance = new BlockCache;
  return *instance;
}

// Sizes within 1/8 of one another share a class, so that a growing model does not need new blocks.
std::size_t size_class(std::size_t bytes) {
  if (kExactSizes) return (bytes / kAlignment + 1) * kAlignment;
  std::size_t size = 4096;
  while (size < bytes) size += size >= 32768 ? size / 8 / kAlignment * kAlignment : size;
  return size;
}

}  // namespace

void* acquire_block(std::size_t bytes) {
  const std::size_t size = size_class(bytes);
  BlockCache& cache = block_cache();
  std::lock_guard<std::mutex> lock(cache.mutex);
  void* block = nullptr;
  auto blocks = cache.unused.find(size);
  if (blocks != cache.unused.end() && !blocks->second.empty()) {
    block = blocks->second.back();
    blocks->second.pop_back();
    cache.unused_bytes -= size;
  } else {
    block = allocate(size);
    if (block == nullptr) throw std::bad_alloc();
  }
  cache.in_use.emplace(block, size);
  return block;
}

void release_block(void* block) noexcept {
  BlockCache& cache = block_cache();
  std::lock_guard<std::mutex> lock(cache.mutex);
  auto entry = cache.in_use.find(block);
  if (entry == cache.in_use.end()) return;
  const std::size_t size = entry->second;
  cache.in_use.erase(entry);
  if (cache.unused_bytes + size > kMaxCachedBytes) {
    deallocate(block);
    return;
  }
  cache.unused[size].push_back(block);
  cache.unused_bytes += size;
}

}  // namespace xrgs
