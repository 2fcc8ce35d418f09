// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The Schur complement of the points, S = B - E C^-1 E' with damped B and C, and back-substitution.
// The equations stand in core/schur.py, which is this file's oracle. With C = L L' they need Z = E L^-T alone.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

#include "blocks.hpp"
#include "cholesky.hpp"
#include "equations.hpp"
#include "layout.hpp"
#include "polish.hpp"
#include "pool.hpp"
#include "retract.hpp"
#include "rows.hpp"
#include "sparse_schur.hpp"

namespace ba {

// What a step did: by what the model said the objective would fall, and the objective before and after the polishing.
struct Moved {
  double predicted = 0;
  double damping = 0;  // 1/2 p' D p
  Polished objective{std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::quiet_NaN()};
};

template <int D>
class Kernel {
 public:
  Kernel(const ProblemView& problem, const Rules& rules, const StateView& start, int threads)
      : l_(problem, D == 9), rows_(l_, rules, start), pool_(threads), equations_(l_) {
    column_.resize(pool_.threads() * l_.n_free);
    rhs_.resize(l_.n_free);
    step_.resize(l_.n_free);
    sums_.resize(l_.n_chunks() * l_.n_free);
    inverse_l_.resize(6 * l_.n_batches);
    scaled_gradient_.resize(3 * l_.n_batches);
    damping_p_.resize(3 * l_.n_batches);
    damping_c_.resize(l_.n_free * D);
    part_.resize(l_.n_chunks());
    const std::int64_t most = l_.n_batches ? l_.slot_begin[1] : 0;
    for (int i = 0; i < pool_.threads(); ++i) images_.emplace_back(most);
    find_columns();
  }
  // The parts refer to one another.
  Kernel(const Kernel&) = delete;
  Kernel& operator=(const Kernel&) = delete;

  std::int64_t n_free() const { return l_.n_free; }
  std::int64_t n_edges() const { return l_.n_edges(); }
  // Pairs of edges of a point, each edge with itself too: what S is summed from.
  std::int64_t n_pairs() const {
    std::int64_t total = 0;
    for (std::int64_t e = 0; e < l_.n_edges(); ++e) total += l_.edge_end[e] - e;
    return total;
  }
  std::int64_t n_points() const { return l_.n_points; }
  std::int64_t n_chunks() const { return l_.n_chunks(); }
  double gradient_norm() const { return equations_.gradient_norm; }

