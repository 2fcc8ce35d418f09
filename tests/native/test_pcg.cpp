// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <limits>

#include "check.hpp"
#include "linalg/pcg.hpp"
#include "matrices.hpp"

using namespace ba;
using namespace ba::BA_TARGET;

namespace {

constexpr std::int64_t kBlocks = 7;
constexpr double kNone = std::numeric_limits<double>::infinity();

struct Solved {
  PcgEnd end;
  std::vector<double> x;
};

template <int D>
Solved solve(const std::vector<double>& s, const std::vector<double>& b, const PcgLimits& limits, bool whole,
             bool with) {
  const auto n = static_cast<std::int64_t>(b.size());
  const matrices::Blocks<D> blocks(s, n / D);
  Buffer<Block<D>> diagonal;
  for (std::int64_t i = 0; i < n / D; ++i) diagonal.push_back(blocks.blocks[blocks.pattern.start[i]]);
  const std::vector<double> scale = [&] {
    std::vector<double> out(n);
    for (std::int64_t i = 0; i < n; ++i) out[i] = 0.5 + 0.01 * static_cast<double>(i);
    return out;
  }();
  DiagonalInverse<D> inverse;
  inverse.set(with ? diagonal.data() : nullptr, n / D, scale.data(), whole);
  Pcg pcg;
  pcg.resize(n);
  Solved out{{}, std::vector<double>(n)};
  const auto product = [&](const double* in, double* y) {
    const std::vector<double> result = matrices::times(s, std::vector<double>(in, in + n));
    std::copy(result.begin(), result.end(), y);
  };
  out.end = pcg.solve(
      product, [&](const Buffer<double>& r, Buffer<double>& z) { inverse.apply(r, z); }, b.data(), scale.data(), limits,
      out.x.data());
  return out;
}

}  // namespace

TEST(conjugate_gradients_solve_with_every_preconditioner) {
  const std::vector<double> s = matrices::dense(kBlocks, 6, 2, false, 1), x = matrices::vector(6 * kBlocks, 2);
  const std::vector<double> b = matrices::times(s, x);
  for (const bool whole : {false, true}) {
    for (const bool with : {false, true}) {
      const Solved found = solve<6>(s, b, {1e-13, 200, kNone, 0}, whole, with);
      CHECK(found.end.found && !found.end.on_boundary);
      // Once the model gains nothing but rounding the iteration ends: half of the digits.
      CHECK_NEAR(matrices::distance(found.x, x), 0, 1e-7);
    }
  }
}

TEST(block_diagonal_systems_take_one_iteration_with_their_blocks) {
  const std::vector<double> s = matrices::dense(5, 9, 0, false, 1), x = matrices::vector(45, 2);
  const Solved found = solve<9>(s, matrices::times(s, x), {1e-10, 50, kNone, 0}, true, true);
  CHECK(found.end.iterations == 1);
  CHECK_NEAR(matrices::distance(found.x, x), 0, 1e-12);
}

TEST(a_step_beyond_the_region_ends_on_its_boundary) {
  const std::vector<double> s = matrices::dense(kBlocks, 6, 2, false, 1), b = matrices::vector(6 * kBlocks, 2);
  const double radius = 1e-3;
  const Solved found = solve<6>(s, b, {1e-13, 200, radius, 0}, true, true);
  CHECK(found.end.found && found.end.on_boundary);
  double norm2 = 0;
  for (std::size_t i = 0; i < found.x.size(); ++i) {
    const double scaled = found.x[i] / (0.5 + 0.01 * static_cast<double>(i));
    norm2 += scaled * scaled;
  }
  CHECK_NEAR(std::sqrt(norm2), radius, 1e-15);
}

TEST(negative_curvature_ends_on_the_boundary) {
  std::vector<double> s = matrices::dense(kBlocks, 6, 0, false, 1);
  for (double& value : s) value = -value;
  const Solved found = solve<6>(s, matrices::vector(6 * kBlocks, 2), {1e-13, 200, 2.0, 0}, true, false);
  CHECK(found.end.found && found.end.on_boundary);
  CHECK(found.end.iterations == 0);
}

TEST(nothing_is_solved_by_nothing_and_what_is_not_finite_by_none) {
  const std::vector<double> s = matrices::dense(kBlocks, 6, 1, false, 1);
  std::vector<double> b(6 * kBlocks, 0.0);
  const Solved nothing = solve<6>(s, b, {1e-13, 200, kNone, 0}, true, true);
  CHECK(nothing.end.found && nothing.end.iterations == 0);
  for (double x : nothing.x) CHECK_NEAR(x, 0, 0);
  b[3] = std::numeric_limits<double>::quiet_NaN();
  CHECK(!solve<6>(s, b, {1e-13, 200, kNone, 0}, true, true).end.found);
}

TEST(the_cap_on_iterations_holds) {
  const std::vector<double> s = matrices::dense(kBlocks, 6, 3, false, 1), b = matrices::vector(6 * kBlocks, 2);
  const Solved found = solve<6>(s, b, {1e-300, 3, kNone, 0}, false, false);
  CHECK(found.end.found && found.end.iterations == 3);
}
