// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// S by blocks where keyframes share points. Structure and memory are made once, then only numbers change.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "block_fill.hpp"
#include "blocks.hpp"
#include "coupling.hpp"
#include "layout.hpp"
#include "pool.hpp"

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
  SparseSchur(const Layout& l, int threads) : l_(l), pattern_(shared_points(l)) {
    blocks_.resize(pattern_.index.size());
    cut_rows(threads);
  }

  const Rows32& pattern() const { return pattern_; }
  const Buffer<Block<D>>& blocks() const { return blocks_; }

  // S = B + damping - Z Z', summed point by point. add_diagonal(k, block): add B and damping of keyframe k.
  template <class Add>
  void assemble(Pool& pool, Coupling<D>& coupling, Add add_diagonal) {
    clear(blocks_.data(), static_cast<std::int64_t>(blocks_.size()));
    coupling.with_edges(pool, [&](std::int64_t part, std::int64_t first, std::int64_t end, const Edge<D>* z) {
      const std::int64_t last = std::min(kLanes * end, l_.n_points);
      const std::int32_t offset = l_.point_edge[kLanes * first];
      for (std::int64_t p = kLanes * first; p < last; ++p) sum_point(p, rows_cut_[part], rows_cut_[part + 1], z - offset);
    });
    for (std::int64_t k = 0; k < l_.n_free; ++k) add_diagonal(k, blocks_[pattern_.start[k]]);
  }

  // The diagonal blocks alone, n_free.
  template <class Add>
  void diagonal(Pool& pool, Coupling<D>& coupling, Add add_diagonal, Block<D>* out) const {
    clear(out, l_.n_free);
    coupling.with_edges(pool, [&](std::int64_t part, std::int64_t first, std::int64_t end, const Edge<D>* z) {
      const std::int32_t begin = l_.point_edge[kLanes * first], stop = l_.point_edge[kLanes * end];
      for (std::int32_t e = begin; e < stop; ++e) {
        const std::int32_t k = l_.edge_column[e];
        if (k >= rows_cut_[part] && k < rows_cut_[part + 1]) subtract_product(out[k], z[e - begin], z[e - begin]);
      }
    });
    for (std::int64_t k = 0; k < l_.n_free; ++k) add_diagonal(k, out[k]);
  }

 private:
  // What a point adds to rows [begin, end). z: by edge.
  void sum_point(std::int64_t p, std::int64_t begin, std::int64_t end, const Edge<D>* z) {
    const std::int32_t last = l_.point_edge[p + 1];
    for (std::int32_t e = l_.point_edge[p]; e < last; ++e) {
      const std::int32_t i = l_.edge_column[e];
      if (i < begin) continue;
      if (i >= end) return;
      const std::int32_t *index = &pattern_.index[pattern_.start[i]], *stop = &pattern_.index[pattern_.start[i + 1]];
      Block<D>* row = &blocks_[pattern_.start[i]];
      const std::int32_t* at = index;
      for (std::int32_t f = e; f < last; ++f) {
        // Columns rise. No further on than this, and just there if all columns between are in the row.
        const std::int32_t j = l_.edge_column[f];
        const std::int32_t* most = at + std::min<std::ptrdiff_t>(j - *at, stop - at - 1);
        at = *most == j ? most : std::lower_bound(at, most, j);
        subtract_product(row[at - index], z[e], z[f]);
      }
    }
  }

  // Rows of S for each thread, about as many pairs of edges for each. What a row sums does not depend on it.
  void cut_rows(int threads) {
    std::vector<double> pairs(l_.n_free, 0.0);
    double all = 0, done = 0;
    for (std::int64_t e = 0; e < l_.n_edges(); ++e) {
      pairs[l_.edge_column[e]] += l_.edge_end[e] - e;
      all += l_.edge_end[e] - e;
    }
    rows_cut_.push_back(0);
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      done += pairs[i];
      while (static_cast<int>(rows_cut_.size()) < threads && done >= all * static_cast<double>(rows_cut_.size()) / threads)
        rows_cut_.push_back(i + 1);
    }
    rows_cut_.resize(threads + 1, l_.n_free);
  }

  const Layout& l_;
  Rows32 pattern_;
  Buffer<Block<D>> blocks_;
  std::vector<std::int64_t> rows_cut_;
};

}  // namespace ba
