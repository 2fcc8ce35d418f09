// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Eight doubles at once: one register with AVX-512, two with AVX, four with SSE2 or NEON.
#pragma once

#if defined(__AVX__)
#include <immintrin.h>
#endif

#include <cmath>
#include <cstring>

#include "simd/target.hpp"

namespace ba::BA_TARGET {

using Native2 = double __attribute__((vector_size(16)));
using Native4 = double __attribute__((vector_size(32)));
using Native8 = double __attribute__((vector_size(64)));
using Native2Mask = long long __attribute__((vector_size(16)));  // a lane is 0 or -1
using Native4Mask = long long __attribute__((vector_size(32)));
using Native8Mask = long long __attribute__((vector_size(64)));

#define BA_INLINE [[gnu::always_inline]] inline

// Lanes of two registers by number, those of b after those of a.
#if defined(__clang__)
#define BA_SHUFFLE(mask, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define BA_SHUFFLE(mask, a, b, ...) __builtin_shuffle(a, b, mask{__VA_ARGS__})
#endif

// Two masks as one of twice the lanes.
template <class H>
struct TwiceMask {
  H lo, hi;

  TwiceMask() = default;
  BA_INLINE TwiceMask(const H& l, const H& h) : lo(l), hi(h) {}
  BA_INLINE TwiceMask(const TwiceMask& m) : lo(m.lo), hi(m.hi) {}
  BA_INLINE TwiceMask& operator=(const TwiceMask& m) {
    lo = m.lo;
    hi = m.hi;
    return *this;
  }
  BA_INLINE friend TwiceMask operator&(TwiceMask a, TwiceMask b) { return {a.lo & b.lo, a.hi & b.hi}; }
  BA_INLINE friend TwiceMask operator|(TwiceMask a, TwiceMask b) { return {a.lo | b.lo, a.hi | b.hi}; }
  BA_INLINE friend TwiceMask operator~(TwiceMask a) { return {~a.lo, ~a.hi}; }
  BA_INLINE TwiceMask& operator&=(TwiceMask b) { return *this = *this & b; }
};

// Two registers as one of twice the lanes. Compilers split wider vectors than the machine has into single numbers
// where lanes are compared, chosen or exchanged; this does not. Copies are spelt out, as those of a plain struct go by
// pieces of 16 bytes, and a register that is then read from them waits until they have left the store buffer.
template <class H, class M>
struct Twice {
  using Compared = TwiceMask<M>;
  H lo, hi;

  Twice() = default;
  BA_INLINE Twice(const H& l, const H& h) : lo(l), hi(h) {}
  BA_INLINE Twice(const Twice& v) : lo(v.lo), hi(v.hi) {}
  BA_INLINE Twice& operator=(const Twice& v) {
    lo = v.lo;
    hi = v.hi;
    return *this;
  }
  BA_INLINE double& operator[](int lane) { return reinterpret_cast<double*>(this)[lane]; }
  BA_INLINE double operator[](int lane) const { return reinterpret_cast<const double*>(this)[lane]; }

