// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Points from the rays of their views: the rounds of core/triangulation.py, where the equations stand. There every
// round is some twenty numpy calls for a few hundred rays.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "adjustment/types.hpp"
#include "simd/simd.hpp"

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

// As many points as a register has lanes are worked on at once, each in its lane, as if it were alone.
constexpr int kPoints = sizeof(Register) / sizeof(double);

BA_INLINE Register larger(const Register& a, double b) {
  const Register other = Splat<Register>::of(b);
  return select(a < other, other, a);
}
BA_INLINE Register length3(const Register* v) { return root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

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
  // was measured: (n_points,). Of the points that ``wanted`` marks; null for all.
  void run(double* points, double* parallax, bool* measured, const char* wanted = nullptr) {
    const std::vector<std::int64_t> order = by_views(wanted);
    const auto n = static_cast<std::int64_t>(order.size());
    for (std::int64_t first = 0; first < n; first += kPoints) {
      const std::int64_t* some = order.data() + first;
      const int count = static_cast<int>(std::min<std::int64_t>(kPoints, n - first));
      // A view that is none has no weight.
      views_.assign(views_of(some[count - 1]), View{});
      n_views_ = Register{};
      for (int l = 0; l < count; ++l) measured[some[l]] = take(some[l], l);
      Register at[3] = {};
      midpoints(at);
      const Register widest = largest_chords();
      for (int l = 0; l < count; ++l) {
        const std::int64_t p = some[l];
        const bool known = n_views_[l] >= 2.0 || measured[p];
        for (int i = 0; i < 3; ++i)
          points[3 * p + i] = known ? at[i][l] + origin_[i][l] : std::numeric_limits<double>::quiet_NaN();
        parallax[p] = 2.0 * std::asin(std::min(0.5 * widest[l], 1.0));
      }
    }
  }

 private:
  struct View {
    Register centre[3], direction[3], px_per_rad, along, shift, distance;
  };

  // A x = b.
  struct Equations {
    Register a[3][3], b[3];
  };

  std::int64_t views_of(std::int64_t p) const { return begin_[p + 1] - begin_[p]; }

  // The points that are wanted, those with fewer views first: all lanes wait for the one with most.
  std::vector<std::int64_t> by_views(const char* wanted) const {
    const auto n_points = static_cast<std::int64_t>(begin_.size()) - 1;
    std::int64_t most = 0;
    for (std::int64_t p = 0; p < n_points; ++p) most = std::max(most, views_of(p));
    // Where those of so many views begin. Sorting by std would be compiled for this target and linked for all.
    std::vector<std::int64_t> place(most + 2);
    for (std::int64_t p = 0; p < n_points; ++p) place[views_of(p) + 1] += wanted == nullptr || wanted[p];
    for (std::int64_t k = 0; k <= most; ++k) place[k + 1] += place[k];
    std::vector<std::int64_t> order(place[most + 1]);
    for (std::int64_t p = 0; p < n_points; ++p)
      if (wanted == nullptr || wanted[p]) order[place[views_of(p)]++] = p;
    return order;
  }

  // Gathers the views of a point in its lane, with centres relative to their mean: keeps digits far from the origin.
  // Returns whether a distance was measured.
  bool take(std::int64_t p, int l) {
    const std::int64_t first = begin_[p], n = begin_[p + 1] - first;
    double total = 0.0, origin[3] = {};
    int n_measured = 0;
    for (std::int64_t k = 0; k < n; ++k) {
      const std::int64_t o = row_[first + k];
      View& v = views_[k];
      for (int i = 0; i < 3; ++i) {
        v.centre[i][l] = rays_.centre[3 * o + i];
        v.direction[i][l] = rays_.direction[3 * o + i];
        origin[i] += rays_.centre[3 * o + i];
      }
      v.px_per_rad[l] = rays_.px_per_rad[o];
      if (std::isfinite(rays_.distance[o])) {
        const double along = 1.0 / (rays_.distance_sigma[o] * rays_.distance_sigma[o]);
        v.along[l] = along;
        v.shift[l] = along * rays_.distance[o];
        total += rays_.distance[o];
        ++n_measured;
      }
    }
    for (int i = 0; i < 3; ++i) origin_[i][l] = origin[i] / std::max<double>(1.0, static_cast<double>(n));
    const double distance = n_measured > 0 ? total / n_measured : 1.0;
    for (std::int64_t k = 0; k < n; ++k) {
      for (int i = 0; i < 3; ++i) views_[k].centre[i][l] -= origin_[i][l];
      views_[k].distance[l] = distance;
    }
    n_views_[l] = static_cast<double>(n);
    return n_measured > 0;
  }

  void midpoints(Register* at) const {
    const Register one = Splat<Register>::of(1.0);
    for (int round = 0; round < kPlainRounds + kRobustRounds; ++round) {
      Equations sums{};
      for (const View& v : views_) {
        if (round == 0) {
          add(v, v.distance, one, sums);
          continue;
        }
        const Register away[3] = {at[0] - v.centre[0], at[1] - v.centre[1], at[2] - v.centre[2]};
        const Register distance = length3(away);
        add(v, distance, round < kPlainRounds ? one : trust(v, away, distance), sums);
      }
      solve(sums, at);
    }
  }

  BA_INLINE static Register trust(const View& v, const Register* away, const Register& distance) {
    const Register* d = v.direction;
    // Which product of a sum is rounded and which is not, g++ would choose otherwise than of single numbers.
    const Register cross[3] = {held(d[1] * away[2]) - d[2] * away[1], held(d[2] * away[0]) - d[0] * away[2],
                               held(d[0] * away[1]) - d[1] * away[0]};
    const Register sine = root(held(cross[0] * cross[0]) + cross[1] * cross[1] + cross[2] * cross[2]);
    const Register across = sine / larger(distance, 1e-9);
    return kRayHuber / larger(v.px_per_rad * across, kRayHuber);
  }

  BA_INLINE static void add(const View& v, const Register& distance, const Register& trust, Equations& to) {
    const Register slope = v.px_per_rad / larger(distance, 1e-9);
    const Register across = trust * slope * slope, none{};
    // W = across (I - d d') + along d d'
    Register w[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        w[i][j] = (v.along - across) * v.direction[i] * v.direction[j] + (i == j ? across : none);
    for (int i = 0; i < 3; ++i) {
      to.b[i] += w[i][0] * v.centre[0] + w[i][1] * v.centre[1] + w[i][2] * v.centre[2] + v.shift * v.direction[i];
      for (int j = 0; j < 3; ++j) to.a[i][j] += w[i][j];
    }
  }

  // Lane by lane, as each has pivots of its own.
  static void solve(const Equations& sums, Register* x) {
    for (int l = 0; l < kPoints; ++l) {
      double a[3][3], b[3], out[3];
      for (int i = 0; i < 3; ++i) {
        b[i] = sums.b[i][l];
        for (int j = 0; j < 3; ++j) a[i][j] = sums.a[i][j][l];
      }
      const double trace = a[0][0] + a[1][1] + a[2][2];
      // A whiff of damping: parallel rays give a far point instead of a singular matrix.
      for (int i = 0; i < 3; ++i) a[i][i] += 1e-14 * trace + (trace > 0.0 ? 0.0 : 1.0);
      solve3(a, b, out);
      for (int i = 0; i < 3; ++i) x[i][l] = out[i];
    }
  }

  // From the ray farthest from the mean to the ray farthest from that one: the chord of the angle between them.
  Register largest_chords() const {
    Register mean[3] = {}, farthest[3] = {}, widest{};
    for (const View& v : views_)
      for (int i = 0; i < 3; ++i) mean[i] += v.direction[i];
    const Register length = larger(length3(mean), 1e-300);
    for (Register& x : mean) x /= length;
    // Lanes whose points have no k-th view are left as they are: no chord is shorter than nothing.
    const Register none = Splat<Register>::of(-1.0);
    for (std::size_t k = 0; k < views_.size(); ++k) {
      const Register place = Splat<Register>::of(static_cast<double>(k));
      const Register away = select(place < n_views_, chord(views_[k].direction, mean), none);
      for (int i = 0; i < 3; ++i) farthest[i] = select(away >= widest, views_[k].direction[i], farthest[i]);
      widest = select(away >= widest, away, widest);
    }
    widest = Register{};
    for (std::size_t k = 0; k < views_.size(); ++k) {
      const Register place = Splat<Register>::of(static_cast<double>(k));
      const Register away = select(place < n_views_, chord(views_[k].direction, farthest), none);
      widest = select(widest < away, away, widest);
    }
    return widest;
  }

  BA_INLINE static Register chord(const Register* a, const Register* b) {
    const Register between[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return length3(between);
  }

  RaysView rays_;
  std::vector<std::int64_t> begin_, row_;  // of each point's rays; rows by point
  std::vector<View> views_;                // of the points at hand
  Register origin_[3] = {}, n_views_{};
};

}  // namespace ba::BA_TARGET
