// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Columns of 6 or 9 numbers and blocks of 6 x 6 or 9 x 9, laid out for registers of eight doubles.
#pragma once

#include <cstdint>
#include <cstring>

#include "parallel/memory.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

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

// A d x 3 block of an edge, by columns; for 6 with the first two rows once more below, for 9 the ninth rows together.
template <int D>
struct Edge {
  V8 a[3];
  V8 b;
};
template <>
struct Edge<6> {
  V8 a[3];
};

// Registers that a column of six rows fills: AVX-512 works on the whole of it, with two rows that mean nothing, as what
// its products need is stored in half as many pieces then.
#if defined(__AVX512F__)
constexpr int kStride6 = 8;
#else
constexpr int kStride6 = 6;
#endif

// A d x d block: for 6 its numbers by columns, for 9 eight rows by columns and the ninth row.
template <int D>
struct Block {
  V8 col[9];
  V8 row;
  double corner;
  double pad[7];
};
template <>
struct alignas(8 * (kStride6 == 8 ? 8 : 4)) Block<6> {
  double v[6 * kStride6];
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

#if !defined(__AVX512F__)
// Two columns of six rows are three registers of four: rows 0 to 3 of the first, 4 and 5 of the first and 0 and 1 of
// the second, 2 to 5 of the second. So products of 6 x 6 blocks leave no lane empty.
BA_INLINE Native4 load4(const double* p) { return Loaded<Native4>::from(p); }
BA_INLINE void store4(double* p, Native4 v) { std::memcpy(p, &v, sizeof(v)); }
// a, a, b, b for registers full of a and of b.
BA_INLINE Native4 halves(Native4 a, Native4 b) {
#if defined(__AVX__)
  // Not a shuffle, which g++ makes of the two numbers anew.
  return reinterpret_cast<Native4>(_mm256_blend_pd(reinterpret_cast<__m256d>(a), reinterpret_cast<__m256d>(b), 12));
#else
  return Native4{a[0], a[1], b[2], b[3]};
#endif
}
struct Pair {
  Native4 top, middle, bottom;

  BA_INLINE static Pair of(const double* v) { return {load4(v), load4(v + 4), load4(v + 8)}; }
  BA_INLINE void store(double* v) const {
    store4(v, top);
    store4(v + 4, middle);
    store4(v + 8, bottom);
  }
  // Less a column times each of two numbers. column: rows 0 to 3, then 4, 5, 0, 1, then 2 to 5.
  BA_INLINE void subtract(const Pair& column, const double* numbers) {
    const Native4 first = Splat<Native4>::of(numbers[0]), second = Splat<Native4>::of(numbers[1]);
    top -= column.top * first;
    middle -= column.middle * halves(first, second);
    bottom -= column.bottom * second;
  }
};

#endif

// x of products x y' with many y, as far as it fits into registers.
template <int D>
struct Left;
#if defined(__AVX512F__)
template <>
struct Left<6> {
  BA_INLINE explicit Left(const Edge<6>& x) : a{x.a[0], x.a[1], x.a[2]} {}
  V8 a[3];
};
#else
template <>
struct Left<6> {
  BA_INLINE explicit Left(const Edge<6>& x) {
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
      const double* v = reinterpret_cast<const double*>(&x.a[i]);
      column[i] = {load4(v), load4(v + 4), load4(v + 2)};
    }
  }
  Pair column[3];
};
#endif
template <>
struct Left<9> {
  BA_INLINE explicit Left(const Edge<9>& x) : a{x.a[0], x.a[1], x.a[2]}, b(reinterpret_cast<const double*>(&x.b)) {}
  V8 a[3];
  const double* b;
};

// s -= x y'.
#if defined(__AVX512F__)
BA_INLINE void subtract_product(Block<6>& s, const Left<6>& x, const Edge<6>& y) {
#pragma GCC unroll 6
  for (int c = 0; c < 6; ++c) {
    V8 column = load(&s.v[kStride6 * c]);
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) column -= x.a[i] * reinterpret_cast<const double*>(&y.a[i])[c];
    std::memcpy(&s.v[kStride6 * c], &column, sizeof(column));
  }
}
#else
BA_INLINE void subtract_product(Block<6>& s, const Left<6>& x, const Edge<6>& y) {
#pragma GCC unroll 3
  for (int c = 0; c < 6; c += 2) {
    Pair pair = Pair::of(&s.v[6 * c]);
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) pair.subtract(x.column[i], reinterpret_cast<const double*>(&y.a[i]) + c);
    pair.store(&s.v[6 * c]);
  }
}
#endif