  BA_INLINE friend Twice operator-(const Twice& a) { return {-a.lo, -a.hi}; }
#define BA_ARITHMETIC(op)                                                                                     \
  BA_INLINE friend Twice operator op(const Twice& a, const Twice& b) { return {a.lo op b.lo, a.hi op b.hi}; } \
  BA_INLINE friend Twice operator op(double a, const Twice& b) { return {a op b.lo, a op b.hi}; }             \
  BA_INLINE friend Twice operator op(const Twice& a, double b) { return {a.lo op b, a.hi op b}; }             \
  BA_INLINE Twice& operator op## = (const Twice& b) { return *this = *this op b; }                            \
  BA_INLINE Twice& operator op## = (double b) { return *this = *this op b; }
  BA_ARITHMETIC(+)
  BA_ARITHMETIC(-)
  BA_ARITHMETIC(*)
  BA_ARITHMETIC(/)
#undef BA_ARITHMETIC
#define BA_COMPARISON(op)                                                                                        \
  BA_INLINE friend Compared operator op(const Twice& a, const Twice& b) { return {a.lo op b.lo, a.hi op b.hi}; } \
  BA_INLINE friend Compared operator op(const Twice& a, double b) { return {a.lo op b, a.hi op b}; }
  BA_COMPARISON(<)
  BA_COMPARISON(<=)
  BA_COMPARISON(>)
  BA_COMPARISON(==)
  BA_COMPARISON(!=)
#undef BA_COMPARISON
};

// Register: the widest that the machine has, of four lanes at least.
#if defined(__AVX512F__)
using Register = Native8;
using V8 = Native8;
using Mask = Native8Mask;
#elif defined(__AVX__)
using Register = Native4;
using V8 = Twice<Native4, Native4Mask>;
using Mask = TwiceMask<Native4Mask>;
#else
using Register = Native4;
using V8 = Twice<Twice<Native2, Native2Mask>, TwiceMask<Native2Mask>>;
using Mask = TwiceMask<TwiceMask<Native2Mask>>;
#endif

// Whether eight lanes are one register. Where they are two there are half as many to work with, and what is chosen
// between goes through memory.
constexpr bool kWhole = sizeof(Register) == sizeof(V8);

// Register by register: a copy of the whole goes through memory.
template <class V>
struct Loaded {
  BA_INLINE static V from(const double* p) {
    V out;
    std::memcpy(&out, p, sizeof(out));
    return out;
  }
};
template <class H, class M>
struct Loaded<Twice<H, M>> {
  BA_INLINE static Twice<H, M> from(const double* p) {
    return {Loaded<H>::from(p), Loaded<H>::from(p + sizeof(H) / sizeof(double))};
  }
};
BA_INLINE V8 load(const double* p) { return Loaded<V8>::from(p); }

// A number that stays in its register: where others are scarce g++ would load it anew for each product that it is in,
// and products would wait for loads. kHeld: whether it can be told so.
#if defined(__AVX__)
constexpr bool kHeld = true;
BA_INLINE Register held(Register v) {
  asm("" : "+v"(v));
  return v;
}
#else
constexpr bool kHeld = false;
BA_INLINE Register held(Register v) { return v; }
#endif

// The numbers f(0), f(1), ... by lane. What is stored number by number and read as a register waits for the stores.
template <class V>
struct Each;
template <>
struct Each<Native2> {
  template <class F>
  BA_INLINE static Native2 of(F f) {
    return Native2{f(0), f(1)};
  }
};
template <>
struct Each<Native4> {
  template <class F>
  BA_INLINE static Native4 of(F f) {
    return Native4{f(0), f(1), f(2), f(3)};
  }
};
template <>
struct Each<Native8> {
  template <class F>
  BA_INLINE static Native8 of(F f) {
    return Native8{f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)};
  }
};
template <class H, class M>
struct Each<Twice<H, M>> {
  template <class F>
  BA_INLINE static Twice<H, M> of(F f) {
    constexpr int kHalf = sizeof(H) / sizeof(double);
    return {Each<H>::of(f), Each<H>::of([&f](int l) { return f(kHalf + l); })};
  }
};
template <class F>
BA_INLINE V8 each(F f) {
  return Each<V8>::of(f);
}

// The same number in all lanes.
template <class V>
struct Splat;
template <>
struct Splat<Native2> {
  BA_INLINE static Native2 of(double x) { return Native2{x, x}; }
};
template <>
struct Splat<Native4> {
  BA_INLINE static Native4 of(double x) { return Native4{x, x, x, x}; }
};
template <>
struct Splat<Native8> {
  BA_INLINE static Native8 of(double x) { return Native8{x, x, x, x, x, x, x, x}; }
};
template <class H, class M>
struct Splat<Twice<H, M>> {
  BA_INLINE static Twice<H, M> of(double x) { return {Splat<H>::of(x), Splat<H>::of(x)}; }
};
BA_INLINE V8 splat(double x) { return Splat<V8>::of(x); }

// What stands for each lane: of a where m is set, else of b. m ? a : b, which has no overload for Twice.
BA_INLINE Native2 select(Native2Mask m, Native2 a, Native2 b) { return m ? a : b; }
BA_INLINE Native4 select(Native4Mask m, Native4 a, Native4 b) { return m ? a : b; }
BA_INLINE Native8 select(Native8Mask m, Native8 a, Native8 b) { return m ? a : b; }
template <class H, class M>
BA_INLINE Twice<H, M> select(const TwiceMask<M>& m, const Twice<H, M>& a, const Twice<H, M>& b) {
  return {select(m.lo, a.lo, b.lo), select(m.hi, a.hi, b.hi)};
}

