// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Normal equations of one problem, the Schur complement of the points, and back-substitution.
// The equations stand in core/schur.py, which is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "blocks.hpp"
#include "layout.hpp"
#include "rows.hpp"

namespace ba {

template <int D>
class Kernel {
 public:
  Kernel(const ProblemView& problem, const Rules& rules, const StateView& start)
      : l_(problem, D == 9), rows_(l_, rules, start) {
    e_.resize(3 * l_.edge_column.size());
    z_.resize(3 * l_.edge_column.size());
    b_.resize(l_.n_free);
    gradient_c_.resize(l_.n_free);
    rhs_.resize(l_.n_free);
    step_.resize(l_.n_free);
    product_.resize(l_.n_free);
    c_.resize(6 * l_.n_points);
    gradient_p_.resize(3 * l_.n_points);
    inverse_l_.resize(6 * l_.n_points);
    scaled_gradient_.resize(3 * l_.n_points);
  }
  // The parts refer to one another.
  Kernel(const Kernel&) = delete;
  Kernel& operator=(const Kernel&) = delete;

  std::int64_t n_free() const { return l_.n_free; }
  std::int64_t n_points() const { return l_.n_points; }
  double gradient_norm() const { return gradient_norm_; }

  double objective(const StateView& s) { return rows_.objective(s); }
  double polish_points(const StateView& s, double* points, int steps) { return rows_.polish_points(s, points, steps); }

  double linearise(const StateView& s) {
    rows_.load_images(s);
    return rows_.with_lens([&](auto lens) { return linearise_as<decltype(lens)::value>(s); });
  }

  // diag(B) (n_free x D) and diag(C) (n_points x 3).
  void diagonals(double* d_c, double* d_p) const {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) d_c[k * D + i] = symmetric_entry(b_[k], i, i);
    for (std::int64_t p = 0; p < l_.n_points; ++p) {
      d_p[3 * p] = c_[6 * p];
      d_p[3 * p + 1] = c_[6 * p + 2];
      d_p[3 * p + 2] = c_[6 * p + 5];
    }
  }

  // Add damping to the diagonals and factor C; everything below is of this damped system.
  void factor(const double* damping_c, const double* damping_p) {
    damping_c_.assign(damping_c, damping_c + l_.n_free * D);
    for (std::int64_t p = 0; p < l_.n_points; ++p) factor_point(p, damping_p + 3 * p);
    reduce_gradient();
  }

  void rhs(double* out) const {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(rhs_[k], i);
  }