BA_INLINE void subtract_product(Block<9>& s, const Left<9>& x, const Edge<9>& y) {
#pragma GCC unroll 8
  for (int c = 0; c < 8; ++c) s.col[c] = s.col[c] - x.a[0] * y.a[0][c] - x.a[1] * y.a[1][c] - x.a[2] * y.a[2][c];
  s.col[8] = s.col[8] - x.a[0] * y.b[0] - x.a[1] * y.b[1] - x.a[2] * y.b[2];
  s.row = s.row - y.a[0] * x.b[0] - y.a[1] * x.b[1] - y.a[2] * x.b[2];
  s.corner -= x.b[0] * y.b[0] + x.b[1] * y.b[1] + x.b[2] * y.b[2];
}

// Whether there are registers enough for two products with one factor in common: what is loaded of it serves both.
constexpr bool kProductsByTwo = kWhole;

// s -= x z', t -= y z'.
#if defined(__AVX512F__)
BA_INLINE void subtract_products(Block<6>& s, Block<6>& t, const Left<6>& x, const Left<6>& y, const Edge<6>& z) {
#pragma GCC unroll 6
  for (int c = 0; c < 6; ++c) {
    V8 first = load(&s.v[kStride6 * c]), second = load(&t.v[kStride6 * c]);
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
      const V8 factor = splat(reinterpret_cast<const double*>(&z.a[i])[c]);
      first -= x.a[i] * factor;
      second -= y.a[i] * factor;
    }
    std::memcpy(&s.v[kStride6 * c], &first, sizeof(first));
    std::memcpy(&t.v[kStride6 * c], &second, sizeof(second));
  }
}

BA_INLINE void subtract_products(Block<9>& s, Block<9>& t, const Left<9>& x, const Left<9>& y, const Edge<9>& z) {
#pragma GCC unroll 9
  for (int c = 0; c < 9; ++c) {
    V8 first = s.col[c], second = t.col[c];
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
      const V8 factor = splat(c < 8 ? reinterpret_cast<const double*>(&z.a[i])[c] : z.b[i]);
      first -= x.a[i] * factor;
      second -= y.a[i] * factor;
    }
    s.col[c] = first;
    t.col[c] = second;
  }
  V8 first = s.row, second = t.row;
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i) {
    first -= z.a[i] * x.b[i];
    second -= z.a[i] * y.b[i];
  }
  s.row = first;
  t.row = second;
  s.corner -= x.b[0] * z.b[0] + x.b[1] * z.b[1] + x.b[2] * z.b[2];
  t.corner -= y.b[0] * z.b[0] + y.b[1] * z.b[1] + y.b[2] * z.b[2];
}
#else
template <int D>
BA_INLINE void subtract_products(Block<D>& s, Block<D>& t, const Left<D>& x, const Left<D>& y, const Edge<D>& z) {
  subtract_product(s, x, z);
  subtract_product(t, y, z);
}
#endif

// c -= a b'.
#if defined(__AVX512F__)
inline void subtract_transposed(Block<6>& c, const Block<6>& a, const Block<6>& b) {
  V8 out[6];
#pragma GCC unroll 6
  for (int j = 0; j < 6; ++j) out[j] = load(&c.v[kStride6 * j]);
#pragma GCC unroll 6
  for (int m = 0; m < 6; ++m) {
    const V8 column = load(&a.v[kStride6 * m]);
#pragma GCC unroll 6
    for (int j = 0; j < 6; ++j) out[j] -= column * b.v[kStride6 * m + j];
  }
#pragma GCC unroll 6
  for (int j = 0; j < 6; ++j) std::memcpy(&c.v[kStride6 * j], &out[j], sizeof(out[j]));
}
#else
inline void subtract_transposed(Block<6>& c, const Block<6>& a, const Block<6>& b) {
  Pair out[3] = {Pair::of(c.v), Pair::of(c.v + 12), Pair::of(c.v + 24)};
#pragma GCC unroll 6
  for (int m = 0; m < 6; ++m) {
    const Native4 top = load4(&a.v[6 * m]), bottom = load4(&a.v[6 * m + 2]);
    const Pair column{top, BA_SHUFFLE(Native4Mask, bottom, top, 2, 3, 4, 5), bottom};
#pragma GCC unroll 3
    for (int j = 0; j < 3; ++j) out[j].subtract(column, &b.v[6 * m + 2 * j]);
  }
  for (int j = 0; j < 3; ++j) out[j].store(c.v + 12 * j);
}
#endif