BA_INLINE V8 maximum(const V8& a, const V8& b) { return select(a > b, a, b); }
BA_INLINE V8 magnitude(const V8& v) { return select(v < 0.0, -v, v); }

template <class V>
BA_INLINE V root_of(V v) {
  V out{};
  for (int l = 0; l < static_cast<int>(sizeof(V) / sizeof(double)); ++l) out[l] = std::sqrt(v[l]);
  return out;
}
BA_INLINE Native2 root(Native2 v) { return root_of(v); }
BA_INLINE Native4 root(Native4 v) { return root_of(v); }
BA_INLINE Native8 root(Native8 v) { return root_of(v); }
template <class H, class M>
BA_INLINE Twice<H, M> root(const Twice<H, M>& v) {
  return {root(v.lo), root(v.hi)};
}

// log(1 + x) of numbers that are not negative, to some 1e-15 of the value; NaN stays NaN. 1 + x = 2^e m, and with
// f = (m - 1) / (m + 1) log(m) = 2 (f + f^3/3 + f^5/5 + ...); m lies between sqrt(1/2) and sqrt(2), so |f| < 0.172.
template <class V, class I>
BA_INLINE V log1p_of(const V& x) {
  constexpr long long kOne = 0x3ff0000000000000, kFraction = 0x000fffffffffffff;
  const V whole = 1.0 + x;
  I bits;
  std::memcpy(&bits, &whole, sizeof(bits));
  const I rounded = bits + (kOne - 0x3fe6a09e667f3bcd);  // from sqrt(1/2) on, the next power of two counts
  const I power = (rounded >> 52) - 1023;
  const I scaled = (rounded & kFraction) + 0x3fe6a09e667f3bcd;
  V m;
  std::memcpy(&m, &scaled, sizeof(m));
  // Without a power the sum need not be rounded.
  const V above = power == 0 ? x : m - 1.0;
  const V f = above / (2.0 + above), s = f * f;
  V series = s * (1.0 / 21.0) + 1.0 / 19.0;
  for (int odd = 17; odd >= 1; odd -= 2) series = series * s + 1.0 / odd;
  const V sum = __builtin_convertvector(power, V) * 0.6931471805599453 + 2.0 * f * series;
  return x < 1e300 ? sum : x;
}
BA_INLINE Native2 log1p(Native2 x) { return log1p_of<Native2, Native2Mask>(x); }
BA_INLINE Native4 log1p(Native4 x) { return log1p_of<Native4, Native4Mask>(x); }
BA_INLINE Native8 log1p(Native8 x) { return log1p_of<Native8, Native8Mask>(x); }
template <class H, class M>
BA_INLINE Twice<H, M> log1p(const Twice<H, M>& x) {
  return {log1p(x.lo), log1p(x.hi)};
}

BA_INLINE bool any(Native2Mask m) { return (m[0] | m[1]) != 0; }
#if defined(__AVX__)
BA_INLINE bool any(Native4Mask m) { return _mm256_movemask_pd(reinterpret_cast<__m256d>(m)) != 0; }
#endif
#if defined(__AVX512F__)
BA_INLINE bool any(Native8Mask m) {
  return _mm512_test_epi64_mask(reinterpret_cast<__m512i>(m), reinterpret_cast<__m512i>(m)) != 0;
}
#endif
template <class H>
BA_INLINE bool any(const TwiceMask<H>& m) {
  return any(m.lo | m.hi);
}

BA_INLINE double sum(const V8& v) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }

// What sums of products are kept in where there are many: eight lanes, or four that each stand for two, for half the
// memory.
#if defined(__AVX512F__)
using Folded = V8;
BA_INLINE void add_product(Folded& to, const V8& a, const V8& b) { to += a * b; }
#else
using Folded = decltype(V8::lo);
BA_INLINE void add_product(V8& to, const V8& a, const V8& b) { to += a * b; }
BA_INLINE void add_product(Folded& to, const V8& a, const V8& b) {
  to += a.lo * b.lo;
  to += a.hi * b.hi;
}
BA_INLINE double sum(const Folded& v) { return (v[0] + v[1]) + (v[2] + v[3]); }
#endif

