// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Eight doubles at once, by the compiler's vector extensions: one register with AVX-512, two with AVX2, four with NEON.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>
#include <vector>

namespace ba {

using V8 = double __attribute__((vector_size(64)));

template <class T>
struct Aligned {
  using value_type = T;
  Aligned() = default;
  template <class U>
  Aligned(const Aligned<U>&) {}
  T* allocate(std::size_t n) {
    void* p = std::aligned_alloc(64, (n * sizeof(T) + 63) / 64 * 64);
    if (p == nullptr) throw std::bad_alloc();
    return static_cast<T*>(p);
  }
  void deallocate(T* p, std::size_t) { std::free(p); }
  template <class U>
  bool operator==(const Aligned<U>&) const { return true; }
  template <class U>
  bool operator!=(const Aligned<U>&) const { return false; }
};

template <class T>
using Buffer = std::vector<T, Aligned<T>>;

}  // namespace ba
