// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What a state says about the observations alone: residuals, derivatives by the points, the robust objective, and the
// polishing of points. The equations stand in core/objective.py and core/polish.py, which are this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>
#include <vector>

#include "layout.hpp"
#include "project.hpp"
#include "simd.hpp"

namespace ba {

enum class Loss : std::uint8_t { kSquared, kHuber };
enum class Cheirality : std::uint8_t { kKeep, kConstant, kDrop };

struct Rules {
  Loss loss = Loss::kSquared;
  double scale = 1.0;
  Cheirality cheirality = Cheirality::kKeep;
};

constexpr double kMinDepth = 1e-6;
constexpr double kBehindNorm = 100.0;
// Of the polishing of points.
constexpr double kFirstDamping = 1e-4, kMinDiagonal = 1e-6, kMinGain = 1e-4;

// Eight observations: their images, points and cameras; their points in the camera frame.
struct Gathered {
  Lanes in;
  alignas(64) double rotation[9][kLanes];
  alignas(64) double point[3][kLanes];
  alignas(64) double used[kLanes];  // 1, or 0 where the row pushes nothing
  alignas(64) double behind[kLanes];
};

// Residuals (whitened), their cost and the square root of their weight.
struct Residuals {
  alignas(64) double r[3][kLanes];
  alignas(64) double root[2][kLanes];  // of the pixel part, of the depth part
  alignas(64) double cost[kLanes];
};

using PointRows = double[3][3][kLanes];

// L^-1 of C plus damping, packed 00 10 11 20 21 22; rows of undetermined directions are zero.
inline void inverse_cholesky(const double* c, const double* damping, double* li) {
  const double d0 = c[0] + damping[0], d1 = c[2] + damping[1], d2 = c[5] + damping[2];
  const double floor = 1e-14 * std::max(d0, std::max(d1, d2)) + 1e-300;
  const auto root = [floor](double pivot) { return pivot > floor ? 1.0 / std::sqrt(pivot) : 0.0; };
  const double i00 = root(d0);
  const double l10 = c[1] * i00, l20 = c[3] * i00;
  const double i11 = root(d1 - l10 * l10);
  const double l21 = (c[4] - l20 * l10) * i11;
  const double i22 = root(d2 - l20 * l20 - l21 * l21);
  li[0] = i00;
  li[1] = -l10 * i00 * i11;
  li[2] = i11;
  li[3] = -(l20 * i00 + l21 * li[1]) * i22;
  li[4] = -l21 * i11 * i22;
  li[5] = i22;
}

class Rows {
 public:
  Rows(const Layout& layout, const Rules& rules, const StateView& start) : l_(layout), rules_(rules) {
    image_rotation_.resize(9 * l_.images.size());
    image_translation_.resize(3 * l_.images.size());
    if (rules_.cheirality == Cheirality::kDrop) find_ignored(start);
  }

  // Call f<lens>() for the lens that the problem needs.
  template <class F>
  auto with_lens(F f) const {
    switch (l_.lens) {
      case Lens::kPinhole: return f(std::integral_constant<Lens, Lens::kPinhole>());
      case Lens::kRadial: return f(std::integral_constant<Lens, Lens::kRadial>());
      case Lens::kRational: return f(std::integral_constant<Lens, Lens::kRational>());
      default: return f(std::integral_constant<Lens, Lens::kMixed>());
    }
  }

  double objective(const StateView& s) {
    load_images(s);
    return with_lens([&](auto lens) { return objective_as<decltype(lens)::value>(s); });
  }

  // Improve each point alone, keyframes held; returns the objective reached. points: in and out.
  double polish_points(const StateView& s, double* points, int steps) {
    load_images(s);
    return with_lens([&](auto lens) { return polish_as<decltype(lens)::value>(s, points, steps); });
  }

