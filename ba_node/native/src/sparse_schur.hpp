// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// S by blocks where keyframes share points, and its factor. Structure and memory are made once, then only numbers change.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "blocks.hpp"
#include "layout.hpp"
#include "pool.hpp"
#include "sparse_cholesky.hpp"

namespace ba {

// Pairs (i, j >= i) of free keyframes that share a point, the diagonal first in each row.
inline Rows32 shared_points(const Layout& l) {
  Rows32 upper;
  std::vector<std::int32_t> seen_by(l.n_free, -1);
  for (std::int64_t i = 0; i < l.n_free; ++i) {
    const auto row = static_cast<std::int32_t>(i);
    upper.index.push_back(row);
    seen_by[i] = row;
    for (std::int64_t k = l.keyframe_edge[i]; k < l.keyframe_edge[i + 1]; ++k) {
      const std::int64_t e = l.edges_of_keyframe[k];
      for (std::int64_t f = e; f < l.edge_end[e]; ++f) {
        const std::int32_t j = l.edge_column[f];
        if (seen_by[j] == row) continue;
        seen_by[j] = row;
        upper.index.push_back(j);
      }
    }
    upper.close_row();
    std::sort(upper.index.begin() + upper.start[i] + 1, upper.index.end());
  }
  return upper;
}

template <int D>
class SparseSchur {
 public:
  SparseSchur(const Layout& l, int threads, const FillLimits& limits)
      : pattern_(shared_points(l)), factor_(pattern_, limits) {
    blocks_.resize(factor_.fill().complete ? pattern_.index.size() : 0);
    place_.resize(threads * l.n_free);
  }

  const Rows32& pattern() const { return pattern_; }
  const Fill& fill() const { return factor_.fill(); }
  const Buffer<Block<D>>& blocks() const { return blocks_; }

  // add_row(i, find): add row i of -Z Z' to the blocks find(j), j >= i. add_diagonal(i, out): add B and damping, D x D.
  template <class AddRow, class AddDiagonal>
  void assemble(Pool& pool, AddRow add_row, AddDiagonal add_diagonal) {
    pool.each(pattern_.count(), [&](std::int64_t i, int thread) {
      const std::int64_t begin = pattern_.start[i], end = pattern_.start[i + 1];
      std::int32_t* place = &place_[thread * pattern_.count()];
      clear(&blocks_[begin], end - begin);
      for (std::int64_t k = begin; k < end; ++k) place[pattern_.index[k]] = static_cast<std::int32_t>(k);
      add_row(i, [&](std::int32_t j) -> Block<D>& { return blocks_[place[j]]; });
      double own[D * D];
      Block<D>& block = blocks_[begin];
      write_block(block, own, D);
      add_diagonal(i, own);
      for (int r = 0; r < D; ++r)
        for (int c = 0; c < D; ++c) set_entry(block, r, c, own[r * D + c]);
    });
  }

  // x: right-hand side in, solution out. False if S is not positive definite.
  bool solve(double* x) {
    if (!factor_.factor(blocks_)) return false;
    factor_.solve(x);
    return true;
  }

 private:
  Rows32 pattern_;
  SparseCholesky<D> factor_;
  Buffer<Block<D>> blocks_;
  std::vector<std::int32_t> place_;  // of each thread: where the block of a column is
};

}  // namespace ba
