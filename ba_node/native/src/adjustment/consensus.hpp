// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Which views of a point agree: the search of core/consensus.py, where it is described, one point after the other.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "adjustment/triangulate.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

// As in core/consensus.py.
constexpr std::int64_t kMaxPairs = 45, kMaxSingles = 8;
constexpr double kLeastSine2 = 1e-12;

class Consensus {
 public:
  Consensus(const RaysView& rays, std::int64_t n_points, double gate)
      : rays_(rays), gate2_(gate * gate), begin_(n_points + 1), row_(rays.n_rays) {
    for (std::int64_t o = 0; o < rays.n_rays; ++o) ++begin_[rays.point[o] + 1];
    for (std::int64_t p = 0; p < n_points; ++p) begin_[p + 1] += begin_[p];
    std::vector<std::int64_t> next(begin_.begin(), begin_.end() - 1);
    for (std::int64_t o = 0; o < rays.n_rays; ++o) row_[next[rays.point[o]]++] = o;
  }

  // Whether each ray agrees with the place that its point's rays agree on best: (n_rays,).
  void run(bool* agrees) {
    for (std::size_t p = 0; p + 1 < begin_.size(); ++p) {
      first_ = row_.data() + begin_[p];
      n_ = begin_[p + 1] - begin_[p];
      if (n_ == 0) continue;
      load_rays();
      search();
      for (std::int64_t k = 0; k < n_; k += kLanes) {
        const V8 errors = best_far_ ? errors2<true>(k, best_) : errors2<false>(k, best_);
        for (std::int64_t l = 0; l < std::min<std::int64_t>(kLanes, n_ - k); ++l)
          agrees[first_[k + l]] = errors[static_cast<int>(l)] < gate2_;
      }
    }
  }

 private:
  const double* centre(std::int64_t k) const { return rays_.centre + 3 * first_[k]; }
  const double* direction(std::int64_t k) const { return rays_.direction + 3 * first_[k]; }

  // The rays of the point at hand, eight to a block; lanes behind the last are zero.
  void load_rays() {
    const std::int64_t size = (n_ + kLanes - 1) / kLanes * kLanes;
    lanes_.assign(7 * size, 0.0);
    for (std::int64_t k = 0; k < n_; ++k) {
      double* at = lanes_.data() + 7 * (k / kLanes * kLanes) + k % kLanes;
      for (int i = 0; i < 3; ++i) {
        at[i * kLanes] = centre(k)[i];
        at[(3 + i) * kLanes] = direction(k)[i];
      }
      const double scale = rays_.px_per_rad[first_[k]];
      at[6 * kLanes] = scale * scale;
    }
  }

  void search() {
    best_score_ = std::numeric_limits<double>::infinity();
    const std::int64_t singles = std::min(n_, kMaxSingles);
    for (std::int64_t s = 0; s < singles; ++s) attempt(direction(s * n_ / singles), true);
    for (std::int64_t s = 0; s < singles; ++s) {
      const std::int64_t k = s * n_ / singles;
      const double distance = rays_.distance[first_[k]];
      if (!std::isfinite(distance)) continue;
      double x[3];
      for (int i = 0; i < 3; ++i) x[i] = centre(k)[i] + distance * direction(k)[i];
      attempt(x, false);
    }
    if (n_ * (n_ - 1) / 2 <= kMaxPairs) {
      for (std::int64_t i = 0; i < n_; ++i)
        for (std::int64_t j = i + 1; j < n_; ++j) meet(i, j);
    } else {
      for (std::int64_t k = 0; k < kMaxPairs; ++k) {
        const std::int64_t i = k * n_ / kMaxPairs;
        meet(i, (i + 1 + (k * 2654435761 % 4294967296) * (n_ - 1) / 4294967296) % n_);
      }
    }
  }

  // Where two rays are nearest to each other, by their angles.
  void meet(std::int64_t i, std::int64_t j) {
    const double *a = direction(i), *b = direction(j), *from = centre(i), *to = centre(j);
    double between[3], cosine = 0.0, along_a = 0.0, along_b = 0.0;
    for (int k = 0; k < 3; ++k) {
      between[k] = to[k] - from[k];
      cosine += a[k] * b[k];
      along_a += between[k] * a[k];
      along_b += between[k] * b[k];
    }
    const double sine2 = 1.0 - cosine * cosine;
    if (!(sine2 > kLeastSine2)) return;
    const double s = (along_a - cosine * along_b) / sine2, t = (cosine * along_a - along_b) / sine2;
    if (!(s > 0.0 && t > 0.0)) return;
    const double share = s * s / (s * s + t * t);
    double x[3];
    for (int k = 0; k < 3; ++k) x[k] = (1.0 - share) * (from[k] + s * a[k]) + share * (to[k] + t * b[k]);
    attempt(x, false);
  }

