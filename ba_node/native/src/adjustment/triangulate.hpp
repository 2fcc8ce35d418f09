// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Points from the rays of their views, one after the other: the rounds of core/triangulation.py, where the equations
// stand. There every round is some twenty numpy calls for a few hundred rays.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "adjustment/types.hpp"
#include "simd/target.hpp"

namespace ba::BA_TARGET {

// As in core/triangulation.py.
constexpr int kPlainRounds = 3, kRobustRounds = 5;
constexpr double kRayHuber = 1.5;

// x of the symmetric A x = b, by elimination with pivots as LAPACK does it.
inline void solve3(double a[3][3], double b[3], double* x) {
  for (int k = 0; k < 3; ++k) {
    int pivot = k;
    for (int i = k + 1; i < 3; ++i)
      if (std::abs(a[i][k]) > std::abs(a[pivot][k])) pivot = i;
    if (pivot != k) {
      std::swap(a[k], a[pivot]);
      std::swap(b[k], b[pivot]);
    }
    for (int i = k + 1; i < 3; ++i) {
      const double factor = a[i][k] / a[k][k];
      for (int j = k + 1; j < 3; ++j) a[i][j] -= factor * a[k][j];
      b[i] -= factor * b[k];
    }
  }
  for (int i = 2; i >= 0; --i) {
    double rest = b[i];
    for (int j = i + 1; j < 3; ++j) rest -= a[i][j] * x[j];
    x[i] = rest / a[i][i];
  }
}

inline double length3(const double* v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

class Triangulator {
 public:
  // which: the rays that count, (n_rays,); null for all.
  Triangulator(const RaysView& rays, std::int64_t n_points, const bool* which = nullptr)
      : rays_(rays), begin_(n_points + 1), row_(rays.n_rays) {
    const auto counts = [which](std::int64_t o) { return which == nullptr || which[o]; };
    for (std::int64_t o = 0; o < rays.n_rays; ++o) begin_[rays.point[o] + 1] += counts(o);
    for (std::int64_t p = 0; p < n_points; ++p) begin_[p + 1] += begin_[p];
    std::vector<std::int64_t> next(begin_.begin(), begin_.end() - 1);
    for (std::int64_t o = 0; o < rays.n_rays; ++o)
      if (counts(o)) row_[next[rays.point[o]]++] = o;
  }

  // points, m: (n_points, 3), NaN for neither two rays nor a measured distance; parallax, rad, and whether a distance
  // was measured: (n_points,).
  void run(double* points, double* parallax, bool* measured) {
    const auto n_points = static_cast<std::int64_t>(begin_.size()) - 1;
    for (std::int64_t p = 0; p < n_points; ++p) {
      take(p);
      measured[p] = measured_;
      midpoint(points + 3 * p);
      parallax[p] = largest_angle();
      if (views_.size() < 2 && !measured_) std::fill_n(points + 3 * p, 3, std::numeric_limits<double>::quiet_NaN());
    }
  }

 private:
  struct View {
    double centre[3], direction[3], px_per_rad, along, shift, distance, trust;
  };

  // Gathers the views of a point, with centres relative to their mean: keeps digits far from the origin.
  void take(std::int64_t p) {
    views_.clear();
    std::fill_n(origin_, 3, 0.0);
    double total = 0.0;
    int n_measured = 0;
    for (std::int64_t k = begin_[p]; k < begin_[p + 1]; ++k) {
      const std::int64_t o = row_[k];
      View v{};
      for (int i = 0; i < 3; ++i) {
        v.centre[i] = rays_.centre[3 * o + i];
        v.direction[i] = rays_.direction[3 * o + i];
        origin_[i] += v.centre[i];
      }
      v.px_per_rad = rays_.px_per_rad[o];
      v.trust = 1.0;
      if (std::isfinite(rays_.distance[o])) {
        v.along = 1.0 / (rays_.distance_sigma[o] * rays_.distance_sigma[o]);
        v.shift = v.along * rays_.distance[o];
        total += rays_.distance[o];
        ++n_measured;
      }
      views_.push_back(v);
    }
    for (double& x : origin_) x /= std::max<double>(1.0, static_cast<double>(views_.size()));
    measured_ = n_measured > 0;
    for (View& v : views_) {
      for (int i = 0; i < 3; ++i) v.centre[i] -= origin_[i];
      v.distance = measured_ ? total / n_measured : 1.0;
    }
  }

  void midpoint(double* x) {
    double at[3] = {};
    for (int round = 0; round < kPlainRounds + kRobustRounds; ++round) {
      weighted_midpoint(at);
      for (View& v : views_) {
        double away[3];
        for (int i = 0; i < 3; ++i) away[i] = at[i] - v.centre[i];
        v.distance = length3(away);
        if (round < kPlainRounds - 1) continue;
        const double* d = v.direction;
        const double cross[3] = {d[1] * away[2] - d[2] * away[1], d[2] * away[0] - d[0] * away[2],
                                 d[0] * away[1] - d[1] * away[0]};
        const double across = length3(cross) / std::max(v.distance, 1e-9);
        v.trust = kRayHuber / std::max(v.px_per_rad * across, kRayHuber);
      }
    }
    for (int i = 0; i < 3; ++i) x[i] = at[i] + origin_[i];
  }

  void weighted_midpoint(double* x) const {
    double a[3][3] = {}, b[3] = {};
    for (const View& v : views_) {
      const double slope = v.px_per_rad / std::max(v.distance, 1e-9);
      const double across = v.trust * slope * slope;
      // W = across (I - d d') + along d d'
      double w[3][3];
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          w[i][j] = (v.along - across) * v.direction[i] * v.direction[j] + (i == j ? across : 0.0);
      for (int i = 0; i < 3; ++i) {
        b[i] += w[i][0] * v.centre[0] + w[i][1] * v.centre[1] + w[i][2] * v.centre[2] + v.shift * v.direction[i];
        for (int j = 0; j < 3; ++j) a[i][j] += w[i][j];
      }
    }
    const double trace = a[0][0] + a[1][1] + a[2][2];
    // A whiff of damping: parallel rays give a far point instead of a singular matrix.
    for (int i = 0; i < 3; ++i) a[i][i] += 1e-14 * trace + (trace > 0.0 ? 0.0 : 1.0);
    solve3(a, b, x);
  }

  // From the ray farthest from the mean to the ray farthest from that one.
  double largest_angle() const {
    if (views_.empty()) return 0.0;
    double mean[3] = {};
    for (const View& v : views_)
      for (int i = 0; i < 3; ++i) mean[i] += v.direction[i];
    const double length = std::max(length3(mean), 1e-300);
    for (double& x : mean) x /= length;
    const View* farthest = &views_[0];
    double widest = 0.0;
    for (const View& v : views_) {
      const double away = chord(v.direction, mean);
      if (away >= widest) {
        widest = away;
        farthest = &v;
      }
    }
    widest = 0.0;
    for (const View& v : views_) widest = std::max(widest, chord(v.direction, farthest->direction));
    return 2.0 * std::asin(std::min(0.5 * widest, 1.0));
  }

  static double chord(const double* a, const double* b) {
    const double between[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return length3(between);
  }

  RaysView rays_;
  std::vector<std::int64_t> begin_, row_;  // of each point's rays; rows by point
  std::vector<View> views_;                // of the point at hand
  double origin_[3] = {};
  bool measured_ = false;
};

}  // namespace ba::BA_TARGET
