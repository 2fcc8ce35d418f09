// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Dense Cholesky, S = L L', and the solution of S x = b.
//
// The lower triangle is kept by panels of eight rows, each by columns: one register holds the eight rows of a column.
// So a product of panels takes both its factors as they lie. Columns are eliminated in blocks, and what is right of a
// block is brought up to date with it at once: the panels of a block stay in the nearest caches meanwhile.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "linalg/blocks.hpp"
#include "parallel/memory.hpp"
#include "parallel/pool.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

class DenseCholesky {
 public:
  // Room for n unknowns, all entries zero.
  void resize(std::int64_t n) {
    n_ = n;
    panels_ = (n + kLanes - 1) / kLanes;
    tiles_.resize(kLanes * panels_ * (panels_ + 1) / 2);
    if (n > 0) std::memset(static_cast<void*>(tiles_.data()), 0, tiles_.size() * sizeof(V8));
    inverse_.resize(kLanes * panels_);
    y_.resize(kLanes * panels_);
    w_.resize(kLanes * panels_);
  }

  // Entry of the lower triangle, row >= column.
  double& at(std::int64_t row, std::int64_t column) {
    return reinterpret_cast<double*>(panel(row / kLanes) + column)[row % kLanes];
  }

  // The transpose of a block, its first entry at a row and a column of the lower triangle, or on the diagonal.
  template <int D>
  void put(std::int64_t row, std::int64_t column, const Block<D>& block) {
    for (int c = 0; c < D; ++c) {
      double* to = &at(row + c, column);
      for (int r = 0; r < (row == column ? c + 1 : D); ++r) to[kLanes * r] = entry(block, r, c);
    }
  }

  // False if S is not positive definite.
  bool factor(Pool& pool) {
    for (std::int64_t i = n_; i < kLanes * panels_; ++i) {
      for (std::int64_t j = 0; j < i; ++j) at(i, j) = 0.0;
      at(i, i) = 1.0;
    }
    for (std::int64_t first = 0; first < panels_; first += kBlock) {
      const std::int64_t end = std::min(panels_, first + kBlock);
      for (std::int64_t j = first; j < end; ++j) {
        finish<1>(j, first, j);
        update<1>(j, j, first, j);
        if (!factor_tile(j)) return false;
      }
      const auto each_rows_below = [&](auto take) { each_rows(pool, end, take); };
      each_rows_below([&](std::int64_t i, auto count) { finish<decltype(count)::value>(i, first, end); });
      each_rows_below([&](std::int64_t i, auto count) {
        constexpr int kCount = decltype(count)::value;
        for (std::int64_t j = end; j <= i; ++j) update<kCount>(i, j, first, end);
        for (std::int64_t j = i + 1; j < i + kCount; ++j)
          for (std::int64_t k = j; k < i + kCount; ++k) update<1>(k, j, first, end);
      });
    }
    return true;
  }

  // x: b in, solution out.
  void solve(double* x) {
    std::fill(y_.begin(), y_.end(), 0.0);
    std::copy_n(x, n_, y_.data());
    for (std::int64_t r = 0; r < panels_; ++r) {
      const V8* p = panel(r);
      V8 sum[4] = {load(&y_[kLanes * r])};
      for (std::int64_t k = 0; k < kLanes * r; k += 4)
        for (int i = 0; i < 4; ++i) sum[i] -= p[k + i] * y_[k + i];
      V8 b = (sum[0] + sum[1]) + (sum[2] + sum[3]);
      for (int c = 0; c < kLanes; ++c) {
        const double v = b[c] * inverse_[kLanes * r + c];
        y_[kLanes * r + c] = v;
        b -= p[kLanes * r + c] * v;
      }
    }
    std::fill(w_.begin(), w_.end(), V8{});
    for (std::int64_t r = panels_ - 1; r >= 0; --r) {
      const V8* p = panel(r);
      V8 z{};
      for (int c = kLanes - 1; c >= 0; --c) {
        double v = y_[kLanes * r + c] - sum(w_[kLanes * r + c]);
        for (int i = c + 1; i < kLanes; ++i) v -= p[kLanes * r + c][i] * z[i];
        z[c] = v * inverse_[kLanes * r + c];
      }
      for (std::int64_t k = 0; k < kLanes * r; ++k) w_[k] += p[k] * z;
      std::memcpy(&y_[kLanes * r], &z, sizeof(z));
    }
    std::copy_n(y_.data(), n_, x);
  }

 private:
  // Rows of a register. Panels whose columns are eliminated together, panels of rows that are worked on together, and
  // columns of them that are in registers at once: as many as fit.
  static constexpr int kRows = sizeof(Register) / sizeof(double), kColumns = kRows;
  static constexpr std::int64_t kBlock = kHeld && kRows < kLanes ? 8 : 4, kPanelsAtOnce = kHeld ? 3 : 1;

