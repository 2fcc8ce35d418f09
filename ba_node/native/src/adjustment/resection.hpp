// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The pose of one keyframe by known points; core/resection.py has the equations, and is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "adjustment/norms.hpp"
#include "adjustment/retract.hpp"
#include "adjustment/rows.hpp"

namespace ba::BA_TARGET {

struct PoseSums {
  double cost = 0.0, matrix[6][6] = {}, vector[6] = {};
};

// Solve the damped equations, the lower triangle of which is given, for a step; false if they are not definite.
inline bool pose_step(PoseSums& s, double damping, double (&x)[6]) {
  auto& a = s.matrix;
  for (int i = 0; i < 6; ++i) {
    a[i][i] *= 1.0 + damping;
    for (int j = 0; j < i; ++j) {
      for (int k = 0; k < j; ++k) a[i][j] -= a[i][k] * a[j][k];
      a[i][j] /= a[j][j];
      a[i][i] -= a[i][j] * a[i][j];
    }
    if (!(a[i][i] > 0.0)) return false;
    a[i][i] = std::sqrt(a[i][i]);
    x[i] = -s.vector[i];
    for (int k = 0; k < i; ++k) x[i] -= a[i][k] * x[k];
    x[i] /= a[i][i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) x[i] -= a[k][i] * x[k];
    x[i] /= a[i][i];
  }
  return std::all_of(x, x + 6, [](double one) { return std::isfinite(one); });
}

// pose: (3, 3) and (3,), body from world, of the keyframe that rows are of; points: (P, 3).
template <Lens kLens>
PoseSums pose_sums(const ProblemView& p, const double* pose, const double* points,
                   const std::vector<std::int64_t>& rows, const CostModel& cost_model) {
  constexpr int kUsed = kLens == Lens::kPinhole ? 4 : kParams;
  V8 cost{}, matrix[21] = {}, vector[6] = {};
  const auto n = static_cast<std::int64_t>(rows.size());
  for (std::int64_t first = 0; first < n; first += kLanes) {
    V8 body[3] = {}, turn[9] = {}, x[3] = {}, seen[2] = {}, scale{};
    Cameras cameras{};
    for (int l = 0; l < kLanes; ++l) {
      const std::int64_t o = rows[std::min(first + l, n - 1)], c = p.camera[o];
      const double *r = pose, *t = pose + 9, *X = points + 3 * p.point[o];
      const double *q = p.camera_rotation + 9 * c, *move = p.camera_translation + 3 * c;
      double b[3];
      for (int i = 0; i < 3; ++i)
        body[i][l] = b[i] = r[3 * i] * X[0] + r[3 * i + 1] * X[1] + r[3 * i + 2] * X[2] + t[i];
      for (int i = 0; i < 3; ++i) x[i][l] = q[3 * i] * b[0] + q[3 * i + 1] * b[1] + q[3 * i + 2] * b[2] + move[i];
      for (int i = 0; i < 9; ++i) turn[i][l] = q[i];
      for (int i = 0; i < kUsed; ++i) cameras.param[i][l] = p.params[kParams * c + i];
      if constexpr (kLens == Lens::kMixed) cameras.fisheye[l] = p.model[c];
      for (int i = 0; i < 2; ++i) seen[i][l] = p.uv[2 * o + i];
      scale[l] = first + l < n ? 1.0 / p.sigma[o] : 0.0;
    }
    const Mask none = scale == 0.0, off = behind<kLens>(x, cameras, false);
    scale = select(off, V8{}, scale);
    x[2] = select(off, splat(1.0), x[2]);
    Projected q;
    project<kLens, true>(x, cameras, q);
    const V8 residual[2] = {(q.uv[0] - seen[0]) * scale, (q.uv[1] - seen[1]) * scale};
    const V8 norm2 = residual[0] * residual[0] + residual[1] * residual[1];
    V8 added, weight;
    robust(cost_model, select(off, splat(kBehindNorm * kBehindNorm), norm2), added, weight);
    cost += select(none, V8{}, added);
    for (int row = 0; row < 2; ++row) {
      V8 g[3], jacobian[6];
      for (int c = 0; c < 3; ++c)
        g[c] = scale * (q.d_x[row][0] * turn[c] + q.d_x[row][1] * turn[3 + c] + q.d_x[row][2] * turn[6 + c]);
      for (int c = 0; c < 3; ++c) {
        const int d = (c + 1) % 3, e = (c + 2) % 3;
        jacobian[c] = body[d] * g[e] - body[e] * g[d];
        jacobian[3 + c] = g[c];
      }
      for (int i = 0, at = 0; i < 6; ++i) {
        const V8 weighted = weight * jacobian[i];
        vector[i] += weighted * residual[row];
        for (int j = 0; j <= i; ++j) matrix[at++] += weighted * jacobian[j];
      }
    }
  }
  PoseSums out;
  out.cost = sum(cost);
  for (int i = 0, at = 0; i < 6; ++i) {
    out.vector[i] = sum(vector[i]);
    for (int j = 0; j <= i; ++j) out.matrix[i][j] = sum(matrix[at++]);
  }
  return out;
}

// pose: (3, 3) and (3,) of the keyframe, body from world; alone: which points it alone sees, (n_pt,). False if it stays
// where it is.
inline bool resect(const ProblemView& p, const StateView& start, std::int64_t keyframe, const CostModel& cost,
                   const ResectionLimits& limits, double* pose, bool* alone) {
  std::vector<char> known(p.n_points);
  for (std::int64_t o = 0; o < p.n_obs; ++o) known[p.point[o]] |= p.keyframe[o] != keyframe;
  std::fill_n(alone, p.n_points, false);
  std::vector<std::int64_t> rows;
  for (std::int64_t o = 0; o < p.n_obs; ++o) {
    if (p.keyframe[o] != keyframe) continue;
    if (known[p.point[o]]) rows.push_back(o);
    alone[p.point[o]] = !known[p.point[o]];
  }
  if (static_cast<std::int64_t>(rows.size()) < limits.least) return false;
  double at[12], best[12];
  std::copy_n(start.rotation + 9 * keyframe, 9, at);
  std::copy_n(start.translation + 3 * keyframe, 3, at + 9);
  bool moved = false;
  double lowest = 0.0;
  for (std::int64_t i = 0; i <= limits.iterations; ++i) {
    PoseSums sums;
    with_lens(p, [&](auto lens) { sums = pose_sums<decltype(lens)::value>(p, at, start.points, rows, cost); });
    if (i > 0 && !(sums.cost < lowest)) break;
    const bool arrived = i > 0 && lowest - sums.cost <= limits.least_gain * lowest;
    lowest = sums.cost;
    moved = i > 0;
    std::copy_n(at, 12, best);
    double step[6], turn[9], turned[12];
    if (arrived || i == limits.iterations || !pose_step(sums, limits.damping, step)) break;
    so3_exp(step, turn);
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c)
        turned[3 * r + c] = turn[3 * r] * at[c] + turn[3 * r + 1] * at[3 + c] + turn[3 * r + 2] * at[6 + c];
      turned[9 + r] = turn[3 * r] * at[9] + turn[3 * r + 1] * at[10] + turn[3 * r + 2] * at[11] + step[3 + r];
    }
    std::copy_n(turned, 12, at);
  }
  if (moved) std::copy_n(best, 12, pose);
  return moved;
}

}  // namespace ba::BA_TARGET
