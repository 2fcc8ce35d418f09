// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Batches all of whose points are seen by the same free keyframes, as most are where tracks begin and end together. The
// lanes of their blocks Z belong to the same block of S: products are summed lane by lane, over a run of such batches,
// and lanes only in the end. No lane is empty, S is read and written once a run, and Z need not be turned into columns.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "adjustment/coupling.hpp"
#include "adjustment/layout.hpp"
#include "linalg/blocks.hpp"
#include "parallel/memory.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

// Whether that pays: it needs 22 registers of eight, or 13 of four, and blocks of 9 x 9 leave few lanes empty as they
// are.
template <int D>
constexpr bool kByLanes = D == 6 && kHeld;

// A block of S less the sum over lanes of x y' over n batches, each `stride` after the one before; of one on the
// diagonal at least what is below it.
template <bool kDiagonal>
void subtract_lanes(Block<6>& s, const V8* x, const V8* y, std::int64_t n, std::int64_t stride);

#if defined(__AVX512F__)
// Three columns from kColumn on, from row kRow on.
template <int kColumn, int kRow>
BA_INLINE void subtract_columns(Block<6>& s, const V8* x, const V8* y, std::int64_t n, std::int64_t stride) {
  V8 sums[3][6] = {};
  for (std::int64_t k = 0; k < n; ++k, x += stride, y += stride) {
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
      const V8* b = y + 6 * i + kColumn;
      const V8 factor[3] = {b[0], b[1], b[2]};
#pragma GCC unroll 6
      for (int r = kRow; r < 6; ++r) {
        const V8 row = x[6 * i + r];
#pragma GCC unroll 3
        for (int c = 0; c < 3; ++c) sums[c][r] += row * factor[c];
      }
    }
  }
#pragma GCC unroll 3
  for (int c = 0; c < 3; ++c) {
    double* to = &s.v[kStride6 * (kColumn + c)];
    const V8 column = load(to) - lane_sums(sums[c]);
    std::memcpy(to, &column, sizeof(column));
  }
}

template <bool kDiagonal>
inline void subtract_lanes(Block<6>& s, const V8* x, const V8* y, std::int64_t n, std::int64_t stride) {
  subtract_columns<0, 0>(s, x, y, n, stride);
  subtract_columns<3, kDiagonal ? 3 : 0>(s, x, y, n, stride);
}
#elif defined(__AVX__)
// 3 x 3 numbers from kColumn and kRow on; kLower: of those what is on and below the diagonal. Left to itself g++ loads
// the factors anew for each product, which then wait for loads.
template <int kColumn, int kRow, bool kLower>
BA_INLINE void subtract_tile(Block<6>& s, const V8* x, const V8* y, std::int64_t n, std::int64_t stride) {
  Native4 sums[12] = {};
  for (std::int64_t k = 0; k < n; ++k, x += stride, y += stride) {
#pragma GCC unroll 6
    for (int i = 0; i < 6; ++i) {
      const auto* a = reinterpret_cast<const Native4*>(x + 6 * (i / 2) + kRow) + i % 2;
      const auto* b = reinterpret_cast<const Native4*>(y + 6 * (i / 2) + kColumn) + i % 2;
      const Native4 factor[3] = {held(b[0]), held(b[2]), held(b[4])};
#pragma GCC unroll 3
      for (int r = 0; r < 3; ++r) {
        const Native4 row = held(a[2 * r]);
#pragma GCC unroll 3
        for (int c = 0; c < 3; ++c)
          if (!kLower || r >= c) sums[3 * c + r] += row * factor[c];
      }
    }
  }
  double total[12];
#pragma GCC unroll 3
  for (int i = 0; i < 12; i += 4) {
    transpose(*reinterpret_cast<Native4(*)[4]>(sums + i));
    store4(total + i, (sums[i] + sums[i + 1]) + (sums[i + 2] + sums[i + 3]));
  }
#pragma GCC unroll 3
  for (int c = 0; c < 3; ++c)
#pragma GCC unroll 3
    for (int r = kLower ? c : 0; r < 3; ++r) s.v[kStride6 * (kColumn + c) + kRow + r] -= total[3 * c + r];
}

template <bool kDiagonal>
inline void subtract_lanes(Block<6>& s, const V8* x, const V8* y, std::int64_t n, std::int64_t stride) {
  subtract_tile<0, 0, kDiagonal>(s, x, y, n, stride);
  subtract_tile<0, 3, false>(s, x, y, n, stride);
  if constexpr (!kDiagonal) subtract_tile<3, 0, false>(s, x, y, n, stride);
  subtract_tile<3, 3, kDiagonal>(s, x, y, n, stride);
}
#endif

// What is above the diagonal, from what is below it.
inline void mirror(Block<6>& s) {
  for (int c = 0; c < 6; ++c)
    for (int r = 0; r < c; ++r) set_entry(s, r, c, entry(s, c, r));
}

