// Large blocks of memory.
#pragma once

#include <cstddef>

namespace xrgs {

// At least `bytes` on a 64-byte boundary, contents anything; null where there is no memory. Large
// blocks ask for huge pages: records and sums are read in no order, and with pages of 4 KB most
// such reads miss the TLB, too. Freed by std::free.
void* allocate(std::size_t bytes) noexcept;

}  // namespace xrgs
