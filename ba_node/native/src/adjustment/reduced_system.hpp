// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The Schur complement of the points, S = B - E C^-1 E' with damped B and C, its solution and back-substitution.
// The equations stand in core/schur.py, which is this file's oracle. With C = L L' they need Z = E L^-T alone.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "adjustment/coupling.hpp"
#include "adjustment/equations.hpp"
#include "adjustment/layout.hpp"
#include "adjustment/retract.hpp"
#include "adjustment/rows.hpp"
#include "adjustment/sparse_schur.hpp"
#include "linalg/blocks.hpp"
#include "linalg/cholesky.hpp"
#include "linalg/pcg.hpp"
#include "linalg/sparse_cholesky.hpp"
#include "parallel/pool.hpp"

namespace ba::BA_TARGET {

// Sum of what the chunks have.
inline Objectives total_of(const std::vector<Objectives>& partials) {
  Objectives out;
  for (const Objectives& partial : partials) {
    out.before += partial.before;
    out.after += partial.after;
  }
  return out;
}

template <int D>
class ReducedSystem {
 public:
  // factors: pairs of free keyframes that have a block of B between them.
  ReducedSystem(const Layout& layout, const Rows& rows, const Equations<D>& equations, CoupledPairs factors, Pool& pool)
      : l_(layout),
        rows_(rows),
        equations_(equations),
        factors_(std::move(factors)),
        pool_(pool),
        coupling_(layout, equations) {
    pairs_.assign(factors_.size(), Block<D>{});
    rhs_.resize(l_.n_free);
    sums_.resize(l_.n_chunks() * l_.n_free);
    damping_p_.resize(3 * l_.n_batches);
    damping_c_.resize(l_.n_free * D);
    partial_.resize(l_.n_chunks());
  }

  // Blocks of B of the coupled pairs (n_pairs x 36).
  void set_pairs(const double* pairs) {
    for (std::size_t k = 0; k < factors_.size(); ++k)
      for (int i = 0; i < 36; ++i) set_entry(pairs_[k], i / 6, i % 6, pairs[36 * k + i]);
  }

  // Add damping to the diagonals and factor C; everything below is of this damped system.
  void factor(const double* damping_c, const double* damping_p) {
    std::copy_n(damping_c, l_.n_free * D, damping_c_.data());
    factor_points([&](std::int64_t i, V8(&damping)[3]) { rows_.load_points(i, damping_p, damping); });
  }

  // The same with mu times the diagonal itself, or the identity.
  void damp(bool diagonal, double mu) {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) damping_c_[k * D + i] = mu * scale2(diagonal, k, i);
    factor_points([&](std::int64_t i, V8(&damping)[3]) {
      const V8* c = &equations_.c[6 * i];
      const V8 d[3] = {c[0], c[2], c[5]};
      for (int j = 0; j < 3; ++j) damping[j] = mu * (diagonal ? maximum(d[j], splat(kMinDiagonal)) : splat(1.0));
    });
  }

  void rhs(double* out) {
    if (!is_rhs_known_) sum_rhs();
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(rhs_[k], i);
  }

  // S, symmetric, (n x n), n = n_free D.
  void dense(double* out) {
    const std::int64_t n = l_.n_free * D;
    std::fill_n(out, n * n, 0.0);
    each_block([&](std::int64_t i, std::int64_t j, const Block<D>& block) {
      for (int r = 0; r < D; ++r)
        for (int c = 0; c < D; ++c)
          out[(i * D + r) * n + j * D + c] = out[(j * D + c) * n + i * D + r] = entry(block, r, c);
    });
  }

  // Solve S x = rhs by dense Cholesky; false if S is not positive definite.
  bool solve(double* x) {
    const std::int64_t n = l_.n_free * D;
    cholesky_.resize(n);
    const SparseSchur<D>& s = assemble();
    pool_.each(l_.n_free, [&](std::int64_t i, int) {
      for (std::int64_t k = s.pattern().start[i]; k < s.pattern().start[i + 1]; ++k) {
        const std::int64_t j = s.pattern().index[k];
        cholesky_.put(j * D, i * D, s.blocks()[k]);
      }
    });
    if (!cholesky_.factor(pool_)) return false;
    rhs(x);
    cholesky_.solve(x);
    return all_finite(x, n);
  }

