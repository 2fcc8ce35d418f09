// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Steps from keyframe to keyframe: window/steps.py and window/odometry.py have the equations, and are this file's
// oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "adjustment/quaternions.hpp"

namespace ba {

// Turns (n, 3, 3) row by row and moves (n, 3).
struct StepsView {
  std::int64_t n;
  const double *turn, *move;
};
struct StepsSpan {
  double *turn, *move;
};

// Poses, and between which of them steps are asked for.
struct PosePairs {
  const double *rotation, *translation;
  std::int64_t n;
  const std::int64_t *first, *second;
};

inline double length3(const double* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// A' B.
inline void transposed_product(const double* a, const double* b, double* out) {
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) out[3 * r + c] = a[r] * b[c] + a[3 + r] * b[3 + c] + a[6 + r] * b[6 + c];
}

// Of poses that are body from world: R_i R_j', t_i - R_i R_j' t_j.
inline void steps_of_inverse(const PosePairs& p, const StepsSpan& out) {
  for (std::int64_t k = 0; k < p.n; ++k) {
    const double *ri = p.rotation + 9 * p.first[k], *rj = p.rotation + 9 * p.second[k];
    const double *ti = p.translation + 3 * p.first[k], *tj = p.translation + 3 * p.second[k];
    double *turn = out.turn + 9 * k, *move = out.move + 3 * k;
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c)
        turn[3 * r + c] = ri[3 * r] * rj[3 * c] + ri[3 * r + 1] * rj[3 * c + 1] + ri[3 * r + 2] * rj[3 * c + 2];
    for (int r = 0; r < 3; ++r)
      move[r] = ti[r] - (turn[3 * r] * tj[0] + turn[3 * r + 1] * tj[1] + turn[3 * r + 2] * tj[2]);
  }
}

// Of poses that are world from body: R_i' R_j, R_i' (p_j - p_i).
inline void steps_of(const PosePairs& p, const StepsSpan& out) {
  for (std::int64_t k = 0; k < p.n; ++k) {
    const double *ri = p.rotation + 9 * p.first[k], *rj = p.rotation + 9 * p.second[k];
    const double *ti = p.translation + 3 * p.first[k], *tj = p.translation + 3 * p.second[k];
    transposed_product(ri, rj, out.turn + 9 * k);
    const double way[3] = {tj[0] - ti[0], tj[1] - ti[1], tj[2] - ti[2]};
    for (int r = 0; r < 3; ++r) out.move[3 * k + r] = ri[r] * way[0] + ri[3 + r] * way[1] + ri[6 + r] * way[2];
  }
}

// Of a rotation.
inline double angle_of(const double* turn) {
  double squared = 0;
  for (int i = 0; i < 9; ++i) {
    const double off = turn[i] - (i % 4 == 0);
    squared += off * off;
  }
  return 2.0 * std::asin(std::min(std::sqrt(squared / 8.0), 1.0));
}

// What the front-end's steps are worth, config.GuardConfig.
struct StepSigmas {
  double m, m_share, rad, rad_share, rad_per_m;
};

// Where window.steps.Comparison goes.
struct ComparisonSpan {
  double *sigmas, *move, *turn, *turned, *sigma_m, *sigma_rad;
};

inline void compare_steps(const StepsView& steps, const StepsView& measured, const StepSigmas& worth,
                          const ComparisonSpan& out) {
  for (std::int64_t k = 0; k < steps.n; ++k) {
    const double *move = steps.move + 3 * k, *wanted = measured.move + 3 * k;
    const double length = length3(wanted), off[3] = {move[0] - wanted[0], move[1] - wanted[1], move[2] - wanted[2]};
    double between[9];
    transposed_product(measured.turn + 9 * k, steps.turn + 9 * k, between);
    out.turned[k] = angle_of(measured.turn + 9 * k);
    out.sigma_m[k] = worth.m + worth.m_share * length;
    out.sigma_rad[k] = worth.rad + worth.rad_share * out.turned[k] + worth.rad_per_m * length;
    out.move[k] = length3(off);
    out.turn[k] = angle_of(between);
    out.sigmas[k] = std::max(out.move[k] / out.sigma_m[k], out.turn[k] / out.sigma_rad[k]);
  }
}