template <int D>
class AlikeBatches {
 public:
  // cut: where partial sums begin, as batches; no run goes beyond. block_of(i, j): the number of a block of S.
  template <class BlockOf>
  AlikeBatches(const Layout& l, const std::vector<std::int64_t>& cut, int threads, BlockOf block_of) : l_(l) {
    in_run_.assign(l.n_batches, false);
    for (std::size_t partial = 0; partial + 1 < cut.size(); ++partial) {
      partial_run_.push_back(static_cast<std::int64_t>(runs_.size()));
      if constexpr (kByLanes<D>) find_runs(cut[partial], cut[partial + 1], block_of);
    }
    partial_run_.push_back(static_cast<std::int64_t>(runs_.size()));
    scratch_.resize(room_ * threads);
  }

  bool has(std::int64_t batch) const { return in_run_[batch]; }

  // What the runs of a partial sum add to S and to Z y.
  void sum(std::int64_t partial, int thread, const Coupling<D>& coupling, Block<D>* blocks, Column<D>* sums) {
    if constexpr (kByLanes<D>) {
      for (std::int64_t i = partial_run_[partial]; i < partial_run_[partial + 1]; ++i) {
        const Run& run = runs_[i];
        const std::int64_t n = run.end - run.begin, m = run.n_edges, stride = kNumbers * m;
        V8 *z = &scratch_[thread * room_], *of_gradient = z + n * stride;
        clear(of_gradient, D * m);
        for (std::int64_t k = 0; k < n; ++k) coupling.edges_by_lane(run.begin + k, z + k * stride, of_gradient);
        const std::int32_t* block = &block_[run.first_block];
        for (std::int64_t a = 0; a < m; ++a) {
          sums[columns_of(run.begin)[a]].a += lane_sums(*reinterpret_cast<const V8(*)[6]>(of_gradient + D * a));
          const V8* x = z + kNumbers * a;
          // Of a block on the diagonal what is above it is mirrored in the end.
          subtract_lanes<true>(blocks[*block++], x, x, n, stride);
          for (std::int64_t b = a + 1; b < m; ++b)
            subtract_lanes<false>(blocks[*block++], x, z + kNumbers * b, n, stride);
        }
      }
    }
  }

 private:
  // Batches begin to end; edges of each point; where the blocks of its pairs are listed, row by row.
  struct Run {
    std::int64_t begin, end, n_edges, first_block;
  };
  static constexpr std::int64_t kNumbers = 3 * D;
  // Z of a run stays in the nearer caches. One batch alone takes as long as it would by edges.
  static constexpr std::int64_t kLeast = 2, kMost = 8, kBytes = 128 << 10;

  const std::int32_t* columns_of(std::int64_t batch) const {
    return l_.edge_column.data() + l_.point_edge[kLanes * batch];
  }

  // Edges of the points of a batch if all are of the same keyframes and end in the same slots, else 0.
  std::int64_t common_edges(std::int64_t batch) const {
    std::int64_t count = 0;
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      const std::int32_t* edge = &l_.slot_edge[kLanes * slot];
      const bool ends = edge[0] >= 0;
      for (int l = 1; l < kLanes; ++l) {
        if ((edge[l] >= 0) != ends) return 0;
        if (ends && l_.edge_column[edge[l]] != l_.edge_column[edge[0]]) return 0;
      }
      count += ends;
    }
    return count;
  }

  template <class BlockOf>
  void find_runs(std::int64_t begin, std::int64_t end, BlockOf block_of) {
    while (begin < end) {
      const std::int64_t m = common_edges(begin);
      const std::int32_t* columns = columns_of(begin);
      const std::int64_t fit = m ? kBytes / (m * kNumbers * static_cast<std::int64_t>(sizeof(V8))) : 0;
      const std::int64_t most = std::min({end, begin + kMost, begin + fit});
      std::int64_t stop = begin + 1;
      while (stop < most && common_edges(stop) == m && std::equal(columns, columns + m, columns_of(stop))) ++stop;
      if (stop - begin >= kLeast) {
        runs_.push_back({begin, stop, m, static_cast<std::int64_t>(block_.size())});
        std::fill(in_run_.begin() + begin, in_run_.begin() + stop, true);
        for (std::int64_t a = 0; a < m; ++a)
          for (std::int64_t b = a; b < m; ++b)
            block_.push_back(static_cast<std::int32_t>(block_of(columns[a], columns[b])));
        room_ = std::max(room_, ((stop - begin) * kNumbers + D) * m);
      }
      begin = stop;
    }
  }

  const Layout& l_;
  std::vector<Run> runs_;
  std::vector<std::int64_t> partial_run_;  // first run of each partial sum
  std::vector<bool> in_run_;               // by batch
  std::vector<std::int32_t> block_;
  Buffer<V8> scratch_;  // of each thread: Z of a run, then its Z y
  std::int64_t room_ = 0;
};

}  // namespace ba::BA_TARGET