  void attempt(const double* x, bool far) {
    double score = 0.0;
    for (std::int64_t k = 0; k < n_; k += kLanes) {
      const V8 errors = far ? errors2<true>(k, x) : errors2<false>(k, x);
      for (std::int64_t l = 0; l < std::min<std::int64_t>(kLanes, n_ - k); ++l) {
        score += errors[static_cast<int>(l)];
        if (!(score < best_score_)) return;
      }
    }
    best_score_ = score;
    best_far_ = far;
    std::copy_n(x, 3, best_);
  }

  // Squared angles between eight rays, from the k-th on, and a point (or a direction, for one far away), in sigmas; at
  // most the gate's.
  template <bool kFar>
  V8 errors2(std::int64_t k, const double* x) const {
    const double* at = lanes_.data() + 7 * k;
    V8 away[3], d[3];
    for (int i = 0; i < 3; ++i) {
      away[i] = kFar ? splat(x[i]) : x[i] - load(at + i * kLanes);
      d[i] = load(at + (3 + i) * kLanes);
    }
    const V8 dot = away[0] * d[0] + away[1] * d[1] + away[2] * d[2];
    const V8 cross[3] = {d[1] * away[2] - d[2] * away[1], d[2] * away[0] - d[0] * away[2],
                         d[0] * away[1] - d[1] * away[0]};
    const V8 across = cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2];
    const V8 length = away[0] * away[0] + away[1] * away[1] + away[2] * away[2];
    const V8 error = load(at + 6 * kLanes) * across / length, most = splat(gate2_);
    return select(dot > 0.0, select(error > most, most, error), most);
  }

  RaysView rays_;
  double gate2_;
  std::vector<std::int64_t> begin_, row_;  // of each point's rays; rows by point
  std::vector<double> lanes_;              // of the point at hand: by block of eight rays, seven numbers by lane
  const std::int64_t* first_ = nullptr;    // rows of the point at hand
  std::int64_t n_ = 0;
  double best_[3] = {}, best_score_ = 0.0;
  bool best_far_ = false;
};

// Whether each ray sees its point within the gate, sigmas, in front of it: (n_rays,).
inline std::vector<char> sees(const RaysView& rays, double gate, const double* points) {
  std::vector<char> near(rays.n_rays);
  for (std::int64_t o = 0; o < rays.n_rays; ++o) {
    const double *d = rays.direction + 3 * o, *c = rays.centre + 3 * o, *x = points + 3 * rays.point[o];
    const double away[3] = {x[0] - c[0], x[1] - c[1], x[2] - c[2]};
    const double cross[3] = {d[1] * away[2] - d[2] * away[1], d[2] * away[0] - d[0] * away[2],
                             d[0] * away[1] - d[1] * away[0]};
    const double across = length3(cross) / std::max(length3(away), 1e-300);
    const double dot = d[0] * away[0] + d[1] * away[1] + d[2] * away[2];
    near[o] = dot > 0.0 && rays.px_per_rad[o] * across <= gate;
  }
  return near;
}

// The points as those of their rays see them that agree, and which these are; as Triangulator::run, and (n_rays,).
inline void consensus(const RaysView& rays, std::int64_t n_points, double gate, double* points, double* parallax,
                      bool* measured, bool* agrees) {
  Consensus(rays, n_points, gate).run(agrees);
  Triangulator(rays, n_points, agrees).run(points, parallax, measured);
  const std::vector<char> near = sees(rays, gate, points);
  if (std::equal(near.begin(), near.end(), agrees)) return;
  // A point that lost views by it keeps those it had.
  std::vector<std::int64_t> gained(n_points);
  for (std::int64_t o = 0; o < rays.n_rays; ++o) gained[rays.point[o]] += near[o] - static_cast<int>(agrees[o]);
  // Few points have other rays than before.
  std::vector<char> changed(n_points);
  for (std::int64_t o = 0; o < rays.n_rays; ++o) {
    const std::int64_t p = rays.point[o];
    if (gained[p] < 0 || static_cast<bool>(near[o]) == agrees[o]) continue;
    changed[p] = 1;
    agrees[o] = near[o];
  }
  Triangulator(rays, n_points, agrees).run(points, parallax, measured, changed.data());
}

}  // namespace ba::BA_TARGET
