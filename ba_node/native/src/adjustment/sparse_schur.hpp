// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// S by blocks where keyframes share points. Structure and memory are made once, then only numbers change.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

#include "adjustment/alike.hpp"
#include "adjustment/coupling.hpp"
#include "adjustment/layout.hpp"
#include "linalg/block_fill.hpp"
#include "linalg/blocks.hpp"
#include "parallel/pool.hpp"

namespace ba::BA_TARGET {

// The same of up to 64 free keyframes, each a bit.
inline Rows32 coupled_by_bits(const Layout& l, const CoupledPairs& factors) {
  std::array<std::uint64_t, 64> met{};
  const auto bit = [](std::int32_t k) { return std::uint64_t{1} << k; };
  for (std::size_t p = 0; p + 1 < l.point_edge.size(); ++p) {
    std::uint64_t seen_by = 0;
    for (std::int32_t e = l.point_edge[p]; e < l.point_edge[p + 1]; ++e) seen_by |= bit(l.edge_column[e]);
    for (std::int32_t e = l.point_edge[p]; e < l.point_edge[p + 1]; ++e) met[l.edge_column[e]] |= seen_by;
  }
  for (std::size_t k = 0; k < factors.size(); ++k) met[factors.row[k]] |= bit(factors.column[k]);
  Rows32 upper;
  for (std::int32_t i = 0; i < l.n_free; ++i) {
    upper.index.push_back(i);
    for (std::int32_t j = i + 1; j < l.n_free; ++j)
      if (met[i] & bit(j)) upper.index.push_back(j);
    upper.close_row();
  }
  return upper;
}

// Pairs (i, j >= i) of free keyframes that share a point or a factor, the diagonal first in each row.
inline Rows32 coupled(const Layout& l, const CoupledPairs& factors) {
  if (l.n_free <= 64) return coupled_by_bits(l, factors);
  Rows32 upper;
  std::vector<std::int32_t> met_by(l.n_free, -1);
  std::size_t next = 0;
  for (std::int64_t i = 0; i < l.n_free; ++i) {
    const auto row = static_cast<std::int32_t>(i);
    upper.index.push_back(row);
    met_by[i] = row;
    for (std::int64_t k = l.keyframe_edge[i]; k < l.keyframe_edge[i + 1]; ++k) {
      const std::int64_t e = l.edges_of_keyframe[k];
      for (std::int64_t f = e; f < l.edge_end[e]; ++f) {
        const std::int32_t j = l.edge_column[f];
        if (met_by[j] == row) continue;
        met_by[j] = row;
        upper.index.push_back(j);
      }
    }
    for (; next < factors.size() && factors.row[next] == row; ++next)
      if (met_by[factors.column[next]] != row) upper.index.push_back(factors.column[next]);
    upper.close_row();
    std::sort(upper.index.begin() + upper.start[i] + 1, upper.index.end());
  }
  return upper;
}

template <int D>
class SparseSchur {
 public:
  SparseSchur(const Layout& l, const CoupledPairs& factors, int threads) : l_(l), pattern_(coupled(l, factors)) {
    cut_points();
    index_rows();
    alike_ = std::make_unique<AlikeBatches<D>>(
        l_, cut_, threads, [this](std::int32_t i, std::int32_t j) { return pattern_.start[i] + place_in_row(i, j); });
    order_edges();
    scratch_.resize(most_edges_ * threads);
    blocks_.resize(n_blocks() * n_partials());
    diagonal_.resize(l_.n_free * n_partials());
    sums_.resize(l_.n_free * n_partials());
    for (std::size_t k = 0; k < factors.size(); ++k)
      place_of_pair_.push_back(pattern_.start[factors.row[k]] + place_in_row(factors.row[k], factors.column[k]));
  }

  const Rows32& pattern() const { return pattern_; }
  // In the order of the pattern.
  const Block<D>* blocks() const { return blocks_.data(); }

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