  double objective(const StateView& s) {
    rows_.load_images(s);
    rows_.with_kind([&](auto lens, auto depth) {
      pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
        part_[chunk].after = rows_.template objective<decltype(lens)::value, decltype(depth)::value>(chunk, s);
      });
    });
    return total().after;
  }

  // Improve each point alone, keyframes held. points: out.
  Polished polish_points(const StateView& s, double* points, int steps) {
    rows_.load_images(s);
    rows_.with_kind([&](auto lens, auto depth) {
      pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int thread) {
        Images* images = images_[thread].data();
        V8 before{}, after{};
        for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
          V8 x[3], first, best;
          rows_.load_points(i, s.points, x);
          polish_batch<decltype(lens)::value, decltype(depth)::value>(rows_, l_.slot_begin[i], l_.slot_begin[i + 1], steps,
                                                                      images, x, first, best);
          rows_.store_points(i, x, points);
          before += first;
          after += select(best < std::numeric_limits<double>::infinity(), best, V8{});
        }
        part_[chunk] = {0.5 * sum(before), 0.5 * sum(after)};
      });
    });
    return total();
  }

  double linearise(const StateView& s) { return equations_.linearise(rows_, s, pool_); }

  // diag(B) (n_free x D) and diag(C) (n_points x 3).
  void diagonals(double* d_c, double* d_p) const {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) d_c[k * D + i] = entry(equations_.b[k], i, i);
    for (std::int64_t i = 0; i < l_.n_batches; ++i) {
      const V8* c = &equations_.c[6 * i];
      const V8 d[3] = {c[0], c[2], c[5]};
      rows_.store_points(i, d, d_p);
    }
  }

  // Add damping to the diagonals and factor C; everything below is of this damped system.
  void factor(const double* damping_c, const double* damping_p) {
    std::copy_n(damping_c, l_.n_free * D, damping_c_.data());
    factor_points([&](std::int64_t i, V8(&damping)[3]) { rows_.load_points(i, damping_p, damping); });
  }

  // The same with mu times the diagonal itself, or the identity.
  void damp(bool diagonal, double mu) {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i)
        damping_c_[k * D + i] = mu * (diagonal ? std::max(entry(equations_.b[k], i, i), kMinDiagonal) : 1.0);
    factor_points([&](std::int64_t i, V8(&damping)[3]) {
      const V8* c = &equations_.c[6 * i];
      const V8 d[3] = {c[0], c[2], c[5]};
      for (int j = 0; j < 3; ++j) damping[j] = mu * (diagonal ? maximum(d[j], splat(kMinDiagonal)) : splat(1.0));
    });
  }

  void rhs(double* out) const {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(rhs_[k], i);
  }

  // S, symmetric, (n x n), n = n_free D.
  void dense(double* out) {
    const std::int64_t n = l_.n_free * D;
    each_block([&](std::int64_t j, std::int64_t i, const double* block) {
      for (int r = 0; r < D; ++r)
        for (int c = 0; c < D; ++c)
          out[(j * D + r) * n + i * D + c] = out[(i * D + c) * n + j * D + r] = block[r * D + c];
    });
  }

  // Solve S x = rhs by dense Cholesky; false if S is not positive definite.
  bool solve(double* x) {
    const std::int64_t n = l_.n_free * D;
    cholesky_.resize(n);
    each_block([&](std::int64_t j, std::int64_t i, const double* block) {
      for (int c = 0; c < D; ++c)
        for (int r = (j == i ? c : 0); r < D; ++r) cholesky_.at(j * D + r, i * D + c) = block[r * D + c];
    });
    if (!cholesky_.factor(pool_)) return false;
    rhs(x);
    cholesky_.solve(x);
    for (std::int64_t i = 0; i < n; ++i)
      if (!std::isfinite(x[i])) return false;
    return true;
  }

  // S by blocks, and its factor if it meets the limits; found once.
  const SparseSchur<D>& analyse(const FillLimits& limits) {
    if (!sparse_ || !sparse_->fill().complete) sparse_ = std::make_unique<SparseSchur<D>>(l_, limits);
    return *sparse_;
  }

  // Z of all edges is kept where it takes no more than this.
  std::int64_t kept_bytes = std::int64_t{1} << 25;

  // After analyse. Row by row with Z of all edges, or if that is large, point by point with Z of a batch.
  const SparseSchur<D>& assemble_sparse() {
    const auto diagonal = [this](std::int64_t i, double* block) { add_diagonal(i, block, D); };
    if (l_.n_edges() * static_cast<std::int64_t>(sizeof(Edge<D>)) <= kept_bytes) {
      keep_edges();
      pool_.each(l_.n_free, [&](std::int64_t i, int) {
        sparse_->clear_rows(i, i + 1);
        auto row = sparse_->row(i);
        for (std::int64_t k = l_.keyframe_edge[i]; k < l_.keyframe_edge[i + 1]; ++k) {
          const std::int32_t e = l_.edges_of_keyframe[k], end = l_.edge_end[e];
          row.rewind();
          for (std::int32_t f = e; f < end; ++f) subtract_product(row(l_.edge_column[f]), z_[e], z_[f]);
        }
        sparse_->add_diagonal(i, diagonal);
      });
      return *sparse_;
    }
    cut_rows();
    pool_.each(pool_.threads(), [&](std::int64_t part, int thread) {
      const std::int64_t begin = rows_cut_[part], end = rows_cut_[part + 1];
      sparse_->clear_rows(begin, end);
      with_edges(begin, end, thread, [&](std::int64_t p, const Edge<D>* z) {
        const std::int32_t first = l_.point_edge[p], last = l_.point_edge[p + 1];
        for (std::int32_t e = first; e < last; ++e) {
          const std::int32_t i = l_.edge_column[e];
          if (i < begin || i >= end) continue;
          auto row = sparse_->row(i);
          for (std::int32_t f = e; f < last; ++f) subtract_product(row(l_.edge_column[f]), z[e - first], z[f - first]);
        }
      });
      for (std::int64_t i = begin; i < end; ++i) sparse_->add_diagonal(i, diagonal);
    });
    return *sparse_;
  }

  // Solve S x = rhs by sparse Cholesky, after analyse; false if S is not positive definite.
  bool solve_sparse(double* x) {
    assemble_sparse();
    rhs(x);
    return sparse_->solve(x);
  }

  // S x without forming S.
  void product(const double* x, double* out) {
    load_step(x);
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      Column<D>* y = &sums_[chunk * l_.n_free];
      clear(y, l_.n_free);
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        V8 v[3], p[3];
        project_step(i, v);
        upper_times(*reinterpret_cast<const Packed*>(&inverse_l_[6 * i]), v, p);
        add_coupling(i, p, y);
      }
    });
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      Column<D> y = multiply(equations_.b[k], step_[k]);
      for (std::int64_t chunk = 0; chunk < l_.n_chunks(); ++chunk) {
        y.a -= sums_[chunk * l_.n_free + k].a;
        if constexpr (D == 9) y.b -= sums_[chunk * l_.n_free + k].b;
      }
      for (int i = 0; i < D; ++i) out[k * D + i] = at(y, i) + damping_c_[k * D + i] * x[k * D + i];
    }
  }

  void diagonal_blocks(double* out) {
    std::fill_n(out, l_.n_free * D * D, 0.0);
    cut_rows();
    pool_.each(pool_.threads(), [&](std::int64_t part, int thread) {
      const std::int64_t begin = rows_cut_[part], end = rows_cut_[part + 1];
      Block<D>* own = &column_[thread * l_.n_free];
      clear(own + begin, end - begin);
      with_edges(begin, end, thread, [&](std::int64_t p, const Edge<D>* z) {
        for (std::int32_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e, ++z) {
          const std::int32_t k = l_.edge_column[e];
          if (k >= begin && k < end) subtract_product(own[k], *z, *z);
        }
      });
      for (std::int64_t k = begin; k < end; ++k) {
        write_block(own[k], out + k * D * D, D);
        add_diagonal(k, out + k * D * D, D);
      }
    });
  }

  // Step of the points for a step of the free keyframes (n_free x D), added to `base` unless that is null; returns the
  // reduction of the undamped model.
  //
  // With y = L^-1 gp, v = Z' step_c and w = -(y + v) the points' step is p = L^-T w, and as C + D = L L' the model's
  // curvature is step_c' B step_c + 2 w'v + |w|^2 - p' D p: E is not needed.
  double back_substitute(const double* step_c, const double* base, double* out) {
    load_step(step_c);
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      V8 slope{}, curvature{}, damping{};
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        V8 v[3], w[3], p[3], x[3] = {};
        project_step(i, v);
        const V8 *y = &scaled_gradient_[3 * i], *g = &equations_.gradient_p[3 * i], *d = &damping_p_[3 * i];
        for (int c = 0; c < 3; ++c) w[c] = -(y[c] + v[c]);
        upper_times(*reinterpret_cast<const Packed*>(&inverse_l_[6 * i]), w, p);
        for (int c = 0; c < 3; ++c) {
          slope += g[c] * p[c];
          curvature += w[c] * (2 * v[c] + w[c]) - d[c] * p[c] * p[c];
          damping += d[c] * p[c] * p[c];
        }
        if (base != nullptr) rows_.load_points(i, base, x);
        for (int c = 0; c < 3; ++c) x[c] += p[c];
        rows_.store_points(i, x, out);
      }
      part_[chunk] = {0.5 * sum(damping), -sum(slope) - 0.5 * sum(curvature)};
    });
    double reduction = total().after;
    damping_cost_ = total().before;
    for (std::int64_t i = 0; i < l_.n_free * D; ++i) damping_cost_ += 0.5 * damping_c_[i] * step_c[i] * step_c[i];
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      reduction -= dot(equations_.gradient_c[k], step_[k]) + 0.5 * dot(multiply(equations_.b[k], step_[k]), step_[k]);
    return reduction;
  }

  // Take a step of the free keyframes (n_free x D) and those of the points that go with it from `from` to `to`, and
  // polish the points after it. Objectives are not numbers where the state after the step is not finite.
  Moved move(const StateView& from, const double* step_c, int steps, const StateSpan& to) {
    Moved out;
    out.predicted = back_substitute(step_c, from.points, to.points);
    out.damping = damping_cost_;
    retract_keyframes(l_, from, step_c, D, to);
    const bool finite = all_finite(to.points, 3 * l_.n_points) && all_finite(to.rotation, 9 * l_.n_keyframes) &&
                        all_finite(to.translation, 3 * l_.n_keyframes) &&
                        (!l_.own_intrinsics || all_finite(to.intrinsics, 3 * l_.n_keyframes));
    if (!finite) return out;
    const StateView s{to.rotation, to.translation, to.points, to.intrinsics};
    if (steps > 0) {
      out.objective = polish_points(s, to.points, steps);
    } else {
      out.objective.before = out.objective.after = objective(s);
    }
    return out;
  }

 private:
  // damping(batch, out): of the points of a batch.
  template <class Damping>
  void factor_points(Damping damping) {
    edges_kept_ = false;
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      Column<D>* sums = &sums_[chunk * l_.n_free];
      clear(sums, l_.n_free);
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        V8 d[3];
        damping(i, d);
        factor_batch(i, d, sums);
      }
    });
    // -gc + Z L^-1 gp.
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      rhs_[k].a = -equations_.gradient_c[k].a;
      if constexpr (D == 9) rhs_[k].b = -equations_.gradient_c[k].b;
    }
    add_sums(rhs_.data());
  }

  // L^-1 and y = L^-1 gp of a batch; adds Z y to `sums`.
  void factor_batch(std::int64_t batch, const V8 (&damping)[3], Column<D>* sums) {
    Packed& li = *reinterpret_cast<Packed*>(&inverse_l_[6 * batch]);
    V8 g[3], y[3], p[3];
    for (int i = 0; i < 3; ++i) {
      g[i] = equations_.gradient_p[3 * batch + i];
      damping_p_[3 * batch + i] = damping[i];
    }
    inverse_cholesky(*reinterpret_cast<const Packed*>(&equations_.c[6 * batch]), damping, li);
    lower_times(li, g, y);
    for (int i = 0; i < 3; ++i) scaled_gradient_[3 * batch + i] = y[i];
    upper_times(li, y, p);
    add_coupling(batch, p, sums);
  }

  // Z of the edges of a batch; z: from the batch's first edge on. kGeneral: edges of several observations, or with depth.
  template <bool kGeneral>
  void edges_of_batch(std::int64_t batch, Edge<D>* z) const {
    const V8(&x)[3] = *reinterpret_cast<const V8(*)[3]>(&equations_.point[3 * batch]);
    const Packed& li = *reinterpret_cast<const Packed*>(&inverse_l_[6 * batch]);
    V8 c[6] = {}, f[D == 9 ? 9 : 1] = {};
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      couple<kGeneral>(slot, c, f);
      store_edges(slot, li, x, c, f, z - l_.point_edge[kLanes * batch]);
    }
  }

  void edges_of(std::int64_t batch, Edge<D>* z) const {
    if (l_.has_depth || l_.has_rigs) {
      edges_of_batch<true>(batch, z);
    } else {
      edges_of_batch<false>(batch, z);
    }
  }

  // Z of all edges, once for each damping.
  void keep_edges() {
    if (edges_kept_) return;
    z_.resize(l_.n_edges());
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i)
        edges_of(i, z_.data() + l_.point_edge[kLanes * i]);
    });
    edges_kept_ = true;
  }

  // Call f(p, z) for each point (of ours) that one of the free keyframes [begin, end) sees; z: of its edges.
  template <class F>
  void with_edges(std::int64_t begin, std::int64_t end, int thread, F f) {
    Buffer<Edge<D>>& z = scratch_[thread];
    z.resize(most_edges_);
    for (std::int64_t i = 0; i < l_.n_batches; ++i) {
      if (last_column_[i] < begin || first_column_[i] >= end) continue;
      edges_of(i, z.data());
      const std::int32_t first = l_.point_edge[kLanes * i];
      for (int l = 0; l < l_.lanes(i); ++l)
        f(kLanes * i + l, z.data() + (l_.point_edge[kLanes * i + l] - first));
    }
  }

  // sum a a' (packed) and, where intrinsics are free, sum i a' over the rows of the observations of an edge so far.
  template <bool kGeneral>
  [[gnu::always_inline]] void couple(std::int64_t slot, V8 (&c)[6], V8* f) const {
    V8 t[8];
    const auto read = [&](int line) { read_lanes(slot, line, t); };
    const auto add = [&c](const V8* a) {
      c[0] += a[0] * a[0];
      c[1] += a[1] * a[0];
      c[2] += a[1] * a[1];
      c[3] += a[2] * a[0];
      c[4] += a[2] * a[1];
      c[5] += a[2] * a[2];
    };
    if constexpr (kGeneral) {
      const Mask same = load(&l_.same_edge[kLanes * slot]) != 0.0;
      for (int i = 0; i < 6; ++i) c[i] = select(same, c[i], V8{});
      for (int i = 0; i < (D == 9 ? 9 : 0); ++i) f[i] = select(same, f[i], V8{});
    } else {
      for (int i = 0; i < 6; ++i) c[i] = V8{};
      for (int i = 0; i < (D == 9 ? 9 : 0); ++i) f[i] = V8{};
    }
    read(0);
    add(t);
    add(t + 3);
    if constexpr (D == 9) {
      V8 a[6];
      for (int i = 0; i < 6; ++i) a[i] = t[i];
      read(1);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) f[3 * i + j] += t[i] * a[j] + t[3 + i] * a[3 + j];
    }
    if constexpr (kGeneral) {
      if (l_.has_depth) {
        read(equations_.lines - 1);
        add(t);
      }
    }
  }

  // Z of the edges that end in a slot, z[edge]: with E = (x x C; C; F), its columns from those of C L^-T and F L^-T.
  [[gnu::always_inline]] void store_edges(std::int64_t slot, const Packed& li, const V8 (&x)[3], const V8 (&c)[6],
                                          const V8* f, Edge<D>* z) const {
    const V8 full[3][3] = {{c[0], c[1], c[3]}, {c[1], c[2], c[4]}, {c[3], c[4], c[5]}};
    V8 columns[3][8], ninth[8] = {};
    for (int i = 0; i < 3; ++i) {
      V8 w[3];
      const V8* a = full[i];
      w[0] = a[0] * li[0];
      w[1] = a[0] * li[1] + a[1] * li[2];
      w[2] = a[0] * li[3] + a[1] * li[4] + a[2] * li[5];
      for (int col = 0; col < 3; ++col) columns[col][3 + i] = w[col];
      if constexpr (D == 9) {
        const V8* b = f + 3 * i;
        w[0] = b[0] * li[0];
        w[1] = b[0] * li[1] + b[1] * li[2];
        w[2] = b[0] * li[3] + b[1] * li[4] + b[2] * li[5];
        for (int col = 0; col < 3; ++col) (i < 2 ? columns[col][6 + i] : ninth[col]) = w[col];
      }
    }
    for (int col = 0; col < 3; ++col) {
      pose_row(x, columns[col] + 3, columns[col]);
      if constexpr (D == 6) columns[col][6] = columns[col][7] = V8{};
      transpose(columns[col]);
    }
    if constexpr (D == 9) transpose(ninth);
    const std::int32_t* edge = &l_.slot_edge[kLanes * slot];
    for (int l = 0; l < kLanes; ++l) {
      if (edge[l] < 0) continue;
      for (int col = 0; col < 3; ++col) z[edge[l]].a[col] = columns[col][l];
      if constexpr (D == 9) z[edge[l]].b = ninth[l];
    }
  }

  // Line `line` of the records of a slot, each number by lane.
  [[gnu::always_inline]] void read_lanes(std::int64_t slot, int line, V8 (&t)[8]) const {
    const V8* record = &equations_.record[kLanes * slot * equations_.lines + line];
#pragma GCC unroll 8
    for (int l = 0; l < kLanes; ++l) t[l] = record[l * equations_.lines];
    transpose(t);
  }

  // The free keyframe of a lane, or -1.
  std::int32_t column_of_lane(std::int64_t at) const {
    return l_.inverse_sigma[at] != 0.0 ? image_column_[l_.slot_image[at]] : -1;
  }

  // Add E p to sums, E = Jc'Jp, for p of the points of a batch.
  void add_coupling(std::int64_t batch, const V8 (&p)[3], Column<D>* sums) const {
    const V8* x = &equations_.point[3 * batch];
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      V8 t[8], h[3], out[8] = {}, ninth{};
      read_lanes(slot, 0, t);
      const V8 u = t[0] * p[0] + t[1] * p[1] + t[2] * p[2], v = t[3] * p[0] + t[4] * p[1] + t[5] * p[2];
      for (int i = 0; i < 3; ++i) h[i] = t[i] * u + t[3 + i] * v;
      if constexpr (D == 9) {
        read_lanes(slot, 1, t);
        for (int i = 0; i < 2; ++i) out[6 + i] = t[i] * u + t[3 + i] * v;
        ninth = t[2] * u + t[5] * v;
      }
      if (l_.has_depth) {
        read_lanes(slot, equations_.lines - 1, t);
        const V8 w = t[0] * p[0] + t[1] * p[1] + t[2] * p[2];
        for (int i = 0; i < 3; ++i) h[i] += t[i] * w;
      }
      pose_row(x, h, out);
      transpose(out);
      for (int l = 0; l < kLanes; ++l) {
        const std::int32_t column = column_of_lane(kLanes * slot + l);
        if (column < 0) continue;
        sums[column].a += out[l];
        if constexpr (D == 9) sums[column].b += ninth[l];
      }
    }
  }

  // Z' step = L^-1 Jp' Jc step of a batch.
  [[gnu::always_inline]] void project_step(std::int64_t batch, V8 (&out)[3]) const {
    const V8* x = &equations_.point[3 * batch];
    V8 z[3] = {};
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      V8 s[8], t[8], q[3], last{};
      for (int l = 0; l < kLanes; ++l) {
        const std::int32_t column = column_of_lane(kLanes * slot + l);
        s[l] = column < 0 ? V8{} : step_[column].a;
        if constexpr (D == 9) last[l] = column < 0 ? 0.0 : step_[column].b;
      }
      transpose(s);
      q[0] = s[1] * x[2] - s[2] * x[1] + s[3];
      q[1] = s[2] * x[0] - s[0] * x[2] + s[4];
      q[2] = s[0] * x[1] - s[1] * x[0] + s[5];
      V8 u{}, v{};
      if constexpr (D == 9) {
        read_lanes(slot, 1, t);
        u = t[0] * s[6] + t[1] * s[7] + t[2] * last;
        v = t[3] * s[6] + t[4] * s[7] + t[5] * last;
      }
      read_lanes(slot, 0, t);
      u += t[0] * q[0] + t[1] * q[1] + t[2] * q[2];
      v += t[3] * q[0] + t[4] * q[1] + t[5] * q[2];
      for (int i = 0; i < 3; ++i) z[i] += t[i] * u + t[3 + i] * v;
      if (l_.has_depth) {
        read_lanes(slot, equations_.lines - 1, t);
        const V8 w = t[0] * q[0] + t[1] * q[1] + t[2] * q[2];
        for (int i = 0; i < 3; ++i) z[i] += t[i] * w;
      }
    }
    lower_times(*reinterpret_cast<const Packed*>(&inverse_l_[6 * batch]), z, out);
  }

  // Call take(j, i, block) for all blocks of S with j >= i, D x D row by row; columns i at the same time.
  template <class Take>
  void each_block(Take take) {
    keep_edges();
    pool_.each(l_.n_free, [&](std::int64_t i, int thread) {
      Block<D>* column = &column_[thread * l_.n_free];
      clear(column + i, l_.n_free - i);
      add_column(i, [column](std::int32_t j) -> Block<D>& { return column[j]; });
      double block[D * D];
      for (std::int64_t j = i; j < l_.n_free; ++j) {
        write_block(column[j], block, D);
        if (j == i) add_diagonal(i, block, D);
        take(j, i, block);
      }
    });
  }

  // Column i of -Z Z' from the diagonal on: `block` finds that of a row.
  template <class Find>
  void add_column(std::int64_t i, Find block) const {
    for (std::int64_t k = l_.keyframe_edge[i]; k < l_.keyframe_edge[i + 1]; ++k) {
      const std::int32_t e = l_.edges_of_keyframe[k], end = l_.edge_end[e];
      prefetch(k + kAhead);
      const std::int32_t* column = &l_.edge_column[e];
      subtract_products(z_[e], &z_[e], end - e, [&](int f) -> Block<D>& { return block(column[f]); });
    }
  }

  // Ask for the edges that row i needs soon: they lie scattered, and there is little to do meanwhile.
  void prefetch(std::int64_t k) const {
    if (k >= l_.n_edges()) return;
    const std::int32_t e = l_.edges_of_keyframe[k];
    const char* first = reinterpret_cast<const char*>(&z_[e]);
    const char* end = reinterpret_cast<const char*>(&z_[e] + std::min(l_.edge_end[e] - e, kMaxFetched));
    for (const char* line = first; line < end; line += 64) __builtin_prefetch(line);
  }

  // Rows of S for each thread, about as many pairs of edges for each. What a row sums does not depend on it.
  void cut_rows() {
    if (!rows_cut_.empty()) return;
    const double all = static_cast<double>(n_pairs());
    double done = 0;
    rows_cut_.push_back(0);
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      for (std::int64_t k = l_.keyframe_edge[i]; k < l_.keyframe_edge[i + 1]; ++k) {
        const std::int32_t e = l_.edges_of_keyframe[k];
        done += l_.edge_end[e] - e;
      }
      while (static_cast<int>(rows_cut_.size()) < pool_.threads() && done >= all * static_cast<double>(rows_cut_.size()) / pool_.threads())
        rows_cut_.push_back(i + 1);
    }
    rows_cut_.resize(pool_.threads() + 1, l_.n_free);
  }

  // Which free keyframe each image is of, and those that see the points of each batch.
  void find_columns() {
    image_column_.assign(l_.images.size(), -1);
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (std::int64_t i = l_.keyframe_seen[k]; i < l_.keyframe_seen[k + 1]; ++i)
        if (l_.seen[i] >= 0) image_column_[l_.slot_image[l_.seen[i]]] = static_cast<std::int32_t>(k);
    scratch_.resize(pool_.threads());
    first_column_.assign(l_.n_batches, static_cast<std::int32_t>(l_.n_free));
    last_column_.assign(l_.n_batches, -1);
    for (std::int64_t i = 0; i < l_.n_batches; ++i) {
      const std::int32_t begin = l_.point_edge[kLanes * i], end = l_.point_edge[kLanes * (i + 1)];
      most_edges_ = std::max<std::int64_t>(most_edges_, end - begin);
      for (std::int32_t e = begin; e < end; ++e) {
        first_column_[i] = std::min(first_column_[i], l_.edge_column[e]);
        last_column_[i] = std::max(last_column_[i], l_.edge_column[e]);
      }
    }
  }

  // B and the damping of keyframe k, onto its diagonal block.
  void add_diagonal(std::int64_t k, double* out, std::int64_t stride) const {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c < D; ++c) out[r * stride + c] += entry(equations_.b[k], r, c);
      out[r * (stride + 1)] += damping_c_[k * D + r];
    }
  }

  void add_sums(Column<D>* out) const {
    for (std::int64_t chunk = 0; chunk < l_.n_chunks(); ++chunk) {
      for (std::int64_t k = 0; k < l_.n_free; ++k) {
        out[k].a += sums_[chunk * l_.n_free + k].a;
        if constexpr (D == 9) out[k].b += sums_[chunk * l_.n_free + k].b;
      }
    }
  }

  Polished total() const {
    Polished out;
    for (const Polished& part : part_) {
      out.before += part.before;
      out.after += part.after;
    }
    return out;
  }

  void load_step(const double* step) {
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      V8 a = {};
      for (int i = 0; i < (D == 9 ? 8 : 6); ++i) a[i] = step[k * D + i];
      step_[k].a = a;
      if constexpr (D == 9) step_[k].b = step[k * D + 8];
    }
  }

  double damping_cost_ = 0;
  static constexpr std::int64_t kAhead = 4;
  static constexpr std::int32_t kMaxFetched = 8;

  Layout l_;
  Rows rows_;
  Pool pool_;
  Equations<D> equations_;
  DenseCholesky cholesky_;
  Buffer<Edge<D>> z_;
  std::vector<Buffer<Edge<D>>> scratch_;  // of each thread: Z of a batch
  std::int64_t most_edges_ = 0;
  bool edges_kept_ = false;
  std::vector<std::int64_t> rows_cut_;
  std::vector<std::int32_t> image_column_, first_column_, last_column_;
  Buffer<Block<D>> column_;
  Buffer<Column<D>> rhs_, step_, sums_;  // sums_: of each chunk
  Buffer<V8> inverse_l_, scaled_gradient_, damping_p_;
  std::vector<double> damping_c_;
  std::vector<Polished> part_;
  std::vector<Buffer<Images>> images_;
  std::unique_ptr<SparseSchur<D>> sparse_;
};

}  // namespace ba
