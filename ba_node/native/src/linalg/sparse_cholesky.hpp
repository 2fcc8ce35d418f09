// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Cholesky of a symmetric matrix of D x D blocks, left-looking by block columns::
//
//     C_ij = S_ij - sum_k<j L_ik L_jk',    C_jj = L_jj L_jj',    L_ij = C_ij L_jj^-T
//
// All memory is had when the structure is found; a factorisation takes none.
#pragma once

#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "linalg/block_fill.hpp"
#include "linalg/blocks.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

template <int D>
class SparseCholesky {
 public:
  // upper: pattern of S, rows of the upper triangle with the diagonal first.
  explicit SparseCholesky(const Rows32& upper, const FillLimits& limits) : fill_(find_fill(upper, limits)) {
    if (!fill_.complete) return;
    const std::int64_t n = upper.count();
    column_.resize(fill_.below.index.size());
    diagonal_.resize(n);
    inverse_.resize(n);
    x_.resize(n * D);
    find_rows(n);
    find_sources(upper);
    target_.assign(n, -1);
  }

  const Fill& fill() const { return fill_; }

  // Factor; s: blocks of the upper triangle in the order of the pattern. False if it is not positive definite.
  //
  // On one thread: columns follow one another, and what two threads gain in one they lose in handing it over.
  bool factor(const Block<D>* s) {
    const std::int64_t n = static_cast<std::int64_t>(diagonal_.size());
    for (std::int64_t j = 0; j < n; ++j) {
      for (std::int64_t k = fill_.below.start[j]; k < fill_.below.start[j + 1]; ++k)
        target_[fill_.below.index[k]] = static_cast<std::int32_t>(k);
      load_diagonal(j, s);
      for (std::int64_t r = rows_.start[j]; r < rows_.start[j + 1]; ++r)
        subtract_transposed(diagonal_[j], column_[rows_.index[r]], column_[rows_.index[r]]);
      if (!factor_diagonal(diagonal_[j], inverse_[j])) return false;
      finish_rows(j, s);
    }
    return true;
  }

  // x: right-hand side in, solution out; D numbers a block, in the caller's order.
  void solve(double* x) {
    const std::int64_t n = static_cast<std::int64_t>(diagonal_.size());
    for (std::int64_t j = 0; j < n; ++j)
      for (int i = 0; i < D; ++i) x_[j * D + i] = x[fill_.order[j] * D + i];
    double part[D];
    for (std::int64_t j = 0; j < n; ++j) {
      apply_inverse(j, false, part);
      for (std::int64_t k = fill_.below.start[j]; k < fill_.below.start[j + 1]; ++k)
        add_multiplied<-1>(column_[k], part, &x_[fill_.below.index[k] * D]);
    }
    for (std::int64_t j = n - 1; j >= 0; --j) {
      for (std::int64_t k = fill_.below.start[j]; k < fill_.below.start[j + 1]; ++k)
        add_multiplied_transposed<-1>(column_[k], &x_[fill_.below.index[k] * D], &x_[j * D]);
      apply_inverse(j, true, part);
    }
    for (std::int64_t j = 0; j < n; ++j)
      for (int i = 0; i < D; ++i) x[fill_.order[j] * D + i] = x_[j * D + i];
  }

 private:
  struct Source {
    std::int64_t block;
    std::int32_t target;  // place in the column, -1 for the diagonal
    bool turned;
  };

  // Blocks of each row of L left of the diagonal, and where their columns end.
  void find_rows(std::int64_t n) {
    std::vector<std::int64_t> count(n + 1, 0);
    for (std::int32_t i : fill_.below.index) ++count[i + 1];
    for (std::int64_t i = 0; i < n; ++i) count[i + 1] += count[i];
    rows_.start = count;
    rows_.index.resize(fill_.below.index.size());
    row_end_.resize(rows_.index.size());
    for (std::int64_t j = 0; j < n; ++j) {
      for (std::int64_t k = fill_.below.start[j]; k < fill_.below.start[j + 1]; ++k) {
        const std::int64_t at = count[fill_.below.index[k]]++;
        rows_.index[at] = static_cast<std::int32_t>(k);
        row_end_[at] = static_cast<std::int32_t>(fill_.below.start[j + 1]);
      }
    }
  }