  // S = B + damping - Z Z'. add_diagonal(k, block): add B and damping of keyframe k. pairs: blocks of B of the pairs
  // that factors couple.
  template <class Add>
  void assemble(Pool& pool, const Coupling<D>& coupling, Add add_diagonal, const Buffer<Block<D>>& pairs) {
    pool.each(n_partials(), [&](std::int64_t partial, int thread) {
      Block<D>* blocks = &blocks_[partial * n_blocks()];
      Column<D>* sums = &sums_[partial * l_.n_free];
      clear(blocks, n_blocks());
      clear(sums, l_.n_free);
      alike_->sum(partial, thread, coupling, blocks, sums);
      const auto by_edges = [this](std::int64_t batch) { return !alike_->has(batch); };
      each_strip(partial, coupling, thread, by_edges, [&](std::int64_t strip, const Edge<D>* z) {
        for (std::int64_t at = first_edge(strip_[strip]); at < order_end_[strip]; ++at) {
          const std::int32_t e = order_[at];
          sum_edges(e, z, blocks);
          for (std::int32_t f = e; f < std::min(e + kRowsAtOnce, l_.edge_end[e]); ++f) add_scaled(f, z, coupling, sums);
        }
      });
    });
    pool.each(n_partials() > 1 ? kSumTasks : 0, [&](std::int64_t task, int) {
      add_partials(blocks_.data(), n_blocks(), n_blocks() * task / kSumTasks, n_blocks() * (task + 1) / kSumTasks);
    });
    add_partials(sums_.data(), l_.n_free, 0, l_.n_free);
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      Block<D>& block = blocks_[pattern_.start[k]];
      if constexpr (kByLanes<D>) mirror(block);
      add_diagonal(k, block);
    }
    for (std::size_t k = 0; k < place_of_pair_.size(); ++k) add(blocks_[place_of_pair_[k]], pairs[k]);
  }

  // Z L^-1 gp by free keyframe, of the last assemble() or diagonal().
  const Column<D>* sums() const { return sums_.data(); }

  // The diagonal blocks alone, n_free.
  template <class Add>
  const Block<D>* diagonal(Pool& pool, const Coupling<D>& coupling, Add add_diagonal) {
    pool.each(n_partials(), [&](std::int64_t partial, int thread) {
      Block<D>* blocks = &diagonal_[partial * l_.n_free];
      Column<D>* sums = &sums_[partial * l_.n_free];
      clear(blocks, l_.n_free);
      clear(sums, l_.n_free);
      const auto all = [](std::int64_t) { return true; };
      each_strip(partial, coupling, thread, all, [&](std::int64_t strip, const Edge<D>* z) {
        for (std::int64_t e = first_edge(strip_[strip]); e < first_edge(strip_[strip + 1]); ++e) {
          subtract_product(blocks[l_.edge_column[e]], Left<D>(z[e]), z[e]);
          add_scaled(e, z, coupling, sums);
        }
      });
    });
    add_partials(diagonal_.data(), l_.n_free, 0, l_.n_free);
    add_partials(sums_.data(), l_.n_free, 0, l_.n_free);
    for (std::int64_t k = 0; k < l_.n_free; ++k) add_diagonal(k, diagonal_[k]);
    return diagonal_.data();
  }

 private:
  // Partial sums, of one section, two or all, are each made by one thread and then added in turn: the problem alone
  // decides how many.
  static constexpr std::int64_t kSumTasks = 16;
  // One more is worth it from so much work for each block, in half pairs, and up to so much memory for all.
  static constexpr std::int64_t kWorkOfBlock = 200, kPartialBytes = 20 << 20, kPartialBytesOfObservation = 32;
  // Z of as many points as stay in the nearer caches.
  static constexpr std::int64_t kStripBytes = 256 << 10;

  // Edges of a point whose rows are summed together.
  static constexpr std::int32_t kRowsAtOnce = kProductsByTwo ? 2 : 1;
  // Columns of a row for each of its blocks up to which it has a table; what stands for none.
  static constexpr std::int64_t kMaxSpan = 32, kSearched = std::numeric_limits<std::int64_t>::min();

  std::int64_t n_blocks() const { return static_cast<std::int64_t>(pattern_.index.size()); }
  std::int64_t n_partials() const { return static_cast<std::int64_t>(cut_.size()) - 1; }

  // Where the points of each partial sum begin, as batches. Z of an edge takes as long as a pair and a half.
  void cut_points() {
    const std::int64_t twice = 3 * l_.n_edges() + 2 * l_.n_pairs();
    const std::int64_t n = std::max<std::int64_t>(n_blocks(), 1);
    const std::int64_t most_bytes = std::max(kPartialBytes, kPartialBytesOfObservation * l_.n_obs);
    const std::int64_t fit = most_bytes / (n * static_cast<std::int64_t>(sizeof(Block<D>)));
    const std::int64_t most = std::min({1 + twice / (kWorkOfBlock * n), fit, l_.n_sections()});
    const std::int64_t count = most >= 4 ? 4 : most >= 2 ? 2 : 1;
    for (std::int64_t i = 0; i <= count; ++i) cut_.push_back(l_.sections[i * l_.n_sections() / count]);
  }

