// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Questions before and after a solve: whether a problem's numbers can be worked with, and how loosely poses hang.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <utility>

#include "adjustment/types.hpp"
#include "simd/target.hpp"

namespace ba {

inline bool all_finite(const double* values, std::int64_t n) {
  // A number that is not finite is none any more after this either, and no sum of zeros overflows. Sums side by side do
  // not wait for one another.
  double sums[kLanes] = {};
  std::int64_t i = 0;
  for (; i + kLanes <= n; i += kLanes)
    for (int l = 0; l < kLanes; ++l) sums[l] += values[i + l] * 0.0;
  for (; i < n; ++i) sums[0] += values[i] * 0.0;
  return std::all_of(sums, sums + kLanes, [](double sum) { return sum == 0.0; });
}

// Whether all is in range, sorted by point and finite, and sigmas are positive, as core/problem.py asks for.
inline bool is_sound(const ProblemView& p, const StateView& s) {
  // A sign bit anywhere is an index out of range, or one of a point after a larger one.
  std::uint64_t signs = 0;
  const auto look_at = [&signs](const std::int64_t* index, std::int64_t n, std::int64_t limit) {
    for (std::int64_t o = 0; o < n; ++o) {
      const auto i = static_cast<std::uint64_t>(index[o]);
      signs |= i | (static_cast<std::uint64_t>(limit) - 1 - i);
    }
  };
  look_at(p.keyframe, p.n_obs, p.n_keyframes);
  look_at(p.camera, p.n_obs, p.n_cameras);
  look_at(p.point, p.n_obs, p.n_points);
  for (std::int64_t o = 1; o < p.n_obs; ++o)
    signs |= static_cast<std::uint64_t>(p.point[o]) - static_cast<std::uint64_t>(p.point[o - 1]);
  bool good = signs >> 63 == 0;
  for (std::int64_t o = 0; o < p.n_obs; ++o) good &= p.sigma[o] > 0.0;
  return good && all_finite(p.uv, 2 * p.n_obs) && all_finite(p.sigma, p.n_obs) &&
         all_finite(p.params, kParams * p.n_cameras) && all_finite(s.rotation, 9 * p.n_keyframes) &&
         all_finite(s.translation, 3 * p.n_keyframes) && all_finite(s.points, 3 * p.n_points) &&
         (s.intrinsics == nullptr || all_finite(s.intrinsics, 3 * p.n_keyframes));
}

// Relative poses of keyframes: n of them.
struct StepFactorsView {
  std::int64_t n;
  const std::int64_t* keyframes;                // (n, 2)
  const double *rotation, *translation, *root;  // (n, 3, 3), (n, 3), (n, 6, 6)
};

// Whether they are finite, of different keyframes that exist, and rotations to within `most`, as core/factors.py asks.
inline bool are_sound(const StepFactorsView& steps, std::int64_t n_keyframes, double most) {
  for (std::int64_t k = 0; k < steps.n; ++k) {
    const std::int64_t first = steps.keyframes[2 * k], second = steps.keyframes[2 * k + 1];
    const double* r = steps.rotation + 9 * k;
    if (first == second || std::min(first, second) < 0 || std::max(first, second) >= n_keyframes) return false;
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j) {
        const double off = r[3 * i] * r[3 * j] + r[3 * i + 1] * r[3 * j + 1] + r[3 * i + 2] * r[3 * j + 2] - (i == j);
        if (!(std::abs(off) <= most)) return false;
      }
    const double across[3] = {r[4] * r[8] - r[5] * r[7], r[5] * r[6] - r[3] * r[8], r[3] * r[7] - r[4] * r[6]};
    if (!(r[0] * across[0] + r[1] * across[1] + r[2] * across[2] > 0.0)) return false;
  }
  return all_finite(steps.translation, 3 * steps.n) && all_finite(steps.root, 36 * steps.n);
}

