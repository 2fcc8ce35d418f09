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
  SparseSchur(const Layout& l, const FillLimits& limits) : pattern_(shared_points(l)), factor_(pattern_, limits) {
    blocks_.resize(factor_.fill().complete ? pattern_.index.size() : 0);
  }

  const Rows32& pattern() const { return pattern_; }
  const Fill& fill() const { return factor_.fill(); }
  const Buffer<Block<D>>& blocks() const { return blocks_; }

  // Blocks (i, j) of a row for rising j.
  class Row {
   public:
    Row(const std::int32_t* begin, const std::int32_t* end, Block<D>* blocks)
        : begin_(begin), at_(begin), end_(end), blocks_(blocks) {}
    void rewind() { at_ = begin_; }
    Block<D>& operator()(std::int32_t j) {
      // No further than this, and just there if the columns between are all in the row.
      const std::int32_t* most = at_ + std::min<std::ptrdiff_t>(j - *at_, end_ - at_ - 1);
      at_ = *most == j ? most : std::lower_bound(at_, most, j);
      return blocks_[at_ - begin_];
    }

   private:
    const std::int32_t *begin_, *at_, *end_;
    Block<D>* blocks_;
  };

  Row row(std::int64_t i) {
    const std::int32_t* index = pattern_.index.data();
    return Row(index + pattern_.start[i], index + pattern_.start[i + 1], &blocks_[pattern_.start[i]]);
  }

  void clear_rows(std::int64_t begin, std::int64_t end) {
    clear(blocks_.data() + pattern_.start[begin], pattern_.start[end] - pattern_.start[begin]);
  }

  // add(i, out): add to the D x D numbers of the diagonal block of row i.
  template <class Add>
  void add_diagonal(std::int64_t i, Add add) {
    double own[D * D];
    Block<D>& block = blocks_[pattern_.start[i]];
    write_block(block, own, D);
    add(i, own);
    for (int r = 0; r < D; ++r)
      for (int c = 0; c < D; ++c) set_entry(block, r, c, own[r * D + c]);
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
};

}  // namespace ba
