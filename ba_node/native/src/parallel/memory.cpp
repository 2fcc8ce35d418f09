// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "parallel/memory.hpp"

#include <cstring>

#if defined(__linux__)
#include <sys/mman.h>
#include <unistd.h>

#include <fstream>
#endif

#include "parallel/huge_pages.hpp"

namespace ba {

namespace {

constexpr std::size_t kCacheLine = 64, kSlab = std::size_t{1} << 24;
// Bytes of slabs out of use that are not given back.
constexpr std::size_t kKept = std::size_t{1} << 25;

std::size_t rounded(std::size_t bytes, std::size_t to) { return (bytes + to - 1) / to * to; }

// Have a new slab in huge pages where twice as much is at hand in them, so that others find some too.
void ask_for_huge_pages([[maybe_unused]] void* begin, [[maybe_unused]] std::size_t size) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  if (sysconf(_SC_PAGESIZE) != 4096) return;
  std::ifstream buddyinfo("/proc/buddyinfo");
  if (free_in_huge_pages(buddyinfo) >= 2 * size) madvise(begin, size, MADV_HUGEPAGE);  // if refused, pages are small
#endif
}

}  // namespace

std::atomic<long long> allocations{0};

Slabs& Slabs::shared() {
  static Slabs* slabs = new Slabs;  // never destroyed: kernels may outlive what is static
  return *slabs;
}

void Slabs::warm() {
  void* memory = take(kHugePage);
  std::memset(memory, 0, kHugePage);
  give(memory, kHugePage);
}

void* Slabs::take(std::size_t bytes) {
  bytes = rounded(bytes, kCacheLine);
  const std::lock_guard<std::mutex> lock(mutex_);
  for (auto slab = slabs_.rbegin(); slab != slabs_.rend(); ++slab)
    if (slab->size - slab->used >= bytes) return cut(*slab, bytes);
  const std::size_t size = rounded(bytes < kSlab ? kSlab : bytes, kHugePage);
  void* begin = std::aligned_alloc(kHugePage, size);
  if (begin == nullptr) throw std::bad_alloc();
  ask_for_huge_pages(begin, size);
  slabs_.push_back({static_cast<char*>(begin), size, 0, 0});
  return cut(slabs_.back(), bytes);
}

void Slabs::give(void* memory, std::size_t bytes) {
  bytes = rounded(bytes, kCacheLine);
  const std::lock_guard<std::mutex> lock(mutex_);
  std::size_t i = 0;
  while (!holds(slabs_[i], memory)) ++i;
  Slab& slab = slabs_[i];
  if (static_cast<char*>(memory) + bytes == slab.begin + slab.used) slab.used -= bytes;
  if (--slab.in_use != 0) return;
  slab.used = 0;
  std::size_t idle = 0;
  for (const Slab& other : slabs_) idle += other.in_use == 0 ? other.size : 0;
  if (idle <= kKept) return;
  std::free(slab.begin);
  slabs_.erase(slabs_.begin() + static_cast<std::ptrdiff_t>(i));
}

bool Slabs::holds(const Slab& slab, const void* memory) {
  return memory >= slab.begin && memory < slab.begin + slab.size;
}

void* Slabs::cut(Slab& slab, std::size_t bytes) {
  void* memory = slab.begin + slab.used;
  slab.used += bytes;
  ++slab.in_use;
  return memory;
}

}  // namespace ba
