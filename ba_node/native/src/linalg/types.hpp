// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What callers of the linear solvers hand over and get back: plain data, the same for every target.
#pragma once

#include <cstdint>
#include <vector>

namespace ba {

// Rows of indices, one after the other: those of row i are index[start[i]] to index[start[i + 1]].
struct Rows32 {
  std::vector<std::int64_t> start{0};
  std::vector<std::int32_t> index;

  std::int64_t count() const { return static_cast<std::int64_t>(start.size()) - 1; }
  void close_row() { start.push_back(static_cast<std::int64_t>(index.size())); }
};

// The factor's columns, in order of elimination.
struct Fill {
  // order[j] is eliminated as the j-th; place is the inverse.
  std::vector<std::int32_t> order, place;
  // Below the diagonal of column j, as places, ascending.
  Rows32 below;
  // Blocks of the factor with the diagonal; multiplications of blocks to find it.
  std::int64_t blocks = 0;
  double products = 0;
  bool complete = false;
};

// Where counting is given up.
struct FillLimits {
  std::int64_t blocks;
  double products;
};

// M: none, or the diagonal blocks or the diagonal of S or of damped B.
enum class Preconditioner : std::uint8_t { kNone, kSchurBlock, kSchurDiagonal, kOwnBlock, kOwnDiagonal };

struct PcgLimits {
  double t_eps = 0;
  std::int64_t max_iterations = 0;
  double radius = 0, q_eps = 0;
};

struct PcgEnd {
  bool found = false, on_boundary = false;
  std::int64_t iterations = 0;
};

}  // namespace ba