  // Cut the batches into strips, and put the edges of each in the order of their rows: a row stays in the nearest cache
  // while all edges of the strip add to it. Of a point every kRowsAtOnce-th edge stands for those after it. Those of
  // batches that are alike are not among them.
  void order_edges() {
    const std::int64_t fit = kStripBytes / static_cast<std::int64_t>(sizeof(Edge<D>));
    for (std::int64_t partial = 0; partial < n_partials(); ++partial) {
      partial_strip_.push_back(static_cast<std::int64_t>(strip_.size()));
      for (std::int64_t i = cut_[partial]; i < cut_[partial + 1]; ++i)
        if (i == cut_[partial] || first_edge(i + 1) - first_edge(strip_.back()) > fit) strip_.push_back(i);
    }
    partial_strip_.push_back(static_cast<std::int64_t>(strip_.size()));
    strip_.push_back(l_.n_batches);
    std::vector<std::int32_t> begin;
    for (std::int64_t batch : strip_) begin.push_back(static_cast<std::int32_t>(first_edge(batch)));
    for (std::size_t i = 1; i < begin.size(); ++i)
      most_edges_ = std::max<std::int64_t>(most_edges_, begin[i] - begin[i - 1]);
    order_.resize(l_.n_edges());
    std::vector<std::int32_t> strip_of(l_.n_edges(), -1);  // of the edges that stand for others
    std::int32_t strip = 0;
    place_of_gradient_.resize(l_.n_edges());
    for (std::int64_t p = 0; p + 1 < static_cast<std::int64_t>(l_.point_edge.size()); ++p) {
      for (std::int32_t e = l_.point_edge[p]; e < l_.point_edge[p + 1]; ++e) {
        while (e >= begin[strip + 1]) ++strip;
        if ((e - l_.point_edge[p]) % kRowsAtOnce == 0 && !alike_->has(p / kLanes)) strip_of[e] = strip;
        place_of_gradient_[e] = static_cast<std::int32_t>(p / kLanes * 3 * kLanes + p % kLanes);
      }
    }
    order_end_ = begin;
    for (std::int32_t e : l_.edges_of_keyframe)
      if (strip_of[e] >= 0) order_[order_end_[strip_of[e]]++] = e;
  }

  std::int64_t first_edge(std::int64_t batch) const { return l_.point_edge[kLanes * batch]; }

  // Call sum(strip, z) for the strips of a partial sum; z[e]: Z of their edges, in the batches that `wanted` tells.
  template <class Wanted, class Sum>
  void each_strip(std::int64_t partial, const Coupling<D>& coupling, int thread, Wanted wanted, Sum sum) {
    for (std::int64_t strip = partial_strip_[partial]; strip < partial_strip_[partial + 1]; ++strip) {
      Edge<D>* z = &scratch_[thread * most_edges_] - first_edge(strip_[strip]);
      for (std::int64_t i = strip_[strip]; i < strip_[strip + 1]; ++i)
        if (wanted(i)) coupling.edges_of(i, z);
      sum(strip, z);
    }
  }

  // What an edge adds to Z y, y = L^-1 gp.
  void add_scaled(std::int64_t e, const Edge<D>* z, const Coupling<D>& coupling, Column<D>* sums) const {
    const double* y = reinterpret_cast<const double*>(coupling.scaled_gradient(0)) + place_of_gradient_[e];
    Column<D>& sum = sums[l_.edge_column[e]];
    sum.a += z[e].a[0] * y[0] + z[e].a[1] * y[kLanes] + z[e].a[2] * y[2 * kLanes];
    if constexpr (D == 9) sum.b += z[e].b[0] * y[0] + z[e].b[1] * y[kLanes] + z[e].b[2] * y[2 * kLanes];
  }

  // Onto the blocks or columns [begin, end) of the first partial sum those of the others; n: of each.
  template <class T>
  void add_partials(T* blocks, std::int64_t n, std::int64_t begin, std::int64_t end) const {
    const std::int64_t count = static_cast<std::int64_t>(sizeof(T) / sizeof(double));
    double* to = reinterpret_cast<double*>(blocks);
    for (std::int64_t partial = 1; partial < n_partials(); ++partial) {
      const double* from = to + partial * n * count;
      for (std::int64_t i = begin * count; i < end * count; ++i) to[i] += from[i];
    }
  }

