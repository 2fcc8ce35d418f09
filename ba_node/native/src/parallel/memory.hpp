// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Memory of the kernels: cut from slabs, in huge pages where some are at hand, and kept for the kernels that come
// after.
//
// To touch a page of 4 KiB for the first time takes a microsecond or more, which is more than is done with it in one
// solve; and every window is solved by new kernels.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdlib>
#include <mutex>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

namespace ba {

// How often the kernels have asked for memory, for the test that an iteration does not.
extern std::atomic<long long> allocations;

class Slabs {
 public:
  static Slabs& shared();

  // Touch the first page, so that the first small solve does not.
  void warm();

  void* take(std::size_t bytes);
  void give(void* memory, std::size_t bytes);

 private:
  struct Slab {
    char* begin;
    std::size_t size, used, in_use;
  };

  static bool holds(const Slab& slab, const void* memory);
  static void* cut(Slab& slab, std::size_t bytes);

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
  bool operator==(const Aligned<U>&) const {
    return true;
  }
  template <class U>
  bool operator!=(const Aligned<U>&) const {
    return false;
  }

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