inline void subtract_transposed(Block<9>& c, const Block<9>& a, const Block<9>& b) {
  const double *a_row = reinterpret_cast<const double*>(&a.row), *b_row = reinterpret_cast<const double*>(&b.row);
  V8 bottom = c.row;
  double corner = c.corner;
  for (int m = 0; m < 9; ++m) {
    const double low_a = m < 8 ? a_row[m] : a.corner, low_b = m < 8 ? b_row[m] : b.corner;
    bottom -= b.col[m] * low_a;
    corner -= low_a * low_b;
  }
  // As many rows at a time as leave room for their nine columns.
  constexpr int kRows = sizeof(Register) / sizeof(double);
  for (int first = 0; first < 8; first += kRows) {
    Register acc[9];
    for (int j = 0; j < 9; ++j) acc[j] = Loaded<Register>::from(reinterpret_cast<const double*>(&c.col[j]) + first);
    for (int m = 0; m < 9; ++m) {
      const Register left = Loaded<Register>::from(reinterpret_cast<const double*>(&a.col[m]) + first);
      const double* row = reinterpret_cast<const double*>(&b.col[m]);
#pragma GCC unroll 8
      for (int j = 0; j < 8; ++j) acc[j] -= left * row[j];
      acc[8] -= left * (m < 8 ? b_row[m] : b.corner);
    }
    for (int j = 0; j < 9; ++j) std::memcpy(reinterpret_cast<double*>(&c.col[j]) + first, &acc[j], sizeof(Register));
  }
  c.row = bottom;
  c.corner = corner;
}

inline double entry(const Block<6>& s, int r, int c) { return s.v[kStride6 * c + r]; }
inline double entry(const Block<9>& s, int r, int c) {
  if (r == 8) return c == 8 ? s.corner : s.row[c];
  return s.col[c][r];
}

inline void set_entry(Block<6>& s, int r, int c, double value) { s.v[kStride6 * c + r] = value; }
inline void set_entry(Block<9>& s, int r, int c, double value) {
  if (r == 8 && c == 8) {
    s.corner = value;
  } else if (r == 8) {
    s.row[c] = value;
  } else {
    s.col[c][r] = value;
  }
}

// Columns or blocks.
template <class T>
inline void add(T& to, const T& x) {
  double* sum = reinterpret_cast<double*>(&to);
  const double* other = reinterpret_cast<const double*>(&x);
  for (std::size_t i = 0; i < sizeof(x) / sizeof(double); ++i) sum[i] += other[i];
}

// y += b x or y -= b x, by the sign.
template <int kSign, int D>
inline void add_multiplied(const Block<D>& b, const double* x, double* y) {
  for (int c = 0; c < D; ++c)
    for (int r = 0; r < D; ++r) y[r] += kSign * entry(b, r, c) * x[c];
}
// The same with b'.
template <int kSign, int D>
inline void add_multiplied_transposed(const Block<D>& b, const double* x, double* y) {
  for (int c = 0; c < D; ++c) {
    double total = 0;
    for (int r = 0; r < D; ++r) total += entry(b, r, c) * x[r];
    y[c] += kSign * total;
  }
}

// Symmetric block times column.
inline Column<6> multiply(const Block<6>& b, const Column<6>& x) {
  double out[kLanes] = {};
  for (int c = 0; c < 6; ++c)
    for (int r = 0; r < 6; ++r) out[r] += b.v[kStride6 * c + r] * x.a[c];
  return {load(out)};
}
inline Column<9> multiply(const Block<9>& b, const Column<9>& x) {
  Column<9> out;
  out.a = b.col[8] * x.b;
  for (int c = 0; c < 8; ++c) out.a += b.col[c] * x.a[c];
  out.b = sum(b.col[8] * x.a) + b.corner * x.b;
  return out;
}

template <int D>
inline void write_block(const Block<D>& s, double* out, std::int64_t stride) {
  for (int c = 0; c < D; ++c)
    for (int r = 0; r < D; ++r) out[r * stride + c] = entry(s, r, c);
}

template <int D>
inline void write_transposed(const Block<D>& s, double* out, std::int64_t stride) {
  for (int c = 0; c < D; ++c)
    for (int r = 0; r < D; ++r) out[c * stride + r] = entry(s, r, c);
}

}  // namespace ba::BA_TARGET
