// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Memory of the kernels: cut from slabs that are asked for in huge pages and kept for the kernels that come after.
//
// To touch a page of 4 KiB for the first time takes a microsecond or more, which is more than is done with it in one
// solve; and every window is solved by new kernels.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace ba {

// How often the kernels have asked for memory, for the test that an iteration does not.
inline std::atomic<long long> allocations{0};

class Slabs {
 public:
  static Slabs& shared() {
    static Slabs* slabs = new Slabs;  // never destroyed: kernels may outlive what is static
    return *slabs;
  }

  // Touch the first page, so that the first small solve does not.
  void warm() {
    void* piece = take(kHugePage);
    std::memset(piece, 0, kHugePage);
    give(piece, kHugePage);
  }

  void* take(std::size_t bytes) {
    bytes = rounded(bytes, kLine);
    const std::lock_guard<std::mutex> lock(mutex_);
    for (auto slab = slabs_.rbegin(); slab != slabs_.rend(); ++slab)
      if (slab->size - slab->used >= bytes) return cut(*slab, bytes);
    const std::size_t size = rounded(bytes < kSlab ? kSlab : bytes, kHugePage);
    void* begin = std::aligned_alloc(kHugePage, size);
    if (begin == nullptr) throw std::bad_alloc();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    madvise(begin, size, MADV_HUGEPAGE);  // where it is refused, pages are small
#endif
    slabs_.push_back({static_cast<char*>(begin), size, 0, 0});
    return cut(slabs_.back(), bytes);
  }

  void give(void* piece, std::size_t bytes) {
    bytes = rounded(bytes, kLine);
    const std::lock_guard<std::mutex> lock(mutex_);
    std::size_t i = 0;
    while (!holds(slabs_[i], piece)) ++i;
    Slab& slab = slabs_[i];
    if (static_cast<char*>(piece) + bytes == slab.begin + slab.used) slab.used -= bytes;
    if (--slab.pieces != 0) return;
    slab.used = 0;
    std::size_t idle = 0;
    for (const Slab& other : slabs_) idle += other.pieces == 0 ? other.size : 0;
    if (idle <= kKept) return;
    std::free(slab.begin);
    slabs_.erase(slabs_.begin() + static_cast<std::ptrdiff_t>(i));
  }

 private:
  static constexpr std::size_t kLine = 64, kHugePage = std::size_t{1} << 21, kSlab = std::size_t{1} << 24;
  // Slabs without pieces that are not given back.
  static constexpr std::size_t kKept = std::size_t{1} << 25;

  struct Slab {
    char* begin;
    std::size_t size, used, pieces;
  };

  static std::size_t rounded(std::size_t bytes, std::size_t to) { return (bytes + to - 1) / to * to; }
  static bool holds(const Slab& slab, const void* piece) {
    return piece >= slab.begin && piece < slab.begin + slab.size;
  }
  static void* cut(Slab& slab, std::size_t bytes) {
    void* piece = slab.begin + slab.used;
    slab.used += bytes;
    ++slab.pieces;
    return piece;
  }

  std::mutex mutex_;
  std::vector<Slab> slabs_;
};

// Aligned for registers. What a vector grows by is left as it is unless a value is given.
template <class T>
struct Aligned {
  using value_type = T;
  Aligned() = default;
  template <class U>
  Aligned(const Aligned<U>&) {}
  T* allocate(std::size_t n) {
    allocations.fetch_add(1, std::memory_order_relaxed);
    return static_cast<T*>(get((n * sizeof(T) + 63) / 64 * 64));
  }
  void deallocate(T* p, std::size_t n) { put(p, (n * sizeof(T) + 63) / 64 * 64); }
  template <class U>
  void construct(U* p) noexcept(std::is_nothrow_default_constructible<U>::value) {
    ::new (static_cast<void*>(p)) U;
  }
  template <class U, class... Args>
  void construct(U* p, Args&&... args) {
    ::new (static_cast<void*>(p)) U(std::forward<Args>(args)...);
  }
  template <class U>
  bool operator==(const Aligned<U>&) const { return true; }
  template <class U>
  bool operator!=(const Aligned<U>&) const { return false; }

 private:
#if defined(__SANITIZE_ADDRESS__)
  // So that the sanitizer sees where one buffer ends and the next begins.
  static void* get(std::size_t bytes) {
    void* p = std::aligned_alloc(64, bytes);
    if (p == nullptr) throw std::bad_alloc();
    return p;
  }
  static void put(void* p, std::size_t) { std::free(p); }
#else
  static void* get(std::size_t bytes) { return Slabs::shared().take(bytes); }
  static void put(void* p, std::size_t bytes) { Slabs::shared().give(p, bytes); }
#endif
};

template <class T>
using Buffer = std::vector<T, Aligned<T>>;

}  // namespace ba
