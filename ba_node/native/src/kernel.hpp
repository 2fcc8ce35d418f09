// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Linearisation, Schur complement of the points, back-substitution and objective of one problem.
// The equations stand in core/objective.py and core/schur.py, which are this file's oracle.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

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

// Arrays of the caller; see core/problem.py for shapes. They outlive nothing: copied where kept.
struct ProblemView {
  std::int64_t n_keyframes, n_points, n_obs, n_cameras;
  const std::int64_t *keyframe, *camera, *point;
  const double *uv, *sigma, *depth, *depth_sigma;  // depth null if there is none
  const double *camera_rotation, *camera_translation, *params;
  const std::uint8_t* model;
  const bool* fixed;
};

struct StateView {
  const double *rotation, *translation, *points, *intrinsics;  // intrinsics null if the cameras' own are used
};

constexpr double kMinDepth = 1e-6;
constexpr double kBehindNorm = 100.0;
// Of the inner iterations of points, as in core/polish.py.
constexpr double kFirstDamping = 1e-4, kMinDiagonal = 1e-6, kMinGain = 1e-4;

// A column of d = 6 or 9 numbers: a register, and for 9 one more number.
template <int D>
struct Column {
  V8 a;
  double b;
};
template <>
struct Column<6> {
  V8 a;
};

// A d x d block, by columns of eight rows; for 9 also the ninth row.
template <int D>
struct Block {
  V8 col[9];
  V8 row;
  double corner;
  double pad[7];
};
template <>
struct Block<6> {
  V8 col[6];
};

inline double sum(V8 v) { return ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])); }

template <int D>
class Kernel {
 public:
  Kernel(const ProblemView& p, const Rules& rules, const StateView& start) : rules_(rules) {
    copy_problem(p);
    find_edges();
    if (rules_.cheirality == Cheirality::kDrop) find_ignored(start);
  }

  std::int64_t n_free() const { return n_free_; }
  std::int64_t n_points() const { return n_points_; }
  double gradient_norm() const { return gradient_norm_; }

  double linearise(const StateView& s) {
    switch (lens_) {
      case Lens::kPinhole: return linearise_as<Lens::kPinhole>(s);
      case Lens::kRadial: return linearise_as<Lens::kRadial>(s);
      case Lens::kRational: return linearise_as<Lens::kRational>(s);
      default: return linearise_as<Lens::kMixed>(s);
    }
  }

  double objective(const StateView& s) {
    load_images(s);
    switch (lens_) {
      case Lens::kPinhole: return objective_as<Lens::kPinhole>(s);
      case Lens::kRadial: return objective_as<Lens::kRadial>(s);
      case Lens::kRational: return objective_as<Lens::kRational>(s);
      default: return objective_as<Lens::kMixed>(s);
    }
  }

  // Improve each point alone, keyframes held; returns the objective reached. points: in and out.
  double polish_points(const StateView& s, double* points, int steps) {
    load_images(s);
    switch (lens_) {
      case Lens::kPinhole: return polish_as<Lens::kPinhole>(s, points, steps);
      case Lens::kRadial: return polish_as<Lens::kRadial>(s, points, steps);
      case Lens::kRational: return polish_as<Lens::kRational>(s, points, steps);
      default: return polish_as<Lens::kMixed>(s, points, steps);
    }
  }

  // diag(B) (n_free x D) and diag(C) (n_points x 3).
  void diagonals(double* d_c, double* d_p) const {
    for (std::int64_t k = 0; k < n_free_; ++k)
      for (int i = 0; i < D; ++i) d_c[k * D + i] = symmetric_entry(b_[k], i, i);
    for (std::int64_t p = 0; p < n_points_; ++p) {
      d_p[3 * p] = c_[6 * p];
      d_p[3 * p + 1] = c_[6 * p + 2];
      d_p[3 * p + 2] = c_[6 * p + 5];
    }
  }

  // Add damping to the diagonals and factor C; everything below is of this damped system.
  void factor(const double* damping_c, const double* damping_p) {
    damping_c_.assign(damping_c, damping_c + n_free_ * D);
    for (std::int64_t p = 0; p < n_points_; ++p) factor_point(p, damping_p + 3 * p);
    reduce_gradient();
  }

