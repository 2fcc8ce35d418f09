// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Positive definite matrices of D x D blocks, and the plain solution that solvers are compared with.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "linalg/blocks.hpp"
#include "linalg/types.hpp"

namespace matrices {

// Numbers between -1 and 1, the same everywhere.
class Numbers {
 public:
  explicit Numbers(std::uint64_t seed) : state_(seed * 2 + 1) {}
  double next() {
    state_ = state_ * 6364136223846793005u + 1442695040888963407u;
    return static_cast<double>(static_cast<std::int64_t>(state_ >> 11)) / static_cast<double>(std::int64_t{1} << 52) -
           1;
  }

 private:
  std::uint64_t state_;
};

// Row by row; blocks (i, j) with |i - j| > band are zero, except those of the last block where it has an arrow.
inline std::vector<double> dense(std::int64_t blocks, int d, std::int64_t band, bool arrow, std::uint64_t seed) {
  const std::int64_t n = blocks * d;
  Numbers numbers(seed);
  std::vector<double> s(n * n, 0.0);
  for (std::int64_t i = 0; i < n; ++i)
    for (std::int64_t j = 0; j <= i; ++j) {
      const bool stored = i / d - j / d <= band || (arrow && i / d == blocks - 1);
      s[i * n + j] = s[j * n + i] = stored ? numbers.next() : 0.0;
    }
  // Diagonally dominant.
  for (std::int64_t i = 0; i < n; ++i) {
    double total = 1;
    for (std::int64_t j = 0; j < n; ++j) total += std::abs(s[i * n + j]);
    s[i * n + i] = total;
  }
  return s;
}

inline std::vector<double> vector(std::int64_t n, std::uint64_t seed) {
  Numbers numbers(seed);
  std::vector<double> out(n);
  for (double& x : out) x = numbers.next();
  return out;
}

inline std::vector<double> times(const std::vector<double>& s, const std::vector<double>& x) {
  const std::size_t n = x.size();
  std::vector<double> out(n, 0.0);
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t j = 0; j < n; ++j) out[i] += s[i * n + j] * x[j];
  return out;
}

// Largest difference.
inline double distance(const std::vector<double>& a, const std::vector<double>& b) {
  double most = 0;
  for (std::size_t i = 0; i < a.size(); ++i) most = std::max(most, std::abs(a[i] - b[i]));
  return most;
}

// The upper triangle by blocks: its pattern, diagonal first in each row, and its blocks.
template <int D>
struct Blocks {
  Blocks(const std::vector<double>& s, std::int64_t n) {
    using ba::BA_TARGET::set_entry;
    for (std::int64_t i = 0; i < n; ++i) {
      for (std::int64_t j = i; j < n; ++j) {
        ba::BA_TARGET::Block<D> block{};
        bool any = i == j;
        for (int r = 0; r < D; ++r)
          for (int c = 0; c < D; ++c) {
            const double value = s[(i * D + r) * n * D + j * D + c];
            set_entry(block, r, c, value);
            any = any || value != 0.0;
          }
        if (!any) continue;
        pattern.index.push_back(static_cast<std::int32_t>(j));
        blocks.push_back(block);
      }
      pattern.close_row();
    }
  }

  ba::Rows32 pattern;
  ba::Buffer<ba::BA_TARGET::Block<D>> blocks;
};

}  // namespace matrices
