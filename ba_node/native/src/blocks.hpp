// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Columns of 6 or 9 numbers and blocks of 6 x 6 or 9 x 9, laid out for registers of eight doubles.
#pragma once

#include <cstdint>
#include <cstring>

#include "memory.hpp"
#include "simd.hpp"

namespace ba {

// A column of d = 6 or 9 numbers: a register, and for 9 one more number.
template <int D>
struct Column {
  V8 a;
  double b;
};
template <>
struct Column<6> {
  V8 a;
};

// A d x 3 block of an edge, by columns; for 9 the ninth rows together.
template <int D>
struct Edge {
  V8 a[3];
  V8 b;
};
template <>
struct Edge<6> {
  V8 a[3];
};

// A d x d block, by columns of eight rows; for 9 also the ninth row.
template <int D>
struct Block {
  V8 col[9];
  V8 row;
  double corner;
  double pad[7];
};
template <>
struct Block<6> {
  V8 col[6];
};

template <class T>
inline void clear(T* first, std::int64_t count) {
  if (count > 0) std::memset(static_cast<void*>(first), 0, static_cast<std::size_t>(count) * sizeof(T));
}

template <int D>
inline double at(const Column<D>& x, int i) {
  if constexpr (D == 9) {
    if (i == 8) return x.b;
  }
  return x.a[i];
}

template <int D>
inline double dot(const Column<D>& x, const Column<D>& y) {
  double out = sum(x.a * y.a);
  if constexpr (D == 9) out += x.b * y.b;
  return out;
}

// The ninth row of s -= x y'.
[[gnu::always_inline]] inline void subtract_ninth(Block<9>& s, const Edge<9>& x, const Edge<9>& y) {
  s.row = s.row - y.a[0] * x.b[0] - y.a[1] * x.b[1] - y.a[2] * x.b[2];
  s.corner -= x.b[0] * y.b[0] + x.b[1] * y.b[1] + x.b[2] * y.b[2];
}

// s -= x y'.
template <int D>
[[gnu::always_inline]] inline void subtract_product(Block<D>& s, const Edge<D>& x, const Edge<D>& y) {
  const V8 x0 = x.a[0], x1 = x.a[1], x2 = x.a[2];
#pragma GCC unroll 8
  for (int c = 0; c < (D == 9 ? 8 : 6); ++c)
    s.col[c] = s.col[c] - x0 * y.a[0][c] - x1 * y.a[1][c] - x2 * y.a[2][c];
  if constexpr (D == 9) {
    s.col[8] = s.col[8] - x0 * y.b[0] - x1 * y.b[1] - x2 * y.b[2];
    subtract_ninth(s, x, y);
  }
}

template <int D>
inline double entry(const Block<D>& s, int r, int c) {
  if constexpr (D == 9) {
    if (r == 8) return c == 8 ? s.corner : s.row[c];
  }
  return s.col[c][r];
}

template <int D>
inline void set_entry(Block<D>& s, int r, int c, double value) {
  if constexpr (D == 9) {
    if (r == 8) {
      if (c == 8) s.corner = value;
      else s.row[c] = value;
      return;
    }
  }
  s.col[c][r] = value;
}

// Symmetric block times column.
template <int D>
inline Column<D> multiply(const Block<D>& b, const Column<D>& x) {
  Column<D> out;
  V8 a = {};
  for (int c = 0; c < (D == 9 ? 8 : 6); ++c) a += b.col[c] * x.a[c];
  if constexpr (D == 9) {
    out.b = sum(b.col[8] * x.a) + b.corner * x.b;
    a += b.col[8] * x.b;
  }
  out.a = a;
  return out;
}

template <int D>
inline void write_block(const Block<D>& s, double* out, std::int64_t stride) {
  for (int c = 0; c < D; ++c)
    for (int r = 0; r < D; ++r) out[r * stride + c] = entry(s, r, c);
}

}  // namespace ba