  // S by blocks, of which nothing but the structure need be known yet.
  SparseSchur<D>& schur() {
    if (!schur_) schur_ = std::make_unique<SparseSchur<D>>(l_, factors_, pool_.threads());
    return *schur_;
  }

  // The size of the sparse factor, found once if it meets the limits.
  const Fill& analyse(const FillLimits& limits) {
    if (!factor_ || !factor_->fill().complete) factor_ = std::make_unique<SparseCholesky<D>>(schur().pattern(), limits);
    return factor_->fill();
  }

  // S by blocks.
  const SparseSchur<D>& assemble() {
    schur().assemble(pool_, coupling_, [this](std::int64_t k, Block<D>& block) { add_diagonal(k, block); }, pairs_);
    take_rhs(schur().sums());
    return schur();
  }

  // Solve S x = rhs by sparse Cholesky, after analyse; false if S is not positive definite.
  bool solve_sparse(double* x) {
    if (!factor_->factor(assemble().blocks())) return false;
    rhs(x);
    factor_->solve(x);
    return true;
  }

  // Solve S x = rhs by conjugate gradients; scale: 1/D (n_free x D). formed: products with S by blocks, summed first;
  // otherwise without it.
  PcgEnd pcg(const double* scale, Preconditioner kind, const PcgLimits& limits, bool formed, double* x) {
    if (formed) assemble();
    const bool whole = kind == Preconditioner::kSchurBlock || kind == Preconditioner::kOwnBlock;
    inverse_.set(blocks_of(kind), l_.n_free, scale, whole);
    pcg_.resize(l_.n_free * D);
    rhs_as_given_.resize(l_.n_free * D);
    rhs(rhs_as_given_.data());
    const auto multiply = [&](const double* in, double* out) {
      if (formed) {
        schur().multiply(in, out);
      } else {
        product(in, out);
      }
    };
    const auto precondition = [this](const Buffer<double>& r, Buffer<double>& z) { inverse_.apply(r, z); };
    return pcg_.solve(multiply, precondition, rhs_as_given_.data(), scale, limits, x);
  }

