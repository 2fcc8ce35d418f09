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
    index_rows();
  }

  const Rows32& pattern() const { return pattern_; }
  const Buffer<Block<D>>& blocks() const { return blocks_; }

  const Block<D>& diagonal_block(std::int64_t k) const { return blocks_[pattern_.start[k]]; }

  // S x, of what has been assembled.
  void multiply(const double* x, double* out) const {
    std::fill_n(out, l_.n_free * D, 0.0);
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      for (std::int64_t k = pattern_.start[i]; k < pattern_.start[i + 1]; ++k) {
        const std::int64_t j = pattern_.index[k];
        add_multiplied<1>(blocks_[k], x + j * D, out + i * D);
        if (j != i) add_multiplied_transposed<1>(blocks_[k], x + i * D, out + j * D);
      }
    }
  }

  // S = B + damping - Z Z', summed point by point. add_diagonal(k, block): add B and damping of keyframe k.
  template <class Add>
  void assemble(Pool& pool, Coupling<D>& coupling, Add add_diagonal) {
    clear(blocks_.data(), static_cast<std::int64_t>(blocks_.size()));
    coupling.with_edges(pool, [&](std::int64_t part, std::int64_t first, std::int64_t end, const Edge<D>* z) {
      const std::int32_t begin = l_.point_edge[kLanes * first], stop = l_.point_edge[kLanes * end];
      for (std::int32_t e = begin; e < stop; ++e) {
        const std::int32_t i = l_.edge_column[e];
        if (i >= rows_cut_[part] && i < rows_cut_[part + 1]) sum_edge(e, i, z - begin);
      }
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
        if (k >= rows_cut_[part] && k < rows_cut_[part + 1]) subtract_product(out[k], Left<D>(z[e - begin]), z[e - begin]);
      }
    });
    for (std::int64_t k = 0; k < l_.n_free; ++k) add_diagonal(k, out[k]);
  }

 private:
  // What the pairs of an edge with itself and the later ones of its point add to row i. z: by edge.
  void sum_edge(std::int32_t e, std::int32_t i, const Edge<D>* z) {
    const Left<D> left(z[e]);
    const std::int32_t *place = place_.data() + place_of_[i], *column = l_.edge_column.data();
    Block<D>* row = &blocks_[pattern_.start[i]];
    for (std::int32_t f = e, end = l_.edge_end[e]; f < end; ++f) subtract_product(row[place[column[f]]], left, z[f]);
  }

  // Where in its row a block is, by row from the diagonal to the last.
  void index_rows() {
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      const std::int64_t begin = pattern_.start[i], end = pattern_.start[i + 1];
      place_of_.push_back(static_cast<std::int64_t>(place_.size()) - i);
      place_.resize(place_.size() + pattern_.index[end - 1] - i + 1);
      for (std::int64_t k = begin; k < end; ++k) place_[place_of_[i] + pattern_.index[k]] = static_cast<std::int32_t>(k - begin);
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
  Buffer<std::int32_t> place_;          // for columns between those of the row, nothing
  std::vector<std::int64_t> place_of_;  // of column j of row i: place_[place_of_[i] + j]
  std::vector<std::int64_t> rows_cut_;
};

}  // namespace ba
