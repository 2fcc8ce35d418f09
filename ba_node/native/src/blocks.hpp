// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Columns of 6 or 9 numbers and blocks of 6 x 6 or 9 x 9, laid out for registers of eight doubles.
#pragma once

#include <cstdint>
#include <cstring>

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

// out += e v.
template <int D>
[[gnu::always_inline]] inline void add_product(Column<D>& out, const Edge<D>& e, const double* v) {
  V8 a = out.a;
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i) a += e.a[i] * v[i];
  out.a = a;
  if constexpr (D == 9) out.b += e.b[0] * v[0] + e.b[1] * v[1] + e.b[2] * v[2];
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

// The blocks block(i) -= y[i] x' for i in [0, count). As y changes and x does not, the numbers of x that are spread over
// registers stay there (6) or serve two blocks at once (9): loads, not products, are what is scarce.
template <class Find>
[[gnu::always_inline]] inline void subtract_products(const Edge<6>& x, const Edge<6>* y, int count, Find block) {
  V8 spread[3][6];
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i)
#pragma GCC unroll 6
    for (int c = 0; c < 6; ++c) spread[i][c] = splat(x.a[i][c]);
  for (int f = 0; f < count; ++f) {
    Block<6>& s = block(f);
    const V8 y0 = y[f].a[0], y1 = y[f].a[1], y2 = y[f].a[2];
#pragma GCC unroll 6
    for (int c = 0; c < 6; ++c) s.col[c] = s.col[c] - y0 * spread[0][c] - y1 * spread[1][c] - y2 * spread[2][c];
  }
}

template <class Find>
[[gnu::always_inline]] inline void subtract_products(const Edge<9>& x, const Edge<9>* y, int count, Find block) {
  int f = 0;
  for (; f + 1 < count; f += 2) {
    Block<9>&s = block(f), &t = block(f + 1);
    const V8 y0 = y[f].a[0], y1 = y[f].a[1], y2 = y[f].a[2];
    const V8 z0 = y[f + 1].a[0], z1 = y[f + 1].a[1], z2 = y[f + 1].a[2];
#pragma GCC unroll 9
    for (int c = 0; c < 9; ++c) {
      const V8 x0 = splat(c < 8 ? x.a[0][c] : x.b[0]), x1 = splat(c < 8 ? x.a[1][c] : x.b[1]);
      const V8 x2 = splat(c < 8 ? x.a[2][c] : x.b[2]);
      s.col[c] = s.col[c] - y0 * x0 - y1 * x1 - y2 * x2;
      t.col[c] = t.col[c] - z0 * x0 - z1 * x1 - z2 * x2;
    }
    subtract_ninth(s, y[f], x);
    subtract_ninth(t, y[f + 1], x);
  }
  if (f < count) subtract_product(block(f), y[f], x);
}

template <int D>
inline double entry(const Block<D>& s, int r, int c) {
  if constexpr (D == 9) {
    if (r == 8) return c == 8 ? s.corner : s.row[c];
  }
  return s.col[c][r];
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
