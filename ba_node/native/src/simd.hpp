// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Eight doubles at once, by the compiler's vector extensions: one register with AVX-512, two with AVX2, four with NEON.
#pragma once

#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <new>
#include <vector>

namespace ba {

constexpr int kLanes = 8;

using V8 = double __attribute__((vector_size(64)));
using Mask = long long __attribute__((vector_size(64)));  // a lane is 0 or -1

[[gnu::always_inline]] inline V8 load(const double* p) {
  V8 out;
  std::memcpy(&out, p, sizeof(out));
  return out;
}

[[gnu::always_inline]] inline V8 splat(double x) { return V8{x, x, x, x, x, x, x, x}; }
[[gnu::always_inline]] inline V8 select(Mask m, V8 a, V8 b) { return m ? a : b; }
[[gnu::always_inline]] inline V8 maximum(V8 a, V8 b) { return a > b ? a : b; }

[[gnu::always_inline]] inline V8 root(V8 v) {
  V8 out{};
  for (int l = 0; l < kLanes; ++l) out[l] = std::sqrt(v[l]);
  return out;
}

[[gnu::always_inline]] inline V8 magnitude(V8 v) {
  V8 out{};
  for (int l = 0; l < kLanes; ++l) out[l] = std::abs(v[l]);
  return out;
}

[[gnu::always_inline]] inline bool any(Mask m) {
  long long bits = 0;
  for (int l = 0; l < kLanes; ++l) bits |= m[l];
  return bits != 0;
}

[[gnu::always_inline]] inline double sum(V8 v) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }

// Lanes of two registers by number, 0 to 7 of a, 8 to 15 of b.
#if defined(__clang__)
#define BA_SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define BA_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, ba::Mask{__VA_ARGS__})
#endif

// Rows become columns.
[[gnu::always_inline]] inline void transpose(V8 (&r)[8]) {
  V8 t[8], q[8];
  for (int i = 0; i < 8; i += 2) {
    t[i] = BA_SHUFFLE(r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    t[i + 1] = BA_SHUFFLE(r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4) {
    for (int j = 0; j < 2; ++j) {
      q[i + j] = BA_SHUFFLE(t[i + j], t[i + j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      q[i + j + 2] = BA_SHUFFLE(t[i + j], t[i + j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  }
  for (int i = 0; i < 4; ++i) {
    r[i] = BA_SHUFFLE(q[i], q[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[i + 4] = BA_SHUFFLE(q[i], q[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

// Lane l becomes the sum of register l.
[[gnu::always_inline]] inline V8 sums(V8 (&r)[8]) {
  transpose(r);
  return ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
}

// How often the kernels have asked for memory, for the test that an iteration does not.
inline std::atomic<long long> allocations{0};

template <class T>
struct Aligned {
  using value_type = T;
  Aligned() = default;
  template <class U>
  Aligned(const Aligned<U>&) {}
  T* allocate(std::size_t n) {
    allocations.fetch_add(1, std::memory_order_relaxed);
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
