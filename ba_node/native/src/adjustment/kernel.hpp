// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Everything about one problem: its normal equations at a state, the system reduced to its keyframes, and what a step
// does.
#pragma once

#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "adjustment/equations.hpp"
#include "adjustment/inner_iterations.hpp"
#include "adjustment/layout.hpp"
#include "adjustment/reduced_system.hpp"
#include "adjustment/retract.hpp"
#include "adjustment/rows.hpp"
#include "linalg/blocks.hpp"
#include "parallel/pool.hpp"
#include "targets/target.hpp"

namespace ba::BA_TARGET {

template <int D>
class KernelOf final : public Kernel {
 public:
  explicit KernelOf(KernelArguments arguments)
      : l_(arguments.problem, D == 9),
        rows_(l_, arguments.cost, arguments.start),
        pool_(arguments.threads),
        equations_(l_),
        reduced_(l_, rows_, equations_, std::move(arguments.factors), pool_) {
    partial_.resize(l_.n_chunks());
    const std::int64_t most = l_.n_batches ? l_.slot_begin[1] : 0;
    for (int i = 0; i < pool_.threads(); ++i) {
      images_.emplace_back(most);
      staged_.emplace_back(most * equations_.staged_with(l_.has_depth));
    }
  }
  // The members refer to one another.
  KernelOf(const KernelOf&) = delete;
  KernelOf& operator=(const KernelOf&) = delete;

  int size() const override { return D; }
  std::int64_t n_free() const override { return l_.n_free; }
  std::int64_t n_edges() const override { return l_.n_edges(); }
  std::int64_t n_pairs() const override { return l_.n_pairs(); }
  std::int64_t n_points() const override { return l_.n_points; }
  std::int64_t n_chunks() const override { return l_.n_chunks(); }
  double gradient_norm() const override { return equations_.gradient_norm; }

