// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Sizes of residuals without a layout: what a window asks before it knows which observations take part in a solve.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "adjustment/layout.hpp"
#include "adjustment/project.hpp"
#include "adjustment/rows.hpp"

namespace ba::BA_TARGET {

// x in the camera frame of one observation, m: Rc (R x + t) + tc.
inline void in_camera(const ProblemView& p, const StateView& s, std::int64_t o, double* out) {
  const double *r = s.rotation + 9 * p.keyframe[o], *t = s.translation + 3 * p.keyframe[o];
  const double *q = p.camera_rotation + 9 * p.camera[o], *move = p.camera_translation + 3 * p.camera[o];
  const double* x = s.points + 3 * p.point[o];
  double body[3];
  for (int i = 0; i < 3; ++i) body[i] = r[3 * i] * x[0] + r[3 * i + 1] * x[1] + r[3 * i + 2] * x[2] + t[i];
  for (int i = 0; i < 3; ++i) out[i] = q[3 * i] * body[0] + q[3 * i + 1] * body[1] + q[3 * i + 2] * body[2] + move[i];
}

template <Lens kLens>
void residual_norms_as(const ProblemView& p, const StateView& s, double* out) {
  for (std::int64_t first = 0; first < p.n_obs; first += kLanes) {
    const int count = static_cast<int>(std::min<std::int64_t>(kLanes, p.n_obs - first));
    V8 x[3] = {};
    Cameras cameras{};
    for (int l = 0; l < kLanes; ++l) {
      const std::int64_t o = first + std::min(l, count - 1);
      double y[3];
      in_camera(p, s, o, y);
      for (int i = 0; i < 3; ++i) x[i][l] = y[i];
      for (int i = 0; i < kParams; ++i) cameras.param[i][l] = p.params[kParams * p.camera[o] + i];
      cameras.fisheye[l] = p.model[p.camera[o]];
    }
    Projected q;
    project<kLens, false>(x, cameras, q);
    for (int l = 0; l < count; ++l) {
      const std::int64_t o = first + l;
      const double du = q.uv[0][l] - p.uv[2 * o], dv = q.uv[1][l] - p.uv[2 * o + 1];
      const double norm = std::sqrt(du * du + dv * dv) / p.sigma[o];
      const double y[3] = {x[0][l], x[1][l], x[2][l]};
      const bool counts = !is_behind(y, kLens == Lens::kMixed && cameras.fisheye[l] != 0.0) && !std::isnan(norm);
      out[o] = counts ? norm : std::numeric_limits<double>::infinity();
    }
  }
}

// out: n_obs, sigmas; infinite for points that their camera cannot see.
inline void residual_norms(const ProblemView& p, const StateView& s, double* out) {
  if (std::any_of(p.model, p.model + p.n_cameras, [](std::uint8_t model) { return model != 0; }))
    residual_norms_as<Lens::kMixed>(p, s, out);
  else
    residual_norms_as<Lens::kRational>(p, s, out);
}

}  // namespace ba::BA_TARGET
