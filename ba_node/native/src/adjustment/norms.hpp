// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Sizes of residuals without a layout: what a window asks before it knows which observations take part in a solve.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "adjustment/layout.hpp"
#include "adjustment/project.hpp"
#include "adjustment/rows.hpp"

namespace ba::BA_TARGET {

// Rigid transforms by columns of four numbers, of which the last is nothing: a point is moved by a product with each of
// three. The sums are those of one coordinate after the other, to the last digit.
class Moves {
 public:
  Moves(const double* rotation, const double* translation, std::int64_t n) : columns_(16 * n) {
    for (std::int64_t k = 0; k < n; ++k)
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) columns_[16 * k + 4 * j + i] = rotation[9 * k + 3 * i + j];
        columns_[16 * k + 12 + i] = translation[3 * k + i];
      }
  }

  template <class X>
  BA_INLINE Native4 operator()(std::int64_t k, const X& x) const {
    const double* at = columns_.data() + 16 * k;
    const auto column = [at](int j) { return Loaded<Native4>::from(at + 4 * j); };
    return column(0) * x[0] + column(1) * x[1] + column(2) * x[2] + column(3);
  }

 private:
  std::vector<double> columns_;
};

// Whether all cameras have the same lens, to the last digit, as those of a rectified pair.
inline bool alike(const ProblemView& p) {
  bool same = true;
  for (std::int64_t c = 1; c < p.n_cameras; ++c)
    same &= p.model[c] == p.model[0] && std::equal(p.params, p.params + kParams, p.params + kParams * c);
  return same;
}

template <Lens kLens>
void residual_norms_as(const ProblemView& p, const StateView& s, double* out) {
  constexpr int kUsed = kLens == Lens::kPinhole ? 4 : kParams;
  // What is written number by number is read by registers once it has left the store buffer, so many later.
  constexpr int kSome = 8 * kLanes;
  const Moves body(s.rotation, s.translation, p.n_keyframes);
  const Moves camera(p.camera_rotation, p.camera_translation, p.n_cameras);
  const bool same = alike(p);
  alignas(64) double x[3][kSome] = {}, seen[2][kSome] = {}, sigma[kSome] = {}, param[kUsed][kSome] = {};
  alignas(64) double fisheye[kSome] = {};
  for (int i = 0; same && i < kUsed; ++i) std::fill_n(param[i], kSome, p.params[i]);
  if (same) std::fill_n(fisheye, kSome, p.model[0]);
  for (std::int64_t first = 0; first < p.n_obs; first += kSome) {
    const int count = static_cast<int>(std::min<std::int64_t>(kSome, p.n_obs - first));
    for (int l = 0; l < count; ++l) {
      const std::int64_t o = first + l, c = p.camera[o];
      const Native4 moved = camera(c, body(p.keyframe[o], s.points + 3 * p.point[o]));
      for (int i = 0; i < 3; ++i) x[i][l] = moved[i];
      if (same) continue;
      for (int i = 0; i < kUsed; ++i) param[i][l] = p.params[kParams * c + i];
      fisheye[l] = p.model[c];
    }
    for (int l = 0; l < count; ++l) {
      seen[0][l] = p.uv[2 * (first + l)];
      seen[1][l] = p.uv[2 * (first + l) + 1];
    }
    std::copy_n(p.sigma + first, count, sigma);
    for (int l = 0; l < count; l += kLanes) {
      const V8 at[3] = {load(x[0] + l), load(x[1] + l), load(x[2] + l)};
      Cameras cameras{};
      for (int i = 0; i < kUsed; ++i) cameras.param[i] = load(param[i] + l);
      if constexpr (kLens == Lens::kMixed) cameras.fisheye = load(fisheye + l);
      Projected q;
      project<kLens, false>(at, cameras, q);
      const V8 du = q.uv[0] - load(seen[0] + l), dv = q.uv[1] - load(seen[1] + l);
      const V8 norm = root(du * du + dv * dv) / load(sigma + l), none = splat(std::numeric_limits<double>::infinity());
      // A number that is none is not equal to itself.
      const V8 found = select(behind<kLens>(at, cameras, false) | (norm != norm), none, norm);
      if (l + kLanes <= count)
        std::memcpy(out + first + l, &found, sizeof(found));
      else
        for (int k = l; k < count; ++k) out[first + k] = found[k - l];
    }
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