  void rhs(double* out) const {
    for (std::int64_t k = 0; k < n_free_; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(rhs_[k], i);
  }

  // S, symmetric, (n x n), n = n_free D.
  void dense(double* out) {
    const std::int64_t n = n_free_ * D;
    row_.resize(n_free_);
    for (std::int64_t i = 0; i < n_free_; ++i) {
      std::memset(static_cast<void*>(&row_[i]), 0, (n_free_ - i) * sizeof(Block<D>));
      add_row(i, [this](std::int32_t j) -> Block<D>& { return row_[j]; });
      for (std::int64_t j = i; j < n_free_; ++j) {
        double* block = out + i * D * n + j * D;
        write_block(row_[j], block, n);
        if (j == i) add_diagonal(i, block, n);
        for (int r = 0; r < D; ++r)
          for (int c = 0; c < D; ++c) out[(j * D + c) * n + i * D + r] = block[r * n + c];
      }
    }
  }

  // The blocks of S that are not zero, both triangles: D x D each, with their rows and columns.
  void sparse(std::vector<double>& blocks, std::vector<std::int64_t>& rows, std::vector<std::int64_t>& columns) {
    std::vector<std::int32_t> place(n_free_, -1), touched;
    for (std::int64_t i = 0; i < n_free_; ++i) {
      touched.clear();
      row_.clear();
      const auto find = [&](std::int32_t j) -> Block<D>& {
        if (place[j] < 0) {
          place[j] = static_cast<std::int32_t>(touched.size());
          touched.push_back(j);
          row_.emplace_back();
          std::memset(static_cast<void*>(&row_.back()), 0, sizeof(Block<D>));
        }
        return row_[place[j]];
      };
      find(static_cast<std::int32_t>(i));
      add_row(i, find);
      for (std::int32_t j : touched) {
        double block[D * D];
        write_block(row_[place[j]], block, D);
        if (j == i) add_diagonal(i, block, D);
        for (int turned = 0; turned < (j == i ? 1 : 2); ++turned) {
          rows.push_back(turned ? j : i);
          columns.push_back(turned ? i : j);
          for (int r = 0; r < D; ++r)
            for (int c = 0; c < D; ++c) blocks.push_back(turned ? block[c * D + r] : block[r * D + c]);
        }
        place[j] = -1;
      }
    }
  }

  // S x without forming S.
  void product(const double* x, double* out) {
    load_step(x);
    std::vector<Column<D>, Aligned<Column<D>>> y(n_free_);
    for (std::int64_t k = 0; k < n_free_; ++k) y[k] = multiply(b_[k], step_[k]);
    for (std::int64_t p = 0; p < n_points_; ++p) {
      double v[3];
      project_step(p, z_.data(), v);
      for (std::int64_t e = point_edge_[p]; e < point_edge_[p + 1]; ++e) add_scaled(y[edge_column_[e]], &z_[3 * e], v, -1.0);
    }
    for (std::int64_t k = 0; k < n_free_; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(y[k], i) + damping_c_[k * D + i] * x[k * D + i];
  }

  void diagonal_blocks(double* out) {
    for (std::int64_t k = 0; k < n_free_; ++k) {
      Block<D> s;
      std::memset(static_cast<void*>(&s), 0, sizeof(s));
      for (std::int64_t i = keyframe_edge_[k]; i < keyframe_edge_[k + 1]; ++i) {
        const Column<D>* z = &z_[3 * edges_of_keyframe_[i]];
        subtract_product(s, z, z);
      }
      write_block(s, out + k * D * D, D);
      add_diagonal(k, out + k * D * D, D);
    }
  }

  // Step of the points for a step of the free keyframes (n_free x D); returns the reduction of the undamped model.
  double back_substitute(const double* step_c, double* step_p) {
    load_step(step_c);
    double slope = 0, curvature = 0;
    for (std::int64_t k = 0; k < n_free_; ++k) {
      slope += dot(gradient_c_[k], step_[k]);
      curvature += dot(multiply(b_[k], step_[k]), step_[k]);
    }
    for (std::int64_t p = 0; p < n_points_; ++p) {
      double v[3], coupling[3];
      project_step(p, z_.data(), v);
      project_step(p, e_.data(), coupling);
      const double *li = &inverse_l_[6 * p], *y = &scaled_gradient_[3 * p];
      for (int c = 0; c < 3; ++c) v[c] = -y[c] - v[c];
      double* x = step_p + 3 * p;
      x[0] = li[0] * v[0] + li[1] * v[1] + li[3] * v[2];
      x[1] = li[2] * v[1] + li[4] * v[2];
      x[2] = li[5] * v[2];
      const double *c = &c_[6 * p], *g = &gradient_p_[3 * p];
      slope += g[0] * x[0] + g[1] * x[1] + g[2] * x[2];
      curvature += x[0] * (c[0] * x[0] + 2 * (c[1] * x[1] + c[3] * x[2] + coupling[0])) +
                   x[1] * (c[2] * x[1] + 2 * (c[4] * x[2] + coupling[1])) + x[2] * (c[5] * x[2] + 2 * coupling[2]);
    }
    return -slope - 0.5 * curvature;
  }

 private:
  void copy_problem(const ProblemView& p) {
    n_keyframes_ = p.n_keyframes;
    n_points_ = p.n_points;
    n_obs_ = p.n_obs;
    n_cameras_ = p.n_cameras;
    has_depth_ = p.depth != nullptr;
    column_.assign(n_keyframes_, -1);
    n_free_ = 0;
    for (std::int64_t k = 0; k < n_keyframes_; ++k)
      if (!p.fixed[k]) column_[k] = static_cast<std::int32_t>(n_free_++);
    // Order by (point, keyframe): rows of one edge stand together.
    std::vector<std::int64_t> order(n_obs_);
    for (std::int64_t i = 0; i < n_obs_; ++i) order[i] = i;
    std::stable_sort(order.begin(), order.end(), [&](std::int64_t a, std::int64_t b) {
      return p.point[a] != p.point[b] ? p.point[a] < p.point[b] : p.keyframe[a] < p.keyframe[b];
    });
    const std::int64_t padded = (n_obs_ + kLanes - 1) / kLanes * kLanes;
    obs_keyframe_.resize(padded);
    obs_camera_.resize(padded);
    obs_point_.resize(padded);
    u_.resize(padded);
    v_.resize(padded);
    inverse_sigma_.resize(padded);
    if (has_depth_) {
      depth_.resize(padded);
      inverse_depth_sigma_.resize(padded);
    }
    for (std::int64_t i = 0; i < padded; ++i) {
      const std::int64_t o = order[std::min(i, n_obs_ - 1)];
      obs_keyframe_[i] = static_cast<std::int32_t>(p.keyframe[o]);
      obs_camera_[i] = static_cast<std::int32_t>(p.camera[o]);
      obs_point_[i] = static_cast<std::int32_t>(p.point[o]);
      u_[i] = p.uv[2 * o];
      v_[i] = p.uv[2 * o + 1];
      inverse_sigma_[i] = 1.0 / p.sigma[o];
      if (has_depth_) {
        const bool measured = !std::isnan(p.depth[o]);
        depth_[i] = measured ? p.depth[o] : 0.0;
        inverse_depth_sigma_[i] = measured ? 1.0 / p.depth_sigma[o] : 0.0;
      }
    }
    camera_rotation_.assign(p.camera_rotation, p.camera_rotation + 9 * n_cameras_);
    camera_translation_.assign(p.camera_translation, p.camera_translation + 3 * n_cameras_);
    params_.assign(p.params, p.params + kParams * n_cameras_);
    model_.assign(p.model, p.model + n_cameras_);
    choose_lens();
  }

  void choose_lens() {
    lens_ = D == 9 ? Lens::kRadial : Lens::kPinhole;
    for (std::int64_t c = 0; c < n_cameras_; ++c) {
      const double* k = &params_[kParams * c];
      Lens need = Lens::kPinhole;
      for (int i = 4; i < kParams; ++i)
        if (k[i] != 0.0) need = std::max(need, i < 6 ? Lens::kRadial : Lens::kRational);
      if (model_[c] != 0) need = Lens::kMixed;
      lens_ = std::max(lens_, need);
    }
  }

  void find_edges() {
    point_edge_.assign(n_points_ + 1, 0);
    edge_of_.assign(obs_keyframe_.size(), -1);
    std::int64_t i = 0;
    for (std::int64_t p = 0; p < n_points_; ++p) {
      std::int32_t last = -1;
      for (; i < n_obs_ && obs_point_[i] == p; ++i) {
        const std::int32_t column = column_[obs_keyframe_[i]];
        if (column < 0) continue;
        if (column != last) edge_column_.push_back(column);
        last = column;
        edge_of_[i] = static_cast<std::int32_t>(edge_column_.size()) - 1;
      }
      point_edge_[p + 1] = static_cast<std::int64_t>(edge_column_.size());
    }
    e_.resize(3 * edge_column_.size());
    z_.resize(3 * edge_column_.size());
    b_.resize(n_free_);
    gradient_c_.resize(n_free_);
    step_.resize(n_free_);
    rhs_.resize(n_free_);
    c_.resize(6 * n_points_);
    gradient_p_.resize(3 * n_points_);
    inverse_l_.resize(6 * n_points_);
    scaled_gradient_.resize(3 * n_points_);
    index_edges_by_keyframe();
    find_images();
  }

  void index_edges_by_keyframe() {
    keyframe_edge_.assign(n_free_ + 1, 0);
    for (std::int32_t k : edge_column_) ++keyframe_edge_[k + 1];
    for (std::int64_t k = 0; k < n_free_; ++k) keyframe_edge_[k + 1] += keyframe_edge_[k];
    edges_of_keyframe_.resize(edge_column_.size());
    edge_point_end_.resize(edge_column_.size());
    std::vector<std::int64_t> next(keyframe_edge_.begin(), keyframe_edge_.end() - 1);
    for (std::int64_t p = 0; p < n_points_; ++p) {
      for (std::int64_t e = point_edge_[p]; e < point_edge_[p + 1]; ++e) {
        edges_of_keyframe_[next[edge_column_[e]]++] = e;
        edge_point_end_[e] = point_edge_[p + 1];
      }
    }
  }

  void find_images() {
    const auto key = [this](std::size_t o) {
      return static_cast<std::int64_t>(obs_keyframe_[o]) * n_cameras_ + obs_camera_[o];
    };
    for (std::size_t o = 0; o < obs_keyframe_.size(); ++o) images_.push_back(key(o));
    std::sort(images_.begin(), images_.end());
    images_.erase(std::unique(images_.begin(), images_.end()), images_.end());
    obs_image_.resize(obs_keyframe_.size());
    for (std::size_t o = 0; o < obs_keyframe_.size(); ++o)
      obs_image_[o] =
          static_cast<std::int32_t>(std::lower_bound(images_.begin(), images_.end(), key(o)) - images_.begin());
    image_rotation_.resize(9 * images_.size());
    image_translation_.resize(3 * images_.size());
  }

  void load_images(const StateView& s) {
    for (std::size_t m = 0; m < images_.size(); ++m) {
      const std::int64_t k = images_[m] / n_cameras_, c = images_[m] % n_cameras_;
      const double *r = s.rotation + 9 * k, *t = s.translation + 3 * k;
      const double *q = &camera_rotation_[9 * c], *o = &camera_translation_[3 * c];
      double *out = &image_rotation_[9 * m], *move = &image_translation_[3 * m];
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j)
          out[3 * i + j] = q[3 * i] * r[j] + q[3 * i + 1] * r[3 + j] + q[3 * i + 2] * r[6 + j];
        move[i] = q[3 * i] * t[0] + q[3 * i + 1] * t[1] + q[3 * i + 2] * t[2] + o[i];
      }
    }
  }

