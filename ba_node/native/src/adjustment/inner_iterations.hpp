// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Inner iterations: points alone, eight at once; core/inner_iterations.py says what they do and is this file's oracle.
#pragma once

#include <cstdint>
#include <limits>

#include "adjustment/equations.hpp"
#include "adjustment/rows.hpp"

namespace ba::BA_TARGET {

constexpr double kFirstDamping = 1e-4, kMinGain = 1e-4;
constexpr double kMinGainOutlier = 1e-6, kClose = 1e-3, kRadial = 0.9;

// What Huber's loss takes from the curvature of the points of a batch: of an observation outside of it, what a step
// along the residual would meet.
struct Flatness {
  bool any = false;
  Packed c{};

  [[gnu::always_inline]] void add(const Evaluation& obs, double scale) {
    const V8 &r0 = obs.residual[0], &r1 = obs.residual[1], &w = obs.weight[0];
    const V8 norm2 = w * (r0 * r0 + r1 * r1);
    const Mask outside = norm2 > scale * scale;
    if (!ba::BA_TARGET::any(outside)) return;
    any = true;
    const V8 factor = select(outside, kRadial * w * w / select(outside, norm2, splat(1.0)), V8{});
    V8 v[3];
    for (int i = 0; i < 3; ++i) v[i] = r0 * obs.d_point[0][i] + r1 * obs.d_point[1][i];
    const V8 a = factor * v[0], b = factor * v[1];
    c[0] += a * v[0];
    c[1] += a * v[1];
    c[2] += b * v[1];
    c[3] += a * v[2];
    c[4] += b * v[2];
    c[5] += factor * v[2] * v[2];
  }
  // Which points have such an observation.
  Mask where() const { return c[0] + c[2] + c[5] > 0.0; }
};

// Improve the points of a batch, keyframes held. images: room for those of all its slots, filled here. keep(slot, obs):
// called for all slots, the last time at the x that is returned; sums: of the same.
template <Lens kLens, bool kDepth, class Keep>
inline void iterate_batch(const Rows& rows, std::int64_t first, std::int64_t end, int steps, Images* images, Keep keep,
                          V8 (&x)[3], PointSums& sums, V8& before, V8& best_cost) {
  V8 best[3] = {x[0], x[1], x[2]};
  Mask active = ~Mask{}, worse{};
  double mu = kFirstDamping;
  best_cost = splat(std::numeric_limits<double>::infinity());
  const double huber = rows.huber();
  Flatness flat;
  // bend: also what Huber's loss takes from the curvature, which the first and the last look have no use for.
  const auto evaluate = [&](bool again, bool bend) {
    sums = PointSums{};
    flat = Flatness{};
    for (std::int64_t slot = first; slot < end; ++slot) {
      Evaluation obs;
      if (!again) rows.gather<kLens>(slot, images[slot - first]);
      rows.evaluate<kLens, kDepth, true>(slot, images[slot - first], x, obs);
      add_point_rows<kDepth ? 3 : 2>(obs, sums);
      if (bend) flat.add(obs, huber);
      keep(slot, obs);
    }
  };
  for (int step = 0; step <= steps; ++step) {
    evaluate(step > 0, huber > 0.0 && step > 0 && step < steps);
    if (step == 0) before = sums.cost;
    const Mask better = active & (sums.cost < best_cost);  // not if worse, or not a number
    const V8 least = flat.any ? select(flat.where(), splat(kMinGainOutlier), splat(kMinGain)) : splat(kMinGain);
    const Mask arrived = best_cost - sums.cost < least * sums.cost;
    best_cost = select(better, sums.cost, best_cost);
    for (int i = 0; i < 3; ++i) best[i] = select(better, x[i], best[i]);
    worse = active & ~better;
    active = better & ~arrived;
    if (step == steps || !any(active)) break;
    V8 damping[3], y[3], move[3];
    const int diagonal[3] = {0, 2, 5};
    for (int i = 0; i < 3; ++i) damping[i] = mu * maximum(sums.c[diagonal[i]], splat(kMinDiagonal));
    Packed li;
    inverse_cholesky(sums.c, damping, li);
    lower_times(li, sums.g, y);
    V8 promise = y[0] * y[0] + y[1] * y[1] + y[2] * y[2];
    const Mask close = promise <= kClose * sums.cost;
    if (step > 0 && flat.any && any(close)) {
      for (int i = 0; i < 6; ++i) flat.c[i] = sums.c[i] - select(close, flat.c[i], V8{});
      inverse_cholesky(flat.c, damping, li);
      lower_times(li, sums.g, y);
      promise = y[0] * y[0] + y[1] * y[1] + y[2] * y[2];
    }
    upper_times(li, y, move);
    // What the model promises is known before the step.
    active &= ~(promise <= rows.least_promise() * sums.cost);
    if (!any(active)) break;
    for (int i = 0; i < 3; ++i) x[i] = select(active, best[i] - move[i], best[i]);
    mu *= 0.1;
  }
  for (int i = 0; i < 3; ++i) x[i] = best[i];
  if (any(worse)) evaluate(true, false);
}

}  // namespace ba::BA_TARGET
