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

inline double sum(V8 v) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }

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

// out += sign (three columns) v.
template <int D>
inline void add_scaled(Column<D>& out, const Column<D>* columns, const double* v, double sign) {
  for (int c = 0; c < 3; ++c) {
    out.a += columns[c].a * (sign * v[c]);
    if constexpr (D == 9) out.b += columns[c].b * (sign * v[c]);
  }
}

// s -= (three columns x) (three columns y)'.
template <int D>
inline void subtract_product(Block<D>& s, const Column<D>* x, const Column<D>* y) {
  for (int c = 0; c < (D == 9 ? 8 : 6); ++c)
    s.col[c] -= x[0].a * y[0].a[c] + x[1].a * y[1].a[c] + x[2].a * y[2].a[c];
  if constexpr (D == 9) {
    s.col[8] -= x[0].a * y[0].b + x[1].a * y[1].b + x[2].a * y[2].b;
    s.row -= y[0].a * x[0].b + y[1].a * x[1].b + y[2].a * x[2].b;
    s.corner -= x[0].b * y[0].b + x[1].b * y[1].b + x[2].b * y[2].b;
  }
}

template <int D>
inline double entry(const Block<D>& s, int r, int c) {
  if constexpr (D == 9) {
    if (r == 8) return c == 8 ? s.corner : s.row[c];
  }
  return s.col[c][r];
}

// Of a symmetric block, whose ninth row is not kept.
template <int D>
inline double symmetric_entry(const Block<D>& s, int r, int c) {
  if constexpr (D == 9) {
    if (r == 8 && c == 8) return s.corner;
    if (r == 8) return s.col[8][c];
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