  // What the pairs of an edge, or of kRowsAtOnce of a point, with themselves and the later ones add to their rows. z:
  // by edge.
  void sum_edges(std::int32_t e, const Edge<D>* z, Block<D>* blocks) const {
    const std::int32_t *column = l_.edge_column.data(), i = column[e], end = l_.edge_end[e];
    const bool is_last = kRowsAtOnce == 1 || e + 1 == end;
    const bool has_tables = place_of_[i] != kSearched && (is_last || place_of_[column[e + 1]] != kSearched);
    if (is_last || !has_tables) {
      for (std::int32_t f = e; f < (is_last ? e + 1 : e + 2); ++f) sum_edge(f, z, blocks);
      return;
    }
    const std::int32_t j = column[e + 1];
    const Left<D> left(z[e]), second(z[e + 1]);
    Block<D>*row = blocks + pattern_.start[i], *next = blocks + pattern_.start[j];
    const std::int32_t *place = place_.data() + place_of_[i], *place_in_next = place_.data() + place_of_[j];
    subtract_product(row[0], left, z[e]);
    for (std::int32_t f = e + 1; f < end; ++f)
      subtract_products(row[place[column[f]]], next[place_in_next[column[f]]], left, second, z[f]);
  }

  // What the pairs of an edge with itself and the later ones of its point add to its row. z: by edge.
  void sum_edge(std::int32_t e, const Edge<D>* z, Block<D>* blocks) const {
    const std::int32_t *column = l_.edge_column.data(), i = column[e], end = l_.edge_end[e];
    const Left<D> left(z[e]);
    Block<D>* row = blocks + pattern_.start[i];
    if (place_of_[i] == kSearched) {
      for (std::int32_t f = e; f < end; ++f) subtract_product(row[place_in_row(i, column[f])], left, z[f]);
      return;
    }
    const std::int32_t* place = place_.data() + place_of_[i];
    for (std::int32_t f = e; f < end; ++f) subtract_product(row[place[column[f]]], left, z[f]);
  }

  // Where in row i the block of column j is.
  std::int64_t place_in_row(std::int64_t i, std::int32_t j) const {
    if (place_of_[i] != kSearched) return place_[place_of_[i] + j];
    const std::int32_t *first = &pattern_.index[pattern_.start[i]], *stop = &pattern_.index[pattern_.start[i + 1]];
    return std::lower_bound(first, stop, j) - first;
  }

  // Where in its row a block is, by column from the diagonal to the last, unless that is too long for what it holds.
  void index_rows() {
    for (std::int64_t i = 0; i < l_.n_free; ++i) {
      const std::int64_t begin = pattern_.start[i], end = pattern_.start[i + 1];
      const std::int64_t span = pattern_.index[end - 1] - i + 1;
      if (span > kMaxSpan * (end - begin)) {
        place_of_.push_back(kSearched);
        continue;
      }
      place_of_.push_back(static_cast<std::int64_t>(place_.size()) - i);
      place_.resize(place_.size() + span);
      for (std::int64_t k = begin; k < end; ++k)
        place_[place_of_[i] + pattern_.index[k]] = static_cast<std::int32_t>(k - begin);
    }
  }

  const Layout& l_;
  Rows32 pattern_;
  std::vector<std::int64_t> cut_;
  std::unique_ptr<AlikeBatches<D>> alike_;
  Buffer<Block<D>> blocks_, diagonal_;               // of each partial sum; the sums are in the first
  Buffer<Column<D>> sums_;                           // the same
  std::vector<std::int64_t> strip_, partial_strip_;  // first batch of each strip; first strip of each partial sum
  // Edges, strip by strip and there by rows; where in it those of a strip end, which begin where its first edge would.
  Buffer<std::int32_t> order_;
  std::vector<std::int32_t> order_end_;
  Buffer<std::int32_t> place_of_gradient_;  // where y of the point of an edge begins
  std::int64_t most_edges_ = 0;             // of a strip
  Buffer<Edge<D>> scratch_;                 // of each thread
  Buffer<std::int32_t> place_;              // for columns between those of the row, nothing
  std::vector<std::int64_t> place_of_pair_;
  std::vector<std::int64_t> place_of_;  // of column j of row i: place_[place_of_[i] + j], or kSearched
};

}  // namespace ba::BA_TARGET
