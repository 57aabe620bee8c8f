// Unused blocks are kept in a linked list, the last released first: some tens of blocks, whose
// search takes well under a microsecond. The blocks are the list's elements, so releasing a block
// needs no memory and can't fail.
#include "output_arrays.h"

#include <mutex>
#include <new>

#include "memory.h"

namespace xrgs {
namespace {

constexpr std::size_t kAlignment = 64;

#ifdef XRGS_FAULT_INJECTION
// Every block is newly allocated, so that its allocation can fail, and has the exact size, so that
// a sanitizer detects accesses past the end.
constexpr std::size_t kMaxUnusedBytes = 0;
constexpr bool kExactSizes = true;
#else
constexpr std::size_t kMaxUnusedBytes = std::size_t{1} << 30;
constexpr bool kExactSizes = false;
#endif

// A block unused for this many acquisitions has a size that is no longer needed: they are about
// twenty steps of training, in which views of every size occur.
constexpr std::uint64_t kMaxIdleAcquisitions = 256;

struct BlockCache {
  std::mutex mutex;
  Block* unused = nullptr;
  std::size_t unused_bytes = 0;
  std::uint64_t acquisitions = 0;

  // Removes the block that `link` points to from the list.
  Block* take(Block** link) noexcept {
    Block* block = *link;
    *link = block->next;
    unused_bytes -= block->size;
    return block;
  }
  // Removes and returns a block of exactly `size` bytes, or returns null.
  Block* take_size(std::size_t size) noexcept {
    Block** link = &unused;
    while (*link != nullptr && (*link)->size != size) link = &(*link)->next;
    return *link == nullptr ? nullptr : take(link);
  }
};

// The cache is never destroyed, because tensors may outlive every static when the interpreter
// exits.
BlockCache& block_cache() {
  static BlockCache* instance = new BlockCache;
  return *instance;
}

// Sizes that differ by less than 1/8 share a class, so that a growing model reuses blocks.
std::size_t size_class(std::size_t bytes) {
  if (kExactSizes) return (bytes / kAlignment + 1) * kAlignment;
  std::size_t size = 4096;
  while (size < bytes) size += size >= 32768 ? size / 8 / kAlignment * kAlignment : size;
  return size;
}

void delete_block(Block* block) noexcept {
  deallocate(block->data);
  delete block;
}

Block* new_block(std::size_t size) {
  auto block = std::make_unique<Block>();
  block->data = allocate(size);
  if (block->data == nullptr) throw std::bad_alloc();
  block->size = size;
  return block.release();
}

// Deletes blocks of sizes that are no longer needed. It is called only before allocating a new
// block: while sizes stay the same, memory does not grow, and all blocks are kept.
void delete_idle_blocks(BlockCache& cache) {
  for (Block** link = &cache.unused; *link != nullptr;)
    if (cache.acquisitions - (*link)->last_used > kMaxIdleAcquisitions)
      delete_block(cache.take(link));
    else
      link = &(*link)->next;
}

}  // namespace

OwnedBlock acquire_block(std::size_t bytes) {
  const std::size_t size = size_class(bytes);
  BlockCache& cache = block_cache();
  std::lock_guard<std::mutex> lock(cache.mutex);
  ++cache.acquisitions;
  Block* block = cache.take_size(size);
  if (block == nullptr) {
    delete_idle_blocks(cache);
    block = new_block(size);
  }
  block->last_used = cache.acquisitions;
  return OwnedBlock(block);
}

void release_block(Block* block) noexcept {
  BlockCache& cache = block_cache();
  std::lock_guard<std::mutex> lock(cache.mutex);
  if (cache.unused_bytes + block->size > kMaxUnusedBytes) {
    delete_block(block);
    return;
  }
  block->next = cache.unused;
  cache.unused = block;
  cache.unused_bytes += block->size;
}

std::size_t unused_bytes() {
  BlockCache& cache = block_cache();
  std::lock_guard<std::mutex> lock(cache.mutex);
  return cache.unused_bytes;
}

}  // namespace xrgs