  // Eight observations from `first` on: their images, points, cameras; points to the camera frame.
  struct Gathered {
    Lanes in;
    alignas(64) double rotation[9][kLanes];
    alignas(64) double point[3][kLanes];
    alignas(64) double used[kLanes];  // 1, or 0 where the row pushes nothing
    alignas(64) double behind[kLanes];
  };

  template <Lens kLens>
  void gather(const StateView& s, const double* points, std::int64_t first, Gathered& g) const {
    alignas(64) double t[3][kLanes];
    for (int l = 0; l < kLanes; ++l) {
      const std::int64_t o = first + l;
      const std::int64_t image = obs_image_[o];
      const double *r = &image_rotation_[9 * image], *move = &image_translation_[3 * image];
      const double* x = points + 3 * static_cast<std::int64_t>(obs_point_[o]);
      const double* k = &params_[kParams * static_cast<std::int64_t>(obs_camera_[o])];
      for (int i = 0; i < 9; ++i) g.rotation[i][l] = r[i];
      for (int i = 0; i < 3; ++i) t[i][l] = move[i];
      for (int i = 0; i < 3; ++i) g.point[i][l] = x[i];
      constexpr int kUsed = kLens == Lens::kPinhole ? 4 : kLens == Lens::kRadial ? 6 : kParams;
      for (int i = 0; i < kUsed; ++i) g.in.param[i][l] = k[i];
      if constexpr (kLens == Lens::kMixed) g.in.fisheye[l] = model_[obs_camera_[o]];
      if constexpr (D == 9) {
        const double* own = s.intrinsics + 3 * static_cast<std::int64_t>(obs_keyframe_[o]);
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

  // Residuals (whitened), their cost and the square root of their weight.
  struct Residuals {
    alignas(64) double r[3][kLanes];
    alignas(64) double root[2][kLanes];  // of the pixel part, of the depth part
    alignas(64) double cost[kLanes];
  };

  void residuals(const Gathered& g, const Projected& q, std::int64_t first, Residuals& out) const {
    const double scale = rules_.loss == Loss::kSquared ? std::numeric_limits<double>::infinity() : rules_.scale;
    const double behind = cost_of(kBehindNorm * kBehindNorm);
    for (int l = 0; l < kLanes; ++l) {
      const double w = inverse_sigma_[first + l] * g.used[l];
      out.r[0][l] = (q.uv[0][l] - u_[first + l]) * w;
      out.r[1][l] = (q.uv[1][l] - v_[first + l]) * w;
      const double n2 = out.r[0][l] * out.r[0][l] + out.r[1][l] * out.r[1][l];
      const double n = std::sqrt(n2);
      const bool in = n <= scale;
      out.cost[l] = in ? n2 : 2 * scale * n - scale * scale;
      out.root[0][l] = in ? 1.0 : std::sqrt(scale / n);
      out.cost[l] += g.behind[l] * behind;
      out.r[2][l] = 0.0;
      out.root[1][l] = 1.0;
    }
    if (has_depth_) {
      for (int l = 0; l < kLanes; ++l) {
        const double r = (g.in.x[2][l] - depth_[first + l]) * inverse_depth_sigma_[first + l] * g.used[l];
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
                  double (&jp)[3][3][kLanes]) const {
    for (int row = 0; row < 2; ++row)
      for (int c = 0; c < 3; ++c)
        for (int l = 0; l < kLanes; ++l)
          jp[row][c][l] = (q.d_x[row][0][l] * g.rotation[c][l] + q.d_x[row][1][l] * g.rotation[3 + c][l] +
                           q.d_x[row][2][l] * g.rotation[6 + c][l]) *
                          (inverse_sigma_[first + l] * g.used[l] * res.root[0][l]);
    if (has_depth_)
      for (int c = 0; c < 3; ++c)
        for (int l = 0; l < kLanes; ++l)
          jp[2][c][l] =
              g.rotation[6 + c][l] * (inverse_depth_sigma_[first + l] * g.used[l] * res.root[1][l]);
  }

  // C (packed 00 10 11 20 21 22) and gp of one chunk, and its costs, added to the points.
  void add_points(const double (&jp)[3][3][kLanes], const double (&rw)[3][kLanes], std::int64_t first, int count,
                  double* c_out, double* g_out) const {
    alignas(64) double part[9][kLanes] = {};
    const int rows = has_depth_ ? 3 : 2;
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
      const std::int64_t p = obs_point_[first + l];
      for (int i = 0; i < 6; ++i) c_out[6 * p + i] += part[i][l];
      for (int i = 0; i < 3; ++i) g_out[3 * p + i] += part[6 + i][l];
    }
  }

  template <Lens kLens>
  double linearise_as(const StateView& s) {
    load_images(s);
    std::memset(static_cast<void*>(b_.data()), 0, b_.size() * sizeof(Block<D>));
    std::memset(static_cast<void*>(gradient_c_.data()), 0, gradient_c_.size() * sizeof(Column<D>));
    std::memset(static_cast<void*>(e_.data()), 0, e_.size() * sizeof(Column<D>));
    std::fill(c_.begin(), c_.end(), 0.0);
    std::fill(gradient_p_.begin(), gradient_p_.end(), 0.0);
    double total = 0;
    for (std::int64_t first = 0; first < n_obs_; first += kLanes) {
      const int count = static_cast<int>(std::min<std::int64_t>(kLanes, n_obs_ - first));
      Gathered g;
      Projected q;
      Residuals res;
      alignas(64) double jp[3][3][kLanes];
      gather<kLens>(s, s.points, first, g);
      project<kLens, true>(g.in, q);
      residuals(g, q, first, res);
      point_rows(g, q, res, first, jp);
      for (int l = 0; l < count; ++l) total += res.cost[l];
      const int rows = has_depth_ ? 3 : 2;
      for (int row = 0; row < rows; ++row)
        for (int l = 0; l < kLanes; ++l) res.r[row][l] *= res.root[row == 2][l];
      add_points(jp, res.r, first, count, c_.data(), gradient_p_.data());
      add_keyframes(g, q, res, jp, first, count);
    }
    double norm2 = 0;
    for (const auto& x : gradient_c_) norm2 += dot(x, x);
    for (double x : gradient_p_) norm2 += x * x;
    gradient_norm_ = std::sqrt(norm2);
    return 0.5 * total;
  }

  void add_keyframes(const Gathered& g, const Projected& q, const Residuals& res, const double (&jp)[3][3][kLanes],
                     std::int64_t first, int count) {
    const int rows = has_depth_ ? 3 : 2;
    alignas(64) double jc[3][8][kLanes];
    alignas(64) double k2[3][kLanes] = {};
    for (int row = 0; row < rows; ++row) {
      for (int l = 0; l < kLanes; ++l) {
        const double a = jp[row][0][l], b = jp[row][1][l], c = jp[row][2][l];
        const double x = g.point[0][l], y = g.point[1][l], z = g.point[2][l];
        jc[row][0][l] = y * c - z * b;
        jc[row][1][l] = z * a - x * c;
        jc[row][2][l] = x * b - y * a;
        jc[row][3][l] = a;
        jc[row][4][l] = b;
        jc[row][5][l] = c;
        jc[row][6][l] = jc[row][7][l] = 0.0;
        if constexpr (D == 9) {
          if (row < 2) {
            const double w = inverse_sigma_[first + l] * g.used[l] * res.root[0][l];
            jc[row][6][l] = q.d_intrinsics[row][0][l] * w;
            jc[row][7][l] = q.d_intrinsics[row][1][l] * w;
            k2[row][l] = q.d_intrinsics[row][2][l] * w;
          }
        }
      }
    }
    for (int l = 0; l < count; ++l) {
      const std::int32_t edge = edge_of_[first + l];
      if (edge < 0) continue;
      const std::int32_t k = edge_column_[edge];
      Block<D>& b = b_[k];
      Column<D>* e = &e_[3 * static_cast<std::int64_t>(edge)];
      Column<D>& gc = gradient_c_[k];
      for (int row = 0; row < rows; ++row) {
        V8 j;
        for (int i = 0; i < 8; ++i) j[i] = jc[row][i][l];
        for (int c = 0; c < (D == 9 ? 8 : 6); ++c) b.col[c] += j * jc[row][c][l];
        gc.a += j * res.r[row][l];
        for (int c = 0; c < 3; ++c) e[c].a += j * jp[row][c][l];
        if constexpr (D == 9) {
          const double last = k2[row][l];
          b.col[8] += j * last;
          b.corner += last * last;
          gc.b += last * res.r[row][l];
          for (int c = 0; c < 3; ++c) e[c].b += last * jp[row][c][l];
        }
      }
    }
  }

  template <Lens kLens>
  double objective_as(const StateView& s) const {
    double total = 0;
    for (std::int64_t first = 0; first < n_obs_; first += kLanes) {
      const int count = static_cast<int>(std::min<std::int64_t>(kLanes, n_obs_ - first));
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
    Buffer<double> c(6 * n_points_), g(3 * n_points_), cost(n_points_), best(points, points + 3 * n_points_);
    Buffer<double> best_cost(n_points_, std::numeric_limits<double>::infinity());
    double mu = kFirstDamping;
    std::vector<std::uint8_t> done(n_points_, 0);
    for (int step = 0; step <= steps; ++step) {
      std::fill(c.begin(), c.end(), 0.0);
      std::fill(g.begin(), g.end(), 0.0);
      std::fill(cost.begin(), cost.end(), 0.0);
      for (std::int64_t first = 0; first < n_obs_; first += kLanes) {
        const int count = static_cast<int>(std::min<std::int64_t>(kLanes, n_obs_ - first));
        bool all = true;
        for (int l = 0; l < count; ++l) all = all && done[obs_point_[first + l]] != 0;
        if (all) continue;
        Gathered ga;
        Projected q;
        Residuals res;
        alignas(64) double jp[3][3][kLanes];
        gather<kLens>(s, points, first, ga);
        project<kLens, true>(ga.in, q);
        residuals(ga, q, first, res);
        point_rows(ga, q, res, first, jp);
        for (int l = 0; l < count; ++l) cost[obs_point_[first + l]] += res.cost[l];
        for (int row = 0; row < (has_depth_ ? 3 : 2); ++row)
          for (int l = 0; l < kLanes; ++l) res.r[row][l] *= res.root[row == 2][l];
        add_points(jp, res.r, first, count, c.data(), g.data());
      }
      for (std::int64_t p = 0; p < n_points_; ++p) {
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
    ignored_.assign(obs_keyframe_.size(), 0);
    for (std::size_t o = 0; o < ignored_.size(); ++o) {
      const std::int64_t image = obs_image_[o];
      const double *r = &image_rotation_[9 * image] + 6, *x = s.points + 3 * static_cast<std::int64_t>(obs_point_[o]);
      const double z = r[0] * x[0] + r[1] * x[1] + r[2] * x[2] + image_translation_[3 * image + 2];
      ignored_[o] = z <= kMinDepth;
    }
  }

  // L^-1 of C plus damping, packed 00 10 11 20 21 22; rows of undetermined directions are zero.
  static void inverse_cholesky(const double* c, const double* damping, double* li) {
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

  void factor_point(std::int64_t p, const double* damping) {
    double* li = &inverse_l_[6 * p];
    inverse_cholesky(&c_[6 * p], damping, li);
    const double* g = &gradient_p_[3 * p];
    double* y = &scaled_gradient_[3 * p];
    y[0] = li[0] * g[0];
    y[1] = li[1] * g[0] + li[2] * g[1];
    y[2] = li[3] * g[0] + li[4] * g[1] + li[5] * g[2];
    for (std::int64_t e = point_edge_[p]; e < point_edge_[p + 1]; ++e) {
      const Column<D>* in = &e_[3 * e];
      Column<D>* out = &z_[3 * e];
      out[0].a = in[0].a * li[0];
      out[1].a = in[0].a * li[1] + in[1].a * li[2];
      out[2].a = in[0].a * li[3] + in[1].a * li[4] + in[2].a * li[5];
      if constexpr (D == 9) {
        out[0].b = in[0].b * li[0];
        out[1].b = in[0].b * li[1] + in[1].b * li[2];
        out[2].b = in[0].b * li[3] + in[1].b * li[4] + in[2].b * li[5];
      }
    }
  }

  // -gc + Z L^-1 gp.
  void reduce_gradient() {
    for (std::int64_t k = 0; k < n_free_; ++k) {
      rhs_[k].a = -gradient_c_[k].a;
      if constexpr (D == 9) rhs_[k].b = -gradient_c_[k].b;
    }
    for (std::int64_t p = 0; p < n_points_; ++p)
      for (std::int64_t e = point_edge_[p]; e < point_edge_[p + 1]; ++e)
        add_scaled(rhs_[edge_column_[e]], &z_[3 * e], &scaled_gradient_[3 * p], 1.0);
  }

  // out += sign (three columns) v.
  static void add_scaled(Column<D>& out, const Column<D>* columns, const double* v, double sign) {
    for (int c = 0; c < 3; ++c) {
      out.a += columns[c].a * (sign * v[c]);
      if constexpr (D == 9) out.b += columns[c].b * (sign * v[c]);
    }
  }

  // Sum over the edges of a point of (three columns)' (the keyframe's step).
  void project_step(std::int64_t p, const Column<D>* columns, double* out) const {
    V8 acc[3] = {};
    double last[3] = {};
    for (std::int64_t e = point_edge_[p]; e < point_edge_[p + 1]; ++e) {
      const Column<D>& x = step_[edge_column_[e]];
      for (int c = 0; c < 3; ++c) {
        acc[c] += columns[3 * e + c].a * x.a;
        if constexpr (D == 9) last[c] += columns[3 * e + c].b * x.b;
      }
    }
    for (int c = 0; c < 3; ++c) out[c] = sum(acc[c]) + last[c];
  }

  // Row i of -Z Z' from the diagonal on; `block` finds the block of a column.
  template <class Find>
  void add_row(std::int64_t i, Find block) {
    for (std::int64_t k = keyframe_edge_[i]; k < keyframe_edge_[i + 1]; ++k) {
      const std::int64_t e = edges_of_keyframe_[k], end = edge_point_end_[e];
      for (std::int64_t f = e; f < end; ++f) subtract_product(block(edge_column_[f]), &z_[3 * e], &z_[3 * f]);
    }
  }

  static void write_block(const Block<D>& s, double* out, std::int64_t stride) {
    for (int c = 0; c < D; ++c)
      for (int r = 0; r < D; ++r) out[r * stride + c] = entry(s, r, c);
  }

  // B and the damping of keyframe k, onto its diagonal block.
  void add_diagonal(std::int64_t k, double* out, std::int64_t stride) const {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) out[r * stride + c] += symmetric_entry(b_[k], r, c);
      out[r * (stride + 1)] += damping_c_[k * D + r];
    }
  }

  static void subtract_product(Block<D>& s, const Column<D>* x, const Column<D>* y) {
    for (int c = 0; c < (D == 9 ? 8 : 6); ++c)
      s.col[c] -= x[0].a * y[0].a[c] + x[1].a * y[1].a[c] + x[2].a * y[2].a[c];
    if constexpr (D == 9) {
      s.col[8] -= x[0].a * y[0].b + x[1].a * y[1].b + x[2].a * y[2].b;
      s.row -= y[0].a * x[0].b + y[1].a * x[1].b + y[2].a * x[2].b;
      s.corner -= x[0].b * y[0].b + x[1].b * y[1].b + x[2].b * y[2].b;
    }
  }

  // Entry (r, c) of a block; B keeps no ninth row, it is symmetric.
  static double entry(const Block<D>& s, int r, int c) {
    if constexpr (D == 9) {
      if (r == 8) return c == 8 ? s.corner : s.row[c];
    }
    return s.col[c][r];
  }
  static double symmetric_entry(const Block<D>& s, int r, int c) {
    if constexpr (D == 9) {
      if (r == 8 && c == 8) return s.corner;
      if (r == 8) return s.col[8][c];
    }
    return s.col[c][r];
  }

  static double at(const Column<D>& x, int i) {
    if constexpr (D == 9) {
      if (i == 8) return x.b;
    }
    return x.a[i];
  }

  void load_step(const double* step) {
    for (std::int64_t k = 0; k < n_free_; ++k) {
      V8 a = {};
      for (int i = 0; i < (D == 9 ? 8 : 6); ++i) a[i] = step[k * D + i];
      step_[k].a = a;
      if constexpr (D == 9) step_[k].b = step[k * D + 8];
    }
  }

  static double dot(const Column<D>& x, const Column<D>& y) {
    double out = sum(x.a * y.a);
    if constexpr (D == 9) out += x.b * y.b;
    return out;
  }

  static Column<D> multiply(const Block<D>& b, const Column<D>& x) {
    Column<D> out;
    V8 a = {};
    for (int c = 0; c < (D == 9 ? 8 : 6); ++c) a += b.col[c] * x.a[c];
    if constexpr (D == 9) {
      out.b = sum(b.col[8] * x.a) + b.corner * x.b;
      a += b.col[8] * x.b;
    }
    out.a = a;
    return out;
  }

  Rules rules_;
  Lens lens_ = Lens::kPinhole;
  bool has_depth_ = false;
  std::int64_t n_keyframes_ = 0, n_points_ = 0, n_obs_ = 0, n_cameras_ = 0, n_free_ = 0;
  double gradient_norm_ = 0;
  std::vector<std::int32_t> column_, obs_keyframe_, obs_camera_, obs_point_, obs_image_, edge_column_, edge_of_;
  std::vector<std::int64_t> point_edge_, images_, keyframe_edge_, edges_of_keyframe_, edge_point_end_;
  std::vector<std::uint8_t> model_, ignored_;
  Buffer<double> u_, v_, inverse_sigma_, depth_, inverse_depth_sigma_;
  std::vector<double> camera_rotation_, camera_translation_, params_, damping_c_, image_rotation_, image_translation_;
  Buffer<Block<D>> b_, row_;
  Buffer<Column<D>> e_, z_, gradient_c_, rhs_, step_;
  Buffer<double> c_, gradient_p_, inverse_l_, scaled_gradient_;
};

}  // namespace ba