  double objective(const StateView& s) override {
    rows_.load_images(s);
    rows_.with_kind<D>([&](auto lens, auto depth) {
      pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
        partial_[chunk].after = rows_.template objective<decltype(lens)::value, decltype(depth)::value>(chunk, s);
      });
    });
    return total_of(partial_).after;
  }

  Objectives inner_iterations(const StateView& s, double* points, int steps) override {
    rows_.load_images(s);
    rows_.with_kind<D>([&](auto lens, auto depth) {
      pool_.each(l_.n_chunks(), [&](std::int64_t chunk, int thread) {
        const V8 none[3] = {};
        const auto each_batch = [&](auto f) {
          for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) f(i, none);
        };
        constexpr Lens kLens = decltype(lens)::value;
        partial_[chunk] = iterate<kLens, decltype(depth)::value, false>(thread, each_batch, s, points, steps);
      });
    });
    return total_of(partial_);
  }

  double linearise(const StateView& s) override {
    is_prepared_ = false;
    return equations_.linearise(rows_, s, pool_);
  }

  bool linearise_prepared() override {
    if (!is_prepared_) return false;
    is_prepared_ = false;
    equations_.sum_keyframes(pool_);
    return true;
  }

  void add_factors(const double* diagonal, const double* gradient, const double* pairs) override {
    equations_.add_factors(diagonal, gradient);
    reduced_.set_pairs(pairs);
  }

  // The keyframes' part of the gradient (n_free x D).
  void gradient(double* out) const override {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) out[k * D + i] = at(equations_.gradient_c[k], i);
  }

  // diag(B) (n_free x D) and diag(C) (n_points x 3), null if it is not wanted.
  void diagonals(double* d_c, double* d_p) const override {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < D; ++i) d_c[k * D + i] = entry(equations_.b[k], i, i);
    for (std::int64_t i = 0; d_p != nullptr && i < l_.n_batches; ++i) {
      const V8* c = &equations_.c[6 * i];
      const V8 d[3] = {c[0], c[2], c[5]};
      rows_.store_points(i, d, d_p);
    }
  }

  void factor(const double* damping_c, const double* damping_p) override { reduced_.factor(damping_c, damping_p); }
  void damp(bool diagonal, double mu) override { reduced_.damp(diagonal, mu); }
  double length2(bool diagonal, const double* x) const override { return reduced_.length2(diagonal, x); }
  void rhs(double* out) override { reduced_.rhs(out); }
  void dense(double* out) override { reduced_.dense(out); }
  bool solve(double* x) override { return reduced_.solve(x); }
  const Fill& analyse(const FillLimits& limits) override { return reduced_.analyse(limits); }
  bool solve_sparse(double* x) override { return reduced_.solve_sparse(x); }
  const Rows32& schur_pattern() override { return reduced_.schur().pattern(); }
  void sparse(const std::int64_t* place, const std::int64_t* mirrored, double* out) override {
    const SparseSchur<D>& s = reduced_.assemble();
    const auto n = static_cast<std::int64_t>(s.pattern().index.size());
    for (std::int64_t k = 0; k < n; ++k) {
      write_block(s.blocks()[k], out + place[k] * D * D, D);
      if (mirrored[k] >= 0) write_transposed(s.blocks()[k], out + mirrored[k] * D * D, D);
    }
  }
  PcgEnd pcg(const double* scale, Preconditioner kind, const PcgLimits& limits, bool formed, double* x) override {
    return reduced_.pcg(scale, kind, limits, formed, x);
  }
  void product(const double* x, double* out) override { reduced_.product(x, out); }
  void diagonal_blocks(double* out) override { reduced_.diagonal_blocks(out); }
  double back_substitute(const double* step_c, double* step_p) override {
    return reduced_.back_substitute(step_c, step_p);
  }

  StepResult step(const StateView& from, const double* step_c, int steps, const StateSpan& to) override {
    StepResult out;
    is_prepared_ = false;
    retract_keyframes(l_, from, step_c, D, to);
    const StateView s{to.rotation, to.translation, from.points, to.intrinsics};
    rows_.load_images(s);
    rows_.with_kind<D>([&](auto lens, auto depth) {
      constexpr Lens kLens = decltype(lens)::value;
      out.predicted = reduced_.each_step(step_c, [&](std::int64_t chunk, int thread, auto each_batch) {
        partial_[chunk] = iterate<kLens, decltype(depth)::value, true>(thread, each_batch, s, to.points, steps);
      });
    });
    out.damping = reduced_.damping_cost();
    const Objectives found = total_of(partial_);
    is_prepared_ = !std::isnan(found.before) && all_finite(to.rotation, 9 * l_.n_keyframes) &&
                   all_finite(to.translation, 3 * l_.n_keyframes) &&
                   (!l_.own_intrinsics || all_finite(to.intrinsics, 3 * l_.n_keyframes));
    if (is_prepared_) out.objective = found;
    return out;
  }

 private:
  // Iterate on the points of a chunk. each_batch(f): calls f(batch, step) for each. kAfterStep: take that step before,
  // and keep what a linearisation where it ends would begin with in place of what was there. The objective before is
  // not a number if a point is not finite.
  template <Lens kLens, bool kDepth, bool kAfterStep, class EachBatch>
  Objectives iterate(int thread, EachBatch each_batch, const StateView& s, double* points, int steps) {
    V8 before{}, after{};
    each_batch([&](std::int64_t i, const V8(&step)[3]) {
      const std::int64_t slot_begin = l_.slot_begin[i];
      V8 x[3], first{}, best{};
      PointSums sums;
      V8* staged = staged_[thread].data();
      const auto keep = [&](std::int64_t slot, const Evaluation& obs) {
        if constexpr (kAfterStep)
          Equations<D>::template stage<kDepth>(obs, staged + (slot - slot_begin) * Equations<D>::staged_with(kDepth));
      };
      rows_.load_points(i, s.points, x);
      if constexpr (kAfterStep)
        for (int c = 0; c < 3; ++c) x[c] += step[c];
      const V8 none = 0.0 * (x[0] + x[1] + x[2]);  // or NaN
      iterate_batch<kLens, kDepth>(rows_, slot_begin, l_.slot_begin[i + 1], steps, images_[thread].data(), keep, x,
                                   sums, first, best);
      rows_.store_points(i, x, points);
      if constexpr (kAfterStep) equations_.template prepare<kDepth>(i, x, sums, staged);
      before += first + none;
      after += select(best < std::numeric_limits<double>::infinity(), best, V8{});
    });
    return {0.5 * sum(before), 0.5 * sum(after)};
  }

  Layout l_;
  Rows rows_;
  Pool pool_;
  Equations<D> equations_;
  ReducedSystem<D> reduced_;
  std::vector<Objectives> partial_;
  bool is_prepared_ = false;
  std::vector<Buffer<Images>> images_;  // of each thread
  std::vector<Buffer<V8>> staged_;      // the same: rows of a batch
};

template <int D>
class SparseFactorOf final : public SparseFactor {
 public:
  explicit SparseFactorOf(const Rows32& upper)
      : factor_(upper, {std::numeric_limits<std::int64_t>::max(), std::numeric_limits<double>::infinity()}),
        blocks_(upper.index.size()) {}

  bool solve(const double* blocks, double* x) override {
    for (Block<D>& block : blocks_) {
      clear(&block, 1);
      for (int r = 0; r < D; ++r)
        for (int c = 0; c < D; ++c) set_entry(block, r, c, *blocks++);
    }
    if (!factor_.factor(blocks_.data())) return false;
    factor_.solve(x);
    return true;
  }

 private:
  SparseCholesky<D> factor_;
  Buffer<Block<D>> blocks_;
};

}  // namespace ba::BA_TARGET