  // Where each block of L comes from in S.
  void find_sources(const Rows32& upper) {
    const std::int64_t n = upper.count();
    std::vector<std::int64_t> count(n + 1, 0);
    for (int pass = 0; pass < 2; ++pass) {
      for (std::int64_t i = 0; i < n; ++i) {
        for (std::int64_t k = upper.start[i]; k < upper.start[i + 1]; ++k) {
          const std::int32_t a = fill_.place[i], b = fill_.place[upper.index[k]];
          const std::int32_t column = std::min(a, b), row = std::max(a, b);
          if (pass == 0) {
            ++count[column + 1];
            continue;
          }
          std::int32_t target = -1;
          if (row != column) {
            const auto begin = fill_.below.index.begin();
            const auto found =
                std::lower_bound(begin + fill_.below.start[column], begin + fill_.below.start[column + 1], row);
            target = static_cast<std::int32_t>(found - begin);
          }
          // S_ij lies in row i: L wants its row `row`, which is i only if i comes later.
          sources_[count[column]++] = {k, target, a < b};
        }
      }
      if (pass == 0) {
        for (std::int64_t i = 0; i < n; ++i) count[i + 1] += count[i];
        source_start_ = count;
        sources_.resize(upper.index.size());
      }
    }
  }

  void load_diagonal(std::int64_t j, const Block<D>* s) {
    for (std::int64_t k = source_start_[j]; k < source_start_[j + 1]; ++k)
      if (sources_[k].target < 0) diagonal_[j] = s[sources_[k].block];
  }

  // The factor's column j below the diagonal.
  void finish_rows(std::int64_t j, const Block<D>* s) {
    const std::int64_t begin = fill_.below.start[j], end = fill_.below.start[j + 1];
    clear(column_.data() + begin, end - begin);
    for (std::int64_t k = source_start_[j]; k < source_start_[j + 1]; ++k)
      if (sources_[k].target >= 0) copy(s[sources_[k].block], sources_[k].turned, column_[sources_[k].target]);
    for (std::int64_t r = rows_.start[j]; r < rows_.start[j + 1]; ++r) {
      const std::int64_t at = rows_.index[r], last = row_end_[r];
      const Block<D> own = column_[at];
      for (std::int64_t k = at + 1; k < last; ++k)
        subtract_transposed(column_[target_[fill_.below.index[k]]], column_[k], own);
    }
    for (std::int64_t k = begin; k < end; ++k) {
      const Block<D> c = column_[k];
      clear(&column_[k], 1);
      subtract_transposed(column_[k], c, inverse_[j]);  // of the negative inverse
    }
  }

  static void copy(const Block<D>& from, bool turned, Block<D>& to) {
    to = from;
    if (!turned) return;
    for (int c = 0; c < D; ++c)
      for (int r = 0; r < D; ++r) set_entry(to, r, c, entry(from, c, r));
  }

  // c: in a symmetric block, of which the lower triangle counts. negative: out -L^-1.
  static bool factor_diagonal(const Block<D>& c, Block<D>& negative) {
    double l[D][D], inverse[D][D] = {};
    for (int j = 0; j < D; ++j) {
      double pivot = entry(c, j, j);
      for (int k = 0; k < j; ++k) pivot -= l[j][k] * l[j][k];
      if (!(pivot > 0.0) || !std::isfinite(pivot)) return false;
      l[j][j] = std::sqrt(pivot);
      for (int i = j + 1; i < D; ++i) {
        double value = entry(c, i, j);
        for (int k = 0; k < j; ++k) value -= l[i][k] * l[j][k];
        l[i][j] = value / l[j][j];
      }
    }
    for (int j = 0; j < D; ++j) {
      inverse[j][j] = 1.0 / l[j][j];
      for (int i = j + 1; i < D; ++i) {
        double value = 0;
        for (int k = j; k < i; ++k) value -= l[i][k] * inverse[k][j];
        inverse[i][j] = value / l[i][i];
      }
    }
    clear(&negative, 1);
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) set_entry(negative, i, j, -inverse[i][j]);
    return true;
  }

  // x_j <- L_jj^-1 x_j or L_jj^-T x_j; also in out.
  void apply_inverse(std::int64_t j, bool transposed, double* out) {
    for (int i = 0; i < D; ++i) out[i] = 0.0;
    if (transposed)
      add_multiplied_transposed<-1>(inverse_[j], &x_[j * D], out);
    else
      add_multiplied<-1>(inverse_[j], &x_[j * D], out);
    for (int i = 0; i < D; ++i) x_[j * D + i] = out[i];
  }

  Fill fill_;
  Rows32 rows_;
  std::vector<std::int32_t> row_end_, target_;
  std::vector<std::int64_t> source_start_;
  std::vector<Source> sources_;
  Buffer<Block<D>> column_, diagonal_, inverse_;
  Buffer<double> x_;
};

}  // namespace ba::BA_TARGET