// Rows become columns.
BA_INLINE void transpose(Native2 (&r)[2]) {
  const Native2 first = BA_SHUFFLE(Native2Mask, r[0], r[1], 0, 2);
  r[1] = BA_SHUFFLE(Native2Mask, r[0], r[1], 1, 3);
  r[0] = first;
}

BA_INLINE void transpose(Native4 (&r)[4]) {
  Native4 t[4];
  for (int i = 0; i < 4; i += 2) {
    t[i] = BA_SHUFFLE(Native4Mask, r[i], r[i + 1], 0, 4, 2, 6);
    t[i + 1] = BA_SHUFFLE(Native4Mask, r[i], r[i + 1], 1, 5, 3, 7);
  }
  for (int i = 0; i < 2; ++i) {
    r[i] = BA_SHUFFLE(Native4Mask, t[i], t[i + 2], 0, 1, 4, 5);
    r[i + 2] = BA_SHUFFLE(Native4Mask, t[i], t[i + 2], 2, 3, 6, 7);
  }
}

BA_INLINE void transpose(Native8 (&r)[8]) {
  Native8 t[8], q[8];
  for (int i = 0; i < 8; i += 2) {
    t[i] = BA_SHUFFLE(Native8Mask, r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    t[i + 1] = BA_SHUFFLE(Native8Mask, r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4) {
    for (int j = 0; j < 2; ++j) {
      q[i + j] = BA_SHUFFLE(Native8Mask, t[i + j], t[i + j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      q[i + j + 2] = BA_SHUFFLE(Native8Mask, t[i + j], t[i + j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  }
  for (int i = 0; i < 4; ++i) {
    r[i] = BA_SHUFFLE(Native8Mask, q[i], q[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[i + 4] = BA_SHUFFLE(Native8Mask, q[i], q[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

// The sum of the lanes of each, by lane; the last two lanes are zero.
#if defined(__AVX512F__)
BA_INLINE Native8 lane_sums(const Native8 (&x)[6]) {
  Native8 pair[4] = {};
#pragma GCC unroll 3
  for (int i = 0; i < 3; ++i)
    pair[i] = BA_SHUFFLE(Native8Mask, x[2 * i], x[2 * i + 1], 0, 8, 2, 10, 4, 12, 6, 14) +
              BA_SHUFFLE(Native8Mask, x[2 * i], x[2 * i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  Native8 four[2];
#pragma GCC unroll 2
  for (int i = 0; i < 2; ++i)
    four[i] = BA_SHUFFLE(Native8Mask, pair[2 * i], pair[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13) +
              BA_SHUFFLE(Native8Mask, pair[2 * i], pair[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
  return BA_SHUFFLE(Native8Mask, four[0], four[1], 0, 1, 2, 3, 8, 9, 10, 11) +
         BA_SHUFFLE(Native8Mask, four[0], four[1], 4, 5, 6, 7, 12, 13, 14, 15);
}
#else
BA_INLINE V8 lane_sums(const V8 (&x)[6]) {
  V8 out{};
  for (int i = 0; i < 6; ++i) out[i] = sum(x[i]);
  return out;
}
#endif

// By four blocks: those off the diagonal change places.
template <class H, class M, int N>
BA_INLINE void transpose(Twice<H, M> (&r)[N]) {
  constexpr int kHalf = N / 2;
  H section[2][2][kHalf];
#pragma GCC unroll 2
  for (int i = 0; i < 2; ++i) {
#pragma GCC unroll 4
    for (int j = 0; j < kHalf; ++j) {
      section[i][0][j] = r[i * kHalf + j].lo;
      section[i][1][j] = r[i * kHalf + j].hi;
    }
    transpose(section[i][0]);
    transpose(section[i][1]);
  }
#pragma GCC unroll 2
  for (int i = 0; i < 2; ++i)
#pragma GCC unroll 4
    for (int j = 0; j < kHalf; ++j) r[i * kHalf + j] = {section[0][i][j], section[1][i][j]};
}

}  // namespace ba::BA_TARGET