  void load_images(const StateView& s) {
    for (std::size_t m = 0; m < l_.images.size(); ++m) {
      const std::int64_t k = l_.images[m] / l_.n_cameras, c = l_.images[m] % l_.n_cameras;
      const double *r = s.rotation + 9 * k, *t = s.translation + 3 * k;
      const double *q = &l_.camera_rotation[9 * c], *o = &l_.camera_translation[3 * c];
      double *out = &image_rotation_[9 * m], *move = &image_translation_[3 * m];
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j)
          out[3 * i + j] = q[3 * i] * r[j] + q[3 * i + 1] * r[3 + j] + q[3 * i + 2] * r[6 + j];
        move[i] = q[3 * i] * t[0] + q[3 * i + 1] * t[1] + q[3 * i + 2] * t[2] + o[i];
      }
    }
  }

  // Eight observations from `first` on; points may be others than the state's.
  template <Lens kLens>
  void gather(const StateView& s, const double* points, std::int64_t first, Gathered& g) const {
    alignas(64) double t[3][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const std::int64_t o = first + l;
      const std::int64_t image = l_.obs_image[o];
      const double *r = &image_rotation_[9 * image], *move = &image_translation_[3 * image];
      const double* x = points + 3 * static_cast<std::int64_t>(l_.obs_point[o]);
      const double* k = &l_.params[kParams * static_cast<std::int64_t>(l_.obs_camera[o])];
      for (int i = 0; i < 9; ++i) g.rotation[i][l] = r[i];
      for (int i = 0; i < 3; ++i) t[i][l] = move[i];
      for (int i = 0; i < 3; ++i) g.point[i][l] = x[i];
      constexpr int kUsed = kLens == Lens::kPinhole ? 4 : kLens == Lens::kRadial ? 6 : kParams;
      for (int i = 0; i < kUsed; ++i) g.in.param[i][l] = k[i];
      if constexpr (kLens == Lens::kMixed) g.in.fisheye[l] = l_.model[l_.obs_camera[o]];
      if (l_.own_intrinsics) {
        const double* own = s.intrinsics + 3 * static_cast<std::int64_t>(l_.obs_keyframe[o]);
        g.in.param[0][l] *= own[0];
        g.in.param[1][l] *= own[0];
        g.in.param[4][l] += own[1];
        g.in.param[5][l] += own[2];
      }
    }
    for (int i = 0; i < 3; ++i)
      for (int l = 0; l < kLanes; ++l)
        g.in.x[i][l] = g.rotation[3 * i][l] * g.point[0][l] + g.rotation[3 * i + 1][l] * g.point[1][l] +
                       g.rotation[3 * i + 2][l] * g.point[2][l] + t[i][l];
    mask(first, g);
  }

  void residuals(const Gathered& g, const Projected& q, std::int64_t first, Residuals& out) const {
    const double scale = rules_.loss == Loss::kSquared ? std::numeric_limits<double>::infinity() : rules_.scale;
    const double behind = cost_of(kBehindNorm * kBehindNorm);
    for (int l = 0; l < kLanes; ++l) {
      const double w = l_.inverse_sigma[first + l] * g.used[l];
      out.r[0][l] = (q.uv[0][l] - l_.u[first + l]) * w;
      out.r[1][l] = (q.uv[1][l] - l_.v[first + l]) * w;
      const double n2 = out.r[0][l] * out.r[0][l] + out.r[1][l] * out.r[1][l];
      const double n = std::sqrt(n2);
      const bool in = n <= scale;
      out.cost[l] = in ? n2 : 2 * scale * n - scale * scale;
      out.root[0][l] = in ? 1.0 : std::sqrt(scale / n);
      out.cost[l] += g.behind[l] * behind;
      out.r[2][l] = 0.0;
      out.root[1][l] = 1.0;
    }
    if (l_.has_depth) {
      for (int l = 0; l < kLanes; ++l) {
        const double r = (g.in.x[2][l] - l_.depth[first + l]) * l_.inverse_depth_sigma[first + l] * g.used[l];
        const double n = std::abs(r);
        const bool in = n <= scale;
        out.r[2][l] = r;
        out.cost[l] += in ? r * r : 2 * scale * n - scale * scale;
        out.root[1][l] = in ? 1.0 : std::sqrt(scale / n);
      }
    }
  }

  // Weighted derivative of a row by the point: (d uv / d x_cam) R, and R's last row for depth.
  void point_rows(const Gathered& g, const Projected& q, const Residuals& res, std::int64_t first,
                  PointRows& jp) const {
    for (int row = 0; row < 2; ++row)
      for (int c = 0; c < 3; ++c)
        for (int l = 0; l < kLanes; ++l)
          jp[row][c][l] = (q.d_x[row][0][l] * g.rotation[c][l] + q.d_x[row][1][l] * g.rotation[3 + c][l] +
                           q.d_x[row][2][l] * g.rotation[6 + c][l]) *
                          (l_.inverse_sigma[first + l] * g.used[l] * res.root[0][l]);
    if (l_.has_depth)
      for (int c = 0; c < 3; ++c)
        for (int l = 0; l < kLanes; ++l)
          jp[2][c][l] =
              g.rotation[6 + c][l] * (l_.inverse_depth_sigma[first + l] * g.used[l] * res.root[1][l]);
  }

  // C (packed 00 10 11 20 21 22) and gp of one chunk, and its costs, added to the points.
  void add_points(const PointRows& jp, const double (&rw)[3][kLanes], std::int64_t first, int count,
                  double* c_out, double* g_out) const {
    alignas(64) double part[9][kLanes] = {};
    const int rows = l_.has_depth ? 3 : 2;
    for (int row = 0; row < rows; ++row) {
      for (int l = 0; l < kLanes; ++l) {
        const double a = jp[row][0][l], b = jp[row][1][l], c = jp[row][2][l], r = rw[row][l];
        part[0][l] += a * a;
        part[1][l] += b * a;
        part[2][l] += b * b;
        part[3][l] += c * a;
        part[4][l] += c * b;
        part[5][l] += c * c;
        part[6][l] += a * r;
        part[7][l] += b * r;
        part[8][l] += c * r;
      }
    }
    for (int l = 0; l < count; ++l) {
      const std::int64_t p = l_.obs_point[first + l];
      for (int i = 0; i < 6; ++i) c_out[6 * p + i] += part[i][l];
      for (int i = 0; i < 3; ++i) g_out[3 * p + i] += part[6 + i][l];
    }
  }

 private:
  void mask(std::int64_t first, Gathered& g) const {
    const bool keep = rules_.cheirality == Cheirality::kKeep;
    for (int l = 0; l < kLanes; ++l) {
      const double z = g.in.x[2][l];
      const bool out = keep ? std::abs(z) < kMinDepth * 1e-6 : z <= kMinDepth;
      g.behind[l] = out && !keep ? 1.0 : 0.0;
      g.used[l] = out ? 0.0 : 1.0;
      g.in.x[0][l] = out ? 0.0 : g.in.x[0][l];
      g.in.x[1][l] = out ? 0.0 : g.in.x[1][l];
      g.in.x[2][l] = out ? 1.0 : z;
    }
    if (!ignored_.empty()) {
      for (int l = 0; l < kLanes; ++l) {
        if (ignored_[first + l]) {
          g.used[l] = g.behind[l] = 0.0;
          g.in.x[0][l] = g.in.x[1][l] = 0.0;
          g.in.x[2][l] = 1.0;
        }
      }
    }
  }

  double cost_of(double norm2) const {
    if (rules_.loss == Loss::kSquared || norm2 <= rules_.scale * rules_.scale) return norm2;
    return 2 * rules_.scale * std::sqrt(norm2) - rules_.scale * rules_.scale;
  }

  template <Lens kLens>
  double objective_as(const StateView& s) const {
    double total = 0;
    for (std::int64_t first = 0; first < l_.n_obs; first += kLanes) {
      const int count = static_cast<int>(std::min<std::int64_t>(kLanes, l_.n_obs - first));
      Gathered g;
      Projected q;
      Residuals res;
      gather<kLens>(s, s.points, first, g);
      project<kLens, false>(g.in, q);
      residuals(g, q, first, res);
      for (int l = 0; l < count; ++l) total += res.cost[l];
    }
    return 0.5 * total;
  }

  template <Lens kLens>
  double polish_as(const StateView& s, double* points, int steps) {
    Buffer<double> c(6 * l_.n_points), g(3 * l_.n_points), cost(l_.n_points), best(points, points + 3 * l_.n_points);
    Buffer<double> best_cost(l_.n_points, std::numeric_limits<double>::infinity());
    double mu = kFirstDamping;
    std::vector<std::uint8_t> done(l_.n_points, 0);
    for (int step = 0; step <= steps; ++step) {
      std::fill(c.begin(), c.end(), 0.0);
      std::fill(g.begin(), g.end(), 0.0);
      std::fill(cost.begin(), cost.end(), 0.0);
      for (std::int64_t first = 0; first < l_.n_obs; first += kLanes) {
        const int count = static_cast<int>(std::min<std::int64_t>(kLanes, l_.n_obs - first));
        bool all = true;
        for (int l = 0; l < count; ++l) all = all && done[l_.obs_point[first + l]] != 0;
        if (all) continue;
        Gathered ga;
        Projected q;
        Residuals res;
        alignas(64) PointRows jp;
        gather<kLens>(s, points, first, ga);
        project<kLens, true>(ga.in, q);
        residuals(ga, q, first, res);
        point_rows(ga, q, res, first, jp);
        for (int l = 0; l < count; ++l) cost[l_.obs_point[first + l]] += res.cost[l];
        for (int row = 0; row < (l_.has_depth ? 3 : 2); ++row)
          for (int l = 0; l < kLanes; ++l) res.r[row][l] *= res.root[row == 2][l];
        add_points(jp, res.r, first, count, c.data(), g.data());
      }
      for (std::int64_t p = 0; p < l_.n_points; ++p) {
        if (done[p]) continue;
        double* x = points + 3 * p;
        if (!(cost[p] < best_cost[p])) {  // worse, or not a number: back, and that was it
          std::copy_n(&best[3 * p], 3, x);
          done[p] = 1;
          continue;
        }
        const bool small = best_cost[p] - cost[p] < kMinGain * cost[p];
        best_cost[p] = cost[p];
        std::copy_n(x, 3, &best[3 * p]);
        if (step == steps || small) {
          done[p] = 1;
          continue;
        }
        double li[6], v[3];
        const double* cp = &c[6 * p];
        const double damping[3] = {mu * std::max(cp[0], kMinDiagonal), mu * std::max(cp[2], kMinDiagonal),
                                   mu * std::max(cp[5], kMinDiagonal)};
        inverse_cholesky(cp, damping, li);
        v[0] = li[0] * g[3 * p];
        v[1] = li[1] * g[3 * p] + li[2] * g[3 * p + 1];
        v[2] = li[3] * g[3 * p] + li[4] * g[3 * p + 1] + li[5] * g[3 * p + 2];
        x[0] -= li[0] * v[0] + li[1] * v[1] + li[3] * v[2];
        x[1] -= li[2] * v[1] + li[4] * v[2];
        x[2] -= li[5] * v[2];
      }
      mu *= 0.1;
    }
    double total = 0;
    for (double x : best_cost) total += std::isfinite(x) ? x : 0.0;
    return 0.5 * total;
  }

  void find_ignored(const StateView& s) {
    load_images(s);
    ignored_.assign(l_.obs_keyframe.size(), 0);
    for (std::size_t o = 0; o < ignored_.size(); ++o) {
      const std::int64_t image = l_.obs_image[o];
      const double *r = &image_rotation_[9 * image] + 6, *x = s.points + 3 * static_cast<std::int64_t>(l_.obs_point[o]);
      const double z = r[0] * x[0] + r[1] * x[1] + r[2] * x[2] + image_translation_[3 * image + 2];
      ignored_[o] = z <= kMinDepth;
    }
  }

  const Layout& l_;
  Rules rules_;
  std::vector<double> image_rotation_, image_translation_;
  std::vector<std::uint8_t> ignored_;
};

}  // namespace ba