  // S, symmetric, (n x n), n = n_free D.
  void dense(double* out) {
    const std::int64_t n = l_.n_free * D;
    row_.resize(l_.n_free);
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      clear(&row_[i], l_.n_free - i);
      add_row(i, [this](std::int32_t j) -> Block<D>& { return row_[j]; });
      for (std::int64_t j = i; j < l_.n_free; ++j) {
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
    std::vector<std::int32_t> place(l_.n_free, -1), touched;
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      touched.clear();
      row_.clear();
      const auto find = [&](std::int32_t j) -> Block<D>& {
        if (place[j] < 0) {
          place[j] = static_cast<std::int32_t>(touched.size());
          touched.push_back(j);
          row_.emplace_back();
          clear(&row_.back(), 1);
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
    Buffer<Column<D>>& y = product_;
    for (std::int64_t k = 0; k < l_.n_free; ++k) y[k] = multiply(b_[k], step_[k]);
    for (std::int64_t p = 0; p < l_.n_points; ++p) {
      double v[3];
      project_step(p, z_.data(), v);
      for (std::int64_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e) add_scaled(y[l_.edge_column[e]], &z_[3 * e], v, -1.0);
    }
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(y[k], i) + damping_c_[k * D + i] * x[k * D + i];
  }

  void diagonal_blocks(double* out) {
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      Block<D> s;
      clear(&s, 1);
      for (std::int64_t i = l_.keyframe_edge[k]; i < l_.keyframe_edge[k + 1]; ++i) {
        const Column<D>* z = &z_[3 * l_.edges_of_keyframe[i]];
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
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      slope += dot(gradient_c_[k], step_[k]);
      curvature += dot(multiply(b_[k], step_[k]), step_[k]);
    }
    for (std::int64_t p = 0; p < l_.n_points; ++p) {
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
  template <Lens kLens>
  double linearise_as(const StateView& s) {
    clear(b_.data(), l_.n_free);
    clear(gradient_c_.data(), l_.n_free);
    clear(e_.data(), static_cast<std::int64_t>(e_.size()));
    std::fill(c_.begin(), c_.end(), 0.0);
    std::fill(gradient_p_.begin(), gradient_p_.end(), 0.0);
    double total = 0;
    for (std::int64_t first = 0; first < l_.n_obs; first += kLanes) {
      const int count = static_cast<int>(std::min<std::int64_t>(kLanes, l_.n_obs - first));
      Gathered g;
      Projected q;
      Residuals res;
      alignas(64) PointRows jp;
      rows_.template gather<kLens>(s, s.points, first, g);
      project<kLens, true>(g.in, q);
      rows_.residuals(g, q, first, res);
      rows_.point_rows(g, q, res, first, jp);
      for (int l = 0; l < count; ++l) total += res.cost[l];
      const int rows = l_.has_depth ? 3 : 2;
      for (int row = 0; row < rows; ++row)
        for (int l = 0; l < kLanes; ++l) res.r[row][l] *= res.root[row == 2][l];
      rows_.add_points(jp, res.r, first, count, c_.data(), gradient_p_.data());
      add_keyframes(g, q, res, jp, first, count);
    }
    double norm2 = 0;
    for (const auto& x : gradient_c_) norm2 += dot(x, x);
    for (double x : gradient_p_) norm2 += x * x;
    gradient_norm_ = std::sqrt(norm2);
    return 0.5 * total;
  }

  void add_keyframes(const Gathered& g, const Projected& q, const Residuals& res, const PointRows& jp,
                     std::int64_t first, int count) {
    const int rows = l_.has_depth ? 3 : 2;
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
            const double w = l_.inverse_sigma[first + l] * g.used[l] * res.root[0][l];
            jc[row][6][l] = q.d_intrinsics[row][0][l] * w;
            jc[row][7][l] = q.d_intrinsics[row][1][l] * w;
            k2[row][l] = q.d_intrinsics[row][2][l] * w;
          }
        }
      }
    }
    for (int l = 0; l < count; ++l) {
      const std::int32_t edge = l_.obs_edge[first + l];
      if (edge < 0) continue;
      const std::int32_t k = l_.edge_column[edge];
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

  void factor_point(std::int64_t p, const double* damping) {
    double* li = &inverse_l_[6 * p];
    inverse_cholesky(&c_[6 * p], damping, li);
    const double* g = &gradient_p_[3 * p];
    double* y = &scaled_gradient_[3 * p];
    y[0] = li[0] * g[0];
    y[1] = li[1] * g[0] + li[2] * g[1];
    y[2] = li[3] * g[0] + li[4] * g[1] + li[5] * g[2];
    for (std::int64_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e) {
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
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      rhs_[k].a = -gradient_c_[k].a;
      if constexpr (D == 9) rhs_[k].b = -gradient_c_[k].b;
    }
    for (std::int64_t p = 0; p < l_.n_points; ++p)
      for (std::int64_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e)
        add_scaled(rhs_[l_.edge_column[e]], &z_[3 * e], &scaled_gradient_[3 * p], 1.0);
  }

  // Sum over the edges of a point of (three columns)' (the keyframe's step).
  void project_step(std::int64_t p, const Column<D>* columns, double* out) const {
    V8 acc[3] = {};
    double last[3] = {};
    for (std::int64_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e) {
      const Column<D>& x = step_[l_.edge_column[e]];
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
    for (std::int64_t k = l_.keyframe_edge[i]; k < l_.keyframe_edge[i + 1]; ++k) {
      const std::int64_t e = l_.edges_of_keyframe[k], end = l_.edge_point_end[e];
      for (std::int64_t f = e; f < end; ++f) subtract_product(block(l_.edge_column[f]), &z_[3 * e], &z_[3 * f]);
    }
  }

  // B and the damping of keyframe k, onto its diagonal block.
  void add_diagonal(std::int64_t k, double* out, std::int64_t stride) const {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) out[r * stride + c] += symmetric_entry(b_[k], r, c);
      out[r * (stride + 1)] += damping_c_[k * D + r];
    }
  }

  void load_step(const double* step) {
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      V8 a = {};
      for (int i = 0; i < (D == 9 ? 8 : 6); ++i) a[i] = step[k * D + i];
      step_[k].a = a;
      if constexpr (D == 9) step_[k].b = step[k * D + 8];
    }
  }

  Layout l_;
  Rows rows_;
  double gradient_norm_ = 0;
  Buffer<Block<D>> b_, row_;
  Buffer<Column<D>> e_, z_, gradient_c_, rhs_, step_, product_;
  Buffer<double> c_, gradient_p_, inverse_l_, scaled_gradient_;
  std::vector<double> damping_c_;
};

}  // namespace ba
