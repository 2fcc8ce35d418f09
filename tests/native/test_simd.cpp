// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <cmath>
#include <limits>

#include "check.hpp"
#include "linalg/blocks.hpp"
#include "parallel/memory.hpp"
#include "simd/simd.hpp"

using namespace ba;
using namespace ba::BA_TARGET;

namespace {

V8 numbers(double first, double step) {
  return each([=](int l) { return first + step * l; });
}

}  // namespace

TEST(lanes_are_loaded_and_set_in_order) {
  alignas(64) const double from[8] = {3, 1, 4, 1, 5, 9, 2, 6};
  const V8 loaded = load(from), counted = numbers(10, 2), same = splat(7);
  for (int l = 0; l < kLanes; ++l) {
    CHECK_NEAR(loaded[l], from[l], 0);
    CHECK_NEAR(counted[l], 10 + 2 * l, 0);
    CHECK_NEAR(same[l], 7, 0);
  }
  CHECK_NEAR(sum(loaded), 31, 0);
}

TEST(lanes_of_six_are_summed_at_once) {
  V8 x[6];
  for (int i = 0; i < 6; ++i) x[i] = numbers(1 + 10 * i, 0.25 * i);
  const V8 sums = lane_sums(x);
  for (int i = 0; i < 8; ++i) CHECK_NEAR(sums[i], i < 6 ? 8 * (1 + 10 * i) + 0.25 * i * 28 : 0, 0);
}

TEST(arithmetic_goes_lane_by_lane) {
  const V8 a = numbers(1, 1), b = numbers(-3, 0.5);
  V8 c = a;
  c *= b;
  c -= 2 * a;
  for (int l = 0; l < kLanes; ++l) {
    const double x = 1 + l, y = -3 + 0.5 * l;
    CHECK_NEAR((a + b * 2 - a / b)[l], x + y * 2 - x / y, y == 0 ? std::numeric_limits<double>::quiet_NaN() : 1e-14);
    CHECK_NEAR(c[l], x * y - 2 * x, 1e-14);
    CHECK_NEAR((-a)[l], -x, 0);
    if (l == 5) break;  // the next divides by zero
  }
}

TEST(masks_select_lanes) {
  const V8 a = numbers(0, 1), b = splat(3.5);
  const V8 smaller = select(a < b, a, b), larger = maximum(a, b), size = magnitude(a - b);
  for (int l = 0; l < kLanes; ++l) {
    CHECK_NEAR(smaller[l], l < 4 ? l : 3.5, 0);
    CHECK_NEAR(larger[l], l < 4 ? 3.5 : l, 0);
    CHECK_NEAR(size[l], std::abs(l - 3.5), 0);
  }
  CHECK(any(a == 7.0));
  CHECK(!any(a == 8.0));
  CHECK(!any((a < 2.0) & (a > 5.0)));
  CHECK(any((a < 0.0) | ~(a != 6.0)));
}

TEST(comparison_with_what_is_not_a_number_is_false) {
  const V8 a = each([](int l) { return l == 6 ? std::numeric_limits<double>::quiet_NaN() : 1.0; });
  CHECK(!any((a < 0.0) | (a > 2.0)));
  const V8 kept = select(a <= 1.0, a, splat(-1.0));
  CHECK_NEAR(kept[6], -1, 0);
  CHECK_NEAR(kept[5], 1, 0);
}

TEST(roots_and_logarithms_are_those_of_the_library) {
  for (const double first : {0.0, 1e-300, 1e-9, 0.3, 1.0, 41.0, 1e9, 1e299}) {
    const V8 x = numbers(first, first / 3), r = root(x), l1 = log1p(x);
    for (int l = 0; l < kLanes; ++l) {
      const double v = first + first / 3 * l;
      CHECK_NEAR(r[l], std::sqrt(v), 0);
      CHECK_NEAR(l1[l], std::log1p(v), 2e-15 * std::log1p(v));
    }
  }
}

TEST(transposition_turns_rows_into_columns) {
  V8 r[8];
  for (int i = 0; i < 8; ++i) r[i] = numbers(10 * i, 1);
  transpose(r);
  for (int i = 0; i < 8; ++i)
    for (int l = 0; l < kLanes; ++l) CHECK_NEAR(r[i][l], 10 * l + i, 0);
}

TEST(buffers_are_aligned_for_registers) {
  std::vector<Buffer<double>> kept;
  for (std::size_t n : {1, 7, 8, 9, 1000, 70000}) {
    kept.emplace_back(n, 2.5);
    CHECK(reinterpret_cast<std::uintptr_t>(kept.back().data()) % 64 == 0);
  }
  for (const Buffer<double>& buffer : kept)
    for (double x : buffer) CHECK_NEAR(x, 2.5, 0);
}

namespace {

// Entry of an edge's block Z, and of a block of S.
template <int D>
double entry_of(const Edge<D>& z, int r, int i) {
  if constexpr (D == 9) {
    if (r == 8) return z.b[i];
  }
  return z.a[i][r];
}

template <int D>
Edge<D> edge(double first) {
  Edge<D> z{};
  for (int i = 0; i < 3; ++i)
    for (int r = 0; r < kLanes; ++r) z.a[i][r] = std::sin(first + 3 * (D == 6 ? r % 6 : r) + i);
  if constexpr (D == 9)
    for (int i = 0; i < 3; ++i) z.b[i] = std::sin(first + 24 + i);
  return z;
}

template <int D>
Block<D> block(double first) {
  Block<D> s;
  clear(&s, 1);
  for (int r = 0; r < D; ++r)
    for (int c = 0; c < D; ++c) set_entry(s, r, c, std::cos(first + r * D + c));
  return s;
}

template <int D>
void products_of_blocks() {
  const Edge<D> x = edge<D>(0.3), y = edge<D>(1.7);
  const Block<D> a = block<D>(0.1), b = block<D>(2.2), before = block<D>(5.0);
  Block<D> outer = before, turned = before;
  subtract_product(outer, Left<D>(x), y);
  subtract_transposed(turned, a, b);
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      double by_edges = entry(before, r, c), by_blocks = by_edges;
      for (int i = 0; i < 3; ++i) by_edges -= entry_of(x, r, i) * entry_of(y, c, i);
      for (int m = 0; m < D; ++m) by_blocks -= entry(a, r, m) * entry(b, c, m);
      CHECK_NEAR(entry(outer, r, c), by_edges, 1e-14);
      CHECK_NEAR(entry(turned, r, c), by_blocks, 1e-14);
    }
  }
}

}  // namespace

TEST(products_of_blocks_are_those_of_their_entries) {
  products_of_blocks<6>();
  products_of_blocks<9>();
}