  V8* panel(std::int64_t r) { return tiles_.data() + kLanes * r * (r + 1) / 2; }

  // Call take(i, count) for up to kPanelsAtOnce panels from `first` on. They are dealt to the threads one by one from
  // the last, the longest, so that each has its own in every block, and as much to do as the others.
  template <class Take>
  void each_rows(Pool& pool, std::int64_t first, Take take) {
    const std::int64_t tasks = (panels_ - first + kPanelsAtOnce - 1) / kPanelsAtOnce;
    pool.each(tasks, [&](std::int64_t task, int) {
      int of = 0;
      while (pool.begin_of_queue(tasks, of + 1) <= task) ++of;
      const std::int64_t dealt = (task - pool.begin_of_queue(tasks, of)) * pool.threads() + of;
      const std::int64_t end = panels_ - kPanelsAtOnce * dealt, i = std::max(first, end - kPanelsAtOnce);
      with_count(end - i, [&](auto count) { take(i, count); });
    });
  }

  template <class F>
  static void with_count(std::int64_t count, F f) {
    if (count == 1) f(std::integral_constant<int, 1>());
    if constexpr (kPanelsAtOnce > 1) {
      if (count == 2) f(std::integral_constant<int, 2>());
      if (count == 3) f(std::integral_constant<int, 3>());
    }
  }

  // Tiles (i .. i + P - 1, j) less the product of their rows and those of j over the columns of panels [first, end).
  template <int P>
  void update(std::int64_t i, std::int64_t j, std::int64_t first, std::int64_t end) {
    // Registers of rows, and how many of them are worked on together.
    constexpr int kParts = kLanes / kRows, kAll = P * kParts, kTogether = kAll % 3 == 0 ? 3 : kAll % 2 == 0 ? 2 : 1;
    for (int part = 0; part < kAll; part += kTogether) {
      double* a[kTogether];
      for (int p = 0; p < kTogether; ++p)
        a[p] = reinterpret_cast<double*>(panel(i + (part + p) / kParts)) + kRows * ((part + p) % kParts);
      for (int column = 0; column < kLanes; column += kColumns) {
        const std::int64_t at = kLanes * (kLanes * j + column);
        Register acc[kTogether][kColumns];
#pragma GCC unroll 3
        for (int p = 0; p < kTogether; ++p)
#pragma GCC unroll 8
          for (int c = 0; c < kColumns; ++c) acc[p][c] = Loaded<Register>::from(a[p] + at + kLanes * c);
        for (std::int64_t k = kLanes * first; k < kLanes * end; ++k) {
          const double* row = reinterpret_cast<const double*>(panel(j) + k) + column;
          Register rows[kTogether];
#pragma GCC unroll 3
          for (int p = 0; p < kTogether; ++p) rows[p] = held(Loaded<Register>::from(a[p] + kLanes * k));
#pragma GCC unroll 8
          for (int c = 0; c < kColumns; ++c) {
            const Register factor = Splat<Register>::of(row[c]);
#pragma GCC unroll 3
            for (int p = 0; p < kTogether; ++p) acc[p][c] -= rows[p] * factor;
          }
        }
#pragma GCC unroll 3
        for (int p = 0; p < kTogether; ++p)
#pragma GCC unroll 8
          for (int c = 0; c < kColumns; ++c) std::memcpy(a[p] + at + kLanes * c, &acc[p][c], sizeof(Register));
      }
    }
  }

  // Rows of the factor in the panels [first, end), of a block whose tiles there are factored: times L_jj^-T each.
  template <int P>
  void finish(std::int64_t i, std::int64_t first, std::int64_t end) {
    for (std::int64_t j = first; j < end; ++j) {
      update<P>(i, j, first, j);
      const V8* t = panel(j) + kLanes * j;
      for (int p = 0; p < P; ++p) {
        V8* x = panel(i + p) + kLanes * j;
        for (int c = 0; c < kLanes; ++c) {
          x[c] *= inverse_[kLanes * j + c];
          for (int d = c + 1; d < kLanes; ++d) x[d] -= x[c] * t[c][d];
        }
      }
    }
  }

  bool factor_tile(std::int64_t j) {
    V8* t = panel(j) + kLanes * j;
    for (int c = 0; c < kLanes; ++c) {
      const double pivot = t[c][c];
      if (!(pivot > 0.0) || std::isinf(pivot)) return false;
      const double inverse = 1.0 / std::sqrt(pivot);
      inverse_[kLanes * j + c] = inverse;
      t[c] *= inverse;
      for (int d = c + 1; d < kLanes; ++d) t[d] -= t[c] * t[c][d];
    }
    return true;
  }

  std::int64_t n_ = 0, panels_ = 0;
  Buffer<V8> tiles_, w_;
  Buffer<double> inverse_, y_;
};

}  // namespace ba::BA_TARGET
