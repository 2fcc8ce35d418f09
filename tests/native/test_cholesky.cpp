// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <limits>

#include "check.hpp"
#include "linalg/cholesky.hpp"
#include "linalg/sparse_cholesky.hpp"
#include "matrices.hpp"

using namespace ba;
using namespace ba::BA_TARGET;

namespace {

constexpr FillLimits kNoLimits{std::int64_t{1} << 40, 1e300};

// The solution by dense Cholesky; empty if S is not positive definite.
std::vector<double> solve_dense(const std::vector<double>& s, const std::vector<double>& b, int threads) {
  const auto n = static_cast<std::int64_t>(b.size());
  Pool pool(threads);
  DenseCholesky cholesky;
  cholesky.resize(n);
  for (std::int64_t i = 0; i < n; ++i)
    for (std::int64_t j = 0; j <= i; ++j) cholesky.at(i, j) = s[i * n + j];
  if (!cholesky.factor(pool)) return {};
  std::vector<double> x = b;
  cholesky.solve(x.data());
  return x;
}

template <int D>
void solve_sparse(std::int64_t n, std::int64_t band, bool arrow) {
  const std::vector<double> s = matrices::dense(n, D, band, arrow, 3), x = matrices::vector(n * D, 4);
  const matrices::Blocks<D> blocks(s, n);
  SparseCholesky<D> cholesky(blocks.pattern, kNoLimits);
  CHECK(cholesky.fill().complete);
  CHECK(cholesky.factor(blocks.blocks.data()));
  std::vector<double> found = matrices::times(s, x);
  cholesky.solve(found.data());
  CHECK_NEAR(matrices::distance(found, x), 0, 1e-12);
}

}  // namespace

TEST(dense_cholesky_solves_systems_of_any_size) {
  for (const std::int64_t n : {1, 2, 7, 8, 9, 16, 31, 32, 33, 64, 100, 151}) {
    const std::vector<double> s = matrices::dense(n, 1, n, false, n), x = matrices::vector(n, 1);
    CHECK_NEAR(matrices::distance(solve_dense(s, matrices::times(s, x), 1), x), 0, 1e-12);
  }
}

TEST(dense_cholesky_gives_the_same_bits_with_any_number_of_threads) {
  const std::vector<double> s = matrices::dense(201, 1, 201, false, 9), b = matrices::vector(201, 2);
  const std::vector<double> one = solve_dense(s, b, 1);
  for (const int threads : {2, 3, 5}) CHECK_NEAR(matrices::distance(solve_dense(s, b, threads), one), 0, 0);
}

TEST(dense_cholesky_refuses_what_is_not_positive_definite) {
  for (const std::int64_t at : {0, 5, 40}) {
    for (const double pivot : {-1.0, 0.0, std::numeric_limits<double>::quiet_NaN()}) {
      std::vector<double> s = matrices::dense(41, 1, 0, false, 5);
      s[at * 41 + at] = pivot;
      CHECK(solve_dense(s, matrices::vector(41, 1), 2).empty());
    }
  }
}

TEST(sparse_cholesky_solves_bands_arrows_and_full_systems) {
  for (const std::int64_t n : {1, 2, 5, 12}) {
    for (const std::int64_t band : {0, 1, 3, 12}) {
      solve_sparse<6>(n, band, false);
      solve_sparse<6>(n, band, true);
      solve_sparse<9>(n, band, true);
    }
  }
}

TEST(no_order_takes_fewer_operations_than_one_that_fills_nothing) {
  // A band, and an arrow to the last keyframe.
  const Fill band = find_fill(matrices::Blocks<6>(matrices::dense(9, 6, 2, false, 1), 9).pattern, kNoLimits);
  for (std::int32_t k = 0; k < 9; ++k) CHECK(band.order[k] == k);
  CHECK(band.blocks == 9 + 8 + 7);
  CHECK_NEAR(band.products, 7 * 5 + 2, 0);
  const Fill arrow = find_fill(matrices::Blocks<6>(matrices::dense(9, 6, 0, true, 1), 9).pattern, kNoLimits);
  CHECK(arrow.blocks == 9 + 8);
  CHECK_NEAR(arrow.products, 8 * 2, 0);
}

TEST(sparse_cholesky_factors_again_with_other_numbers) {
  const matrices::Blocks<6> first(matrices::dense(8, 6, 2, true, 1), 8);
  const std::vector<double> s = matrices::dense(8, 6, 2, true, 2), x = matrices::vector(48, 3);
  const matrices::Blocks<6> second(s, 8);
  SparseCholesky<6> cholesky(first.pattern, kNoLimits);
  CHECK(cholesky.factor(first.blocks.data()));
  CHECK(cholesky.factor(second.blocks.data()));
  std::vector<double> found = matrices::times(s, x);
  cholesky.solve(found.data());
  CHECK_NEAR(matrices::distance(found, x), 0, 1e-12);
}

TEST(sparse_cholesky_refuses_what_is_not_positive_definite) {
  std::vector<double> s = matrices::dense(6, 6, 1, false, 7);
  s[20 * 36 + 20] = -1.0;
  const matrices::Blocks<6> blocks(s, 6);
  CHECK(!SparseCholesky<6>(blocks.pattern, kNoLimits).factor(blocks.blocks.data()));
}

TEST(fill_is_that_of_the_better_order) {
  // An arrow whose head comes last has no fill: one block below each diagonal.
  const matrices::Blocks<6> arrow(matrices::dense(10, 6, 0, true, 1), 10);
  const Fill fill = SparseCholesky<6>(arrow.pattern, kNoLimits).fill();
  CHECK(fill.blocks == 19);
  CHECK_NEAR(fill.products, 9 * 2, 0);
  CHECK(!SparseCholesky<6>(arrow.pattern, {18, 1e9}).fill().complete);
}