// The inverse of a symmetric 6 x 6 matrix by Cholesky; false if a variance is above `most` of a matrix that is scaled
// to a unit diagonal, or if it is not positive definite.
inline bool inverse6(const double* a, double most, double* out) {
  double unit[6], l[6][6] = {}, back[6][6] = {};
  for (int i = 0; i < 6; ++i) {
    if (!(a[7 * i] > 0.0)) return false;
    unit[i] = 1.0 / std::sqrt(a[7 * i]);
  }
  for (int j = 0; j < 6; ++j)
    for (int i = j; i < 6; ++i) {
      double sum = a[6 * i + j] * unit[i] * unit[j];
      for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
      if (i == j && !(sum > 0.0)) return false;
      l[i][j] = i == j ? std::sqrt(sum) : sum / l[j][j];
    }
  for (int j = 0; j < 6; ++j)
    for (int i = j; i < 6; ++i) {
      double sum = i == j ? 1.0 : 0.0;
      for (int k = j; k < i; ++k) sum -= l[i][k] * back[k][j];
      back[i][j] = sum / l[i][i];
    }
  for (int i = 0; i < 6; ++i)
    for (int j = 0; j < 6; ++j) {
      double sum = 0.0;
      for (int k = std::max(i, j); k < 6; ++k) sum += back[k][i] * back[k][j];
      if (i == j && !(sum < most)) return false;
      out[6 * i + j] = sum * unit[i] * unit[j];
    }
  return true;
}

// The largest eigenvalue of a symmetric 3 x 3 matrix, by Jacobi's rotations.
inline double largest_eigenvalue3(double a[3][3]) {
  for (int sweep = 0; sweep < 20; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    if (off <= 1e-32 * (a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2])) break;
    for (const auto& [p, q] : {std::pair{0, 1}, std::pair{0, 2}, std::pair{1, 2}}) {
      if (a[p][q] == 0.0) continue;
      const double theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
      const double t = (theta >= 0.0 ? 1.0 : -1.0) / (std::abs(theta) + std::sqrt(theta * theta + 1.0));
      const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
      for (int k = 0; k < 3; ++k) {
        const double x = a[k][p], y = a[k][q];
        a[k][p] = c * x - s * y;
        a[k][q] = s * x + c * y;
      }
      for (int k = 0; k < 3; ++k) {
        const double x = a[p][k], y = a[q][k];
        a[p][k] = c * x - s * y;
        a[q][k] = s * x + c * y;
      }
    }
  }
  return std::max({a[0][0], a[1][1], a[2][2]});
}

// The standard deviations (m, rad) of the loosest of n poses in their worst directions, with all others held: of blocks
// (n, 6, 6) of S, and positions (n, 3) of the body, m. 0, 0 where one is undetermined. See core/covariance.py.
inline std::array<double, 2> loosest(const double* blocks, const double* positions, std::int64_t n, double most) {
  double of_position = 0.0, of_rotation = 0.0;
  for (std::int64_t k = 0; k < n; ++k) {
    double sigma[36], moves[3][6] = {}, moved[3][6] = {}, turned[3][3], shifted[3][3] = {};
    if (!inverse6(blocks + 36 * k, most, sigma)) return {0.0, 0.0};
    // The body is at p = -R't, and moves by p x dphi - dt.
    const double* p = positions + 3 * k;
    const double cross[3][3] = {{0.0, -p[2], p[1]}, {p[2], 0.0, -p[0]}, {-p[1], p[0], 0.0}};
    for (int i = 0; i < 3; ++i) {
      std::copy_n(cross[i], 3, moves[i]);
      moves[i][3 + i] = -1.0;
      for (int j = 0; j < 3; ++j) turned[i][j] = sigma[6 * i + j];
    }
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 6; ++j)
        for (int m = 0; m < 6; ++m) moved[i][j] += moves[i][m] * sigma[6 * m + j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int m = 0; m < 6; ++m) shifted[i][j] += moved[i][m] * moves[j][m];
    of_position = std::max(of_position, largest_eigenvalue3(shifted));
    of_rotation = std::max(of_rotation, largest_eigenvalue3(turned));
  }
  const bool known = std::isfinite(of_position) && std::isfinite(of_rotation);
  return known ? std::array{std::sqrt(of_position), std::sqrt(of_rotation)} : std::array{0.0, 0.0};
}

}  // namespace ba
