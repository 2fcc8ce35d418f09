// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Sizes of residuals without a layout: what a window asks before it knows which observations take part in a solve.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

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
  constexpr int kUsed = kLens == Lens::kPinhole ? 4 : kParams;
  for (std::int64_t first = 0; first < p.n_obs; first += kLanes) {
    const int count = static_cast<int>(std::min<std::int64_t>(kLanes, p.n_obs - first));
    V8 x[3] = {}, seen[2] = {}, sigma{};
    Cameras cameras{};
    for (int l = 0; l < kLanes; ++l) {
      const std::int64_t o = first + std::min(l, count - 1);
      double y[3];
      in_camera(p, s, o, y);
      for (int i = 0; i < 3; ++i) x[i][l] = y[i];
      for (int i = 0; i < kUsed; ++i) cameras.param[i][l] = p.params[kParams * p.camera[o] + i];
      if constexpr (kLens == Lens::kMixed) cameras.fisheye[l] = p.model[p.camera[o]];
      for (int i = 0; i < 2; ++i) seen[i][l] = p.uv[2 * o + i];
      sigma[l] = p.sigma[o];
    }
    Projected q;
    project<kLens, false>(x, cameras, q);
    const V8 du = q.uv[0] - seen[0], dv = q.uv[1] - seen[1];
    const V8 norm = root(du * du + dv * dv) / sigma, none = splat(std::numeric_limits<double>::infinity());
    // A number that is none is not equal to itself.
    const V8 found = select(behind<kLens>(x, cameras, false) | (norm != norm), none, norm);
    for (int l = 0; l < count; ++l) out[first + l] = found[l];
  }
}

// Call f(lens) with the lens that a problem's cameras need, as a type.
template <class F>
void with_lens(const ProblemView& p, F f) {
  const std::int64_t n = p.n_cameras;
  const auto bent = [&p](std::int64_t c) {
    return std::any_of(p.params + kParams * c + 4, p.params + kParams * (c + 1), [](double k) { return k != 0.0; });
  };
  if (std::any_of(p.model, p.model + n, [](std::uint8_t model) { return model != 0; })) {
    f(std::integral_constant<Lens, Lens::kMixed>());
  } else {
    bool straight = true;
    for (std::int64_t c = 0; c < n; ++c) straight &= !bent(c);
    if (straight)
      f(std::integral_constant<Lens, Lens::kPinhole>());
    else
      f(std::integral_constant<Lens, Lens::kRational>());
  }
}

// out: n_obs, sigmas; infinite for points that their camera cannot see.
inline void residual_norms(const ProblemView& p, const StateView& s, double* out) {
  with_lens(p, [&](auto lens) { residual_norms_as<decltype(lens)::value>(p, s, out); });
}

}  // namespace ba::BA_TARGET