  // S x without forming S.
  void product(const double* x, double* out) {
    coupling_.load_step(x);
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      Column<D>* y = &sums_[chunk * l_.n_free];
      clear(y, l_.n_free);
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        V8 v[3], p[3];
        coupling_.project_step(i, v);
        upper_times(coupling_.inverse_l(i), v, p);
        coupling_.add_coupling(i, p, y);
      }
    });
    each_sum([&](std::int64_t k, const Column<D>& sum) {
      const Column<D> y = multiply(equations_.b[k], coupling_.step(k));
      for (int i = 0; i < D; ++i) out[k * D + i] = at(y, i) - at(sum, i) + damping_c_[k * D + i] * x[k * D + i];
    });
    for (std::size_t k = 0; k < factors_.size(); ++k) {
      const std::int64_t i = factors_.row[k], j = factors_.column[k];
      add_multiplied<1>(pairs_[k], x + j * D, out + i * D);
      add_multiplied_transposed<1>(pairs_[k], x + i * D, out + j * D);
    }
  }

  void diagonal_blocks(double* out) {
    const Block<D>* blocks = find_diagonal();
    for (std::int64_t k = 0; k < l_.n_free; ++k) write_block(blocks[k], out + k * D * D, D);
  }

  // Step of the points for a step of the free keyframes (n_free x D); returns the reduction of the undamped model.
  double back_substitute(const double* step_c, double* out) {
    return each_step(step_c, [&](std::int64_t, int, auto each_batch) {
      each_batch([&](std::int64_t batch, const V8(&p)[3]) { rows_.store_points(batch, p, out); });
    });
  }

  // The same, but hand the steps on: take(chunk, thread, each_batch) is to call each_batch(f) once, which calls
  // f(batch, step) for the batches of the chunk. What is kept of a batch at the state is not looked at again after
  // that.
  //
  // With y = L^-1 gp, v = Z' step_c and w = -(y + v) the points' step is p = L^-T w, and as C + D = L L' the model's
  // curvature is step_c' B step_c + 2 w'v + |w|^2 - p' D p: E is not needed.
  template <class Take>
  double each_step(const double* step_c, Take take) {
    coupling_.load_step(step_c);
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int thread) {
      V8 slope{}, curvature{}, damping{};
      take(chunk, thread, [&](auto f) {
        for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
          V8 v[3], w[3], p[3];
          coupling_.project_step(i, v);
          const V8 *y = coupling_.scaled_gradient(i), *g = &equations_.gradient_p[3 * i], *d = &damping_p_[3 * i];
          for (int c = 0; c < 3; ++c) w[c] = -(y[c] + v[c]);
          upper_times(coupling_.inverse_l(i), w, p);
          for (int c = 0; c < 3; ++c) {
            slope += g[c] * p[c];
            curvature += w[c] * (2 * v[c] + w[c]) - d[c] * p[c] * p[c];
            damping += d[c] * p[c] * p[c];
          }
          f(i, p);
        }
      });
      partial_[chunk] = {0.5 * sum(damping), -sum(slope) - 0.5 * sum(curvature)};
    });
    double reduction = total_of(partial_).after;
    damping_cost_ = total_of(partial_).before;
    for (std::int64_t i = 0; i < l_.n_free * D; ++i) damping_cost_ += 0.5 * damping_c_[i] * step_c[i] * step_c[i];
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      reduction -= dot(equations_.gradient_c[k], coupling_.step(k)) +
                   0.5 * dot(multiply(equations_.b[k], coupling_.step(k)), coupling_.step(k));
    for (std::size_t k = 0; k < factors_.size(); ++k) {
      double moved[D] = {};
      add_multiplied<1>(pairs_[k], step_c + factors_.column[k] * D, moved);
      for (int i = 0; i < D; ++i) reduction -= step_c[factors_.row[k] * D + i] * moved[i];
    }
    return reduction;
  }

  // |D x|^2 for a step of the free keyframes, with D^2 the diagonal itself, not damped, or the identity.
  double length2(bool diagonal, const double* x) const {
    double sum = 0.0;
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) sum += scale2(diagonal, k, i) * x[k * D + i] * x[k * D + i];
    return sum;
  }

  // 1/2 p' D p of the last step.
  double damping_cost() const { return damping_cost_; }

 private:
  double scale2(bool diagonal, std::int64_t k, int i) const {
    return diagonal ? std::max(entry(equations_.b[k], i, i), kMinDiagonal) : 1.0;
  }

  // damping(batch, out): of the points of a batch.
  template <class Damping>
  void factor_points(Damping damping) {
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        V8 d[3];
        damping(i, d);
        factor_batch(i, d);
      }
    });
    is_rhs_known_ = false;
  }

  // The right-hand side where S, whose sum has it too, is not formed.
  void sum_rhs() {
    pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
      Column<D>* sums = &sums_[chunk * l_.n_free];
      clear(sums, l_.n_free);
      for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
        const V8* of_batch = coupling_.scaled_gradient(i);
        const V8 y[3] = {of_batch[0], of_batch[1], of_batch[2]};
        V8 p[3];
        upper_times(coupling_.inverse_l(i), y, p);
        coupling_.add_coupling(i, p, sums);
      }
    });
    each_sum([&](std::int64_t k, const Column<D>& sum) { take_rhs_of(k, sum); });
    is_rhs_known_ = true;
  }

  void take_rhs(const Column<D>* sums) {
    for (std::int64_t k = 0; k < l_.n_free; ++k) take_rhs_of(k, sums[k]);
    is_rhs_known_ = true;
  }

  // -gc + Z L^-1 gp.
  void take_rhs_of(std::int64_t k, const Column<D>& sum) {
    rhs_[k].a = sum.a - equations_.gradient_c[k].a;
    if constexpr (D == 9) rhs_[k].b = sum.b - equations_.gradient_c[k].b;
  }

  // L^-1 and y = L^-1 gp of a batch.
  void factor_batch(std::int64_t batch, const V8 (&damping)[3]) {
    Packed& li = coupling_.inverse_l(batch);
    V8 g[3], y[3];
    for (int i = 0; i < 3; ++i) {
      g[i] = equations_.gradient_p[3 * batch + i];
      damping_p_[3 * batch + i] = damping[i];
    }
    inverse_cholesky(*reinterpret_cast<const Packed*>(&equations_.c[6 * batch]), damping, li);
    lower_times(li, g, y);
    for (int i = 0; i < 3; ++i) coupling_.scaled_gradient(batch)[i] = y[i];
  }

  // Call take(i, j, block) for the blocks S_ij with j >= i that are not zero.
  template <class Take>
  void each_block(Take take) {
    const SparseSchur<D>& s = assemble();
    for (std::int64_t i = 0; i < l_.n_free; ++i)
      for (std::int64_t k = s.pattern().start[i]; k < s.pattern().start[i + 1]; ++k)
        take(i, s.pattern().index[k], s.blocks()[k]);
  }

  // What M is made of, null for none.
  const Block<D>* blocks_of(Preconditioner kind) {
    if (kind == Preconditioner::kNone) return nullptr;
    if (kind == Preconditioner::kSchurBlock || kind == Preconditioner::kSchurDiagonal) return find_diagonal();
    own_.assign(l_.n_free, Block<D>{});
    for (std::int64_t k = 0; k < l_.n_free; ++k) add_diagonal(k, own_[k]);
    return own_.data();
  }

  const Block<D>* find_diagonal() {
    const auto add = [this](std::int64_t k, Block<D>& block) { add_diagonal(k, block); };
    const Block<D>* blocks = schur().diagonal(pool_, coupling_, add);
    take_rhs(schur().sums());
    return blocks;
  }

  // B and the damping of keyframe k, onto its diagonal block.
  void add_diagonal(std::int64_t k, Block<D>& block) const {
    add(block, equations_.b[k]);
    for (int c = 0; c < D; ++c) set_entry(block, c, c, entry(block, c, c) + damping_c_[k * D + c]);
  }

  // Call put(k, sum) for each free keyframe with the sum of what the chunks have for it in sums_.
  template <class Put>
  void each_sum(Put put) {
    pool_.each(kSumTasks, [&](std::int64_t task, int) {
      for (std::int64_t k = l_.n_free * task / kSumTasks; k < l_.n_free * (task + 1) / kSumTasks; ++k) {
        Column<D> sum = sums_[k];
        for (std::int64_t chunk = 1; chunk < l_.n_chunks(); ++chunk) add(sum, sums_[chunk * l_.n_free + k]);
        put(k, sum);
      }
    });
  }

  static constexpr std::int64_t kSumTasks = 8;

  const Layout& l_;
  const Rows& rows_;
  const Equations<D>& equations_;
  CoupledPairs factors_;
  Pool& pool_;
  Buffer<Block<D>> pairs_;
  Coupling<D> coupling_;
  DenseCholesky cholesky_;
  Pcg pcg_;
  DiagonalInverse<D> inverse_;
  Buffer<Block<D>> own_;
  Buffer<double> rhs_as_given_;
  Buffer<Column<D>> rhs_, sums_;  // sums_: of each chunk
  Buffer<V8> damping_p_;
  std::vector<double> damping_c_;
  double damping_cost_ = 0;
  bool is_rhs_known_ = false;
  std::vector<Objectives> partial_;
  std::unique_ptr<SparseSchur<D>> schur_;
  std::unique_ptr<SparseCholesky<D>> factor_;
};

}  // namespace ba::BA_TARGET
