// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Dense Cholesky, S = L L', and the solution of S x = b.
//
// The lower triangle is kept by panels of eight rows, each by columns: one register holds the eight rows of a column.
// So a product of panels takes both its factors as they lie. Columns are eliminated in blocks; the rows below a block
// are brought up to date by all columns before it at once, eight columns of up to 24 rows in registers.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "memory.hpp"
#include "pool.hpp"
#include "simd.hpp"

namespace ba {

class DenseCholesky {
 public:
  // Room for n unknowns, all entries zero.
  void resize(std::int64_t n) {
    n_ = n;
    panels_ = (n + kLanes - 1) / kLanes;
    tiles_.assign(kLanes * panels_ * (panels_ + 1) / 2, V8{});
    inverse_.resize(kLanes * panels_);
    y_.resize(kLanes * panels_);
    w_.resize(kLanes * panels_);
  }

  // Entry of the lower triangle, row >= column.
  double& at(std::int64_t row, std::int64_t column) {
    return reinterpret_cast<double*>(panel(row / kLanes) + column)[row % kLanes];
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
        for (std::int64_t i = first; i < j; ++i) finish<1>(j, i);
        update<1>(j, j);
        if (!factor_tile(j)) return false;
      }
      const std::int64_t groups = (panels_ - end + kGroup - 1) / kGroup;
      pool.each(groups, [&](std::int64_t g, int) {
        const std::int64_t i = end + kGroup * g, count = std::min<std::int64_t>(kGroup, panels_ - i);
        for (std::int64_t j = first; j < end; ++j) {
          if (count == 3) finish<3>(i, j);
          if (count == 2) finish<2>(i, j);
          if (count == 1) finish<1>(i, j);
        }
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
  // Panels whose columns are eliminated before the rows below follow; panels of rows that are worked on together.
  static constexpr std::int64_t kBlock = 8, kGroup = 3;

  V8* panel(std::int64_t r) { return tiles_.data() + kLanes * r * (r + 1) / 2; }

  // Tiles (i .. i + P - 1, j) less the product of their rows and those of j over the columns before j.
  template <int P>
  void update(std::int64_t i, std::int64_t j) {
    const V8 *a[P], *b = panel(j);
    for (int p = 0; p < P; ++p) a[p] = panel(i + p);
    V8 acc[P][kLanes] = {};
    for (std::int64_t k = 0; k < kLanes * j; ++k) {
#pragma GCC unroll 8
      for (int c = 0; c < kLanes; ++c) {
        const double factor = b[k][c];
#pragma GCC unroll 3
        for (int p = 0; p < P; ++p) acc[p][c] += a[p][k] * factor;
      }
    }
    for (int p = 0; p < P; ++p)
      for (int c = 0; c < kLanes; ++c) panel(i + p)[kLanes * j + c] -= acc[p][c];
  }

  // The same, then times L_jj^-T: rows of the factor.
  template <int P>
  void finish(std::int64_t i, std::int64_t j) {
    update<P>(i, j);
    const V8* t = panel(j) + kLanes * j;
    for (int p = 0; p < P; ++p) {
      V8* x = panel(i + p) + kLanes * j;
      for (int c = 0; c < kLanes; ++c) {
        x[c] *= inverse_[kLanes * j + c];
        for (int d = c + 1; d < kLanes; ++d) x[d] -= x[c] * t[c][d];
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

}  // namespace ba
