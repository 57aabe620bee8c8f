// The store of blocks: a list of free ones for each size, at most kKept bytes in all.
#include "arrays.h"

#include <cstdlib>
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
constexpr std::size_t kKept = 0;  // every block new and exact, so that a step outside is seen
constexpr bool kExact = true;
#else
constexpr std::size_t kKept = std::size_t{1} << 30;
constexpr bool kExact = false;
#endif

struct Store {
  std::mutex mutex;
  std::unordered_map<void*, std::size_t> lent;
  std::map<std::size_t, std::vector<void*>> free;
  std::size_t kept = 0;
};

// Never destroyed: tensors may outlive every static at the interpreter's exit.
Store& store() {
  static Store* instance = new Store;
  return *instance;
}

// Sizes within 1/8 of one another share blocks, so that a growing model does not need new ones.
std::size_t rounded(std::size_t bytes) {
  if (kExact) return (bytes / kAlignment + 1) * kAlignment;
  std::size_t size = 4096;
  while (size < bytes) size += size >= 32768 ? size / 8 / kAlignment * kAlignment : size;
  return size;
}

}  // namespace

void* take_block(std::size_t bytes) {
  const std::size_t size = rounded(bytes);
  Store& s = store();
  std::lock_guard<std::mutex> lock(s.mutex);
  void* block = nullptr;
  auto found = s.free.find(size);
  if (found != s.free.end() && !found->second.empty()) {
    block = found->second.back();
    found->second.pop_back();
    s.kept -= size;
  } else {
    block = allocate(size);
    if (block == nullptr) throw std::bad_alloc();
  }
  s.lent.emplace(block, size);
  return block;
}

void give_block(void* block) noexcept {
  Store& s = store();
  std::lock_guard<std::mutex> lock(s.mutex);
  auto found = s.lent.find(block);
  if (found == s.lent.end()) return;
  const std::size_t size = found->second;
  s.lent.erase(found);
  if (s.kept + size > kKept) {
    std::free(block);
    return;
  }
  s.free[size].push_back(block);
  s.kept += size;
}

}  // namespace xrgs