// The upper one of two in the middle.
inline double upper_median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// As numpy's: the mean of two in the middle.
inline double mean_median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return values.size() % 2 ? *middle : 0.5 * (*middle + *std::max_element(values.begin(), middle));
}

// Constants of window.steps.
struct CommonLimits {
  double telling, spread, median;
  std::int64_t few;
};

// window.steps._common: vectors found and measured (n, 3), standard deviations of those measured (n,).
inline double common_factor(const std::vector<double>& found, const std::vector<double>& measured,
                            const std::vector<double>& sigma, const CommonLimits& limits) {
  std::vector<double> logs, off, noise;
  for (std::size_t k = 0; k < sigma.size(); ++k) {
    const double *a = &found[3 * k], *b = &measured[3 * k], both[3] = {a[0] + b[0], a[1] + b[1], a[2] + b[2]};
    const double length = length3(both), over = std::max(length, 1e-12);
    const double ours = (a[0] * both[0] + a[1] * both[1] + a[2] * both[2]) / over;
    const double theirs = (b[0] * both[0] + b[1] * both[1] + b[2] * both[2]) / over;
    if (!(0.5 * length > limits.telling * sigma[k] && ours > 0.0 && theirs > 0.0)) continue;
    logs.push_back(std::log(ours / theirs));
    noise.push_back(2.0 * sigma[k] / length);
  }
  if (static_cast<std::int64_t>(logs.size()) < limits.few) return 1.0;
  const double middle = upper_median(logs), root = std::sqrt(static_cast<double>(logs.size()));
  for (const double one : logs) off.push_back(std::abs(one - middle));
  const double scatter = limits.median * limits.spread * upper_median(off) / root;
  const double expected = limits.median * upper_median(noise) / root;
  return std::abs(middle) > std::max(3.0 * scatter, 2.0 * expected) ? std::exp(middle) : 1.0;
}

// The factor of moves; the factor of turns whose measured ones are larger than their standard deviations.
inline double scale_error(const StepsView& steps, const StepsView& measured, const double* sigma_m,
                          const CommonLimits& limits) {
  return common_factor({steps.move, steps.move + 3 * steps.n}, {measured.move, measured.move + 3 * steps.n},
                       {sigma_m, sigma_m + steps.n}, limits);
}

inline double turn_error(const StepsView& steps, const StepsView& measured, const double* turned,
                         const double* sigma_rad, const CommonLimits& limits) {
  std::vector<double> found, wanted, sigma;
  const auto axis = [](const double* r, std::vector<double>& to) {
    for (const auto& [i, j] : {std::pair{7, 5}, {2, 6}, {3, 1}}) to.push_back(0.5 * (r[i] - r[j]));
  };
  for (std::int64_t k = 0; k < steps.n; ++k) {
    if (!(turned[k] > sigma_rad[k])) continue;
    axis(steps.turn + 9 * k, found);
    axis(measured.turn + 9 * k, wanted);
    sigma.push_back(sigma_rad[k]);
  }
  return common_factor(found, wanted, sigma, limits);
}

// Of a rotation, to the last digits near 0 and near pi, as core.geometry.so3_log has it.
inline double exact_angle(const double* rotation) {
  constexpr double kSmall = 1e-4;
  double q[4];
  quaternion_of(rotation, q);
  const double sine = length3(q), small = sine / q[3];
  return sine < kSmall ? 2.0 * small * (1.0 - small * small / 3.0) : 2.0 * std::atan2(sine, q[3]);
}

// The medians of how far steps are off others, in standard deviations of these: of turns and of moves.
inline std::pair<double, double> medians_off(const StepsView& steps, const StepsView& others, const double* sigma_rad,
                                             const double* sigma_m) {
  std::vector<double> turned, moved;
  for (std::int64_t k = 0; k < steps.n; ++k) {
    double between[9];
    transposed_product(others.turn + 9 * k, steps.turn + 9 * k, between);
    const double *a = steps.move + 3 * k, *b = others.move + 3 * k, off[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    turned.push_back(exact_angle(between) / sigma_rad[k]);
    moved.push_back(length3(off) / sigma_m[k]);
  }
  return {mean_median(turned), mean_median(moved)};
}

}  // namespace ba
