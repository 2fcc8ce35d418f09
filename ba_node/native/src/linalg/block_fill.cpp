// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "linalg/block_fill.hpp"

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <set>
#include <utility>
#include <vector>

namespace ba {

namespace {

using Neighbours = std::vector<std::vector<std::int32_t>>;

// Upper triangle of a pattern, diagonal first in each row -> all neighbours but oneself, ascending.
Neighbours neighbours(const Rows32& upper) {
  Neighbours out(upper.count());
  for (std::int64_t i = 0; i < upper.count(); ++i) {
    for (std::int64_t k = upper.start[i]; k < upper.start[i + 1]; ++k) {
      const std::int32_t j = upper.index[k];
      if (j == i) continue;
      out[i].push_back(j);
      out[j].push_back(static_cast<std::int32_t>(i));
    }
  }
  for (auto& row : out) std::sort(row.begin(), row.end());
  return out;
}

void count_column(std::size_t below, Fill& fill) {
  const double m = static_cast<double>(below);
  fill.blocks += static_cast<std::int64_t>(below) + 1;
  fill.products += m * (m + 1) / 2 + m;
}

// Eliminate what is left, each joined with all others, from a step on.
bool within(const Fill& fill, const FillLimits& limits) {
  return fill.blocks <= limits.blocks && fill.products <= limits.products;
}

void finish_joined(const std::vector<std::int32_t>& given, std::int32_t step,
                   std::vector<std::vector<std::int32_t>>& columns, Fill& fill) {
  std::vector<std::int32_t> left =
      given.empty() ? columns[step - 1] : std::vector<std::int32_t>(given.begin() + step, given.end());
  for (std::size_t i = 0; i < left.size(); ++i) {
    columns[step].assign(left.begin() + static_cast<std::ptrdiff_t>(i) + 1, left.end());
    fill.order.push_back(left[i]);
    fill.place[left[i]] = step++;
    count_column(columns[step - 1].size(), fill);
  }
}

// Eliminate in the given order, or without one in that of least degree; incomplete once a limit is passed.
Fill eliminate(Neighbours near, const std::vector<std::int32_t>& given, const FillLimits& limits) {
  const auto n = static_cast<std::int32_t>(near.size());
  Fill fill;
  std::vector<std::vector<std::int32_t>> columns(n);
  std::set<std::pair<std::size_t, std::int32_t>> waiting;  // by degree
  if (given.empty())
    for (std::int32_t i = 0; i < n; ++i) waiting.emplace(near[i].size(), i);
  fill.place.assign(n, -1);
  std::vector<std::int32_t> joined;
  for (std::int32_t step = 0; step < n; ++step) {
    const std::int32_t next = given.empty() ? waiting.begin()->second : given[step];
    columns[step].swap(near[next]);
    const std::vector<std::int32_t>& column = columns[step];
    fill.order.push_back(next);
    fill.place[next] = step;
    count_column(column.size(), fill);
    if (!within(fill, limits)) return fill;
    if (given.empty()) waiting.erase(waiting.begin());
    // All that is left is joined with everything: nothing changes any more but that one goes after the other.
    if (static_cast<std::int32_t>(column.size()) == n - step - 1) {
      finish_joined(given, step + 1, columns, fill);
      break;
    }
    for (std::int32_t i : column) {
      std::vector<std::int32_t>& own = near[i];
      if (given.empty()) waiting.erase({own.size(), i});
      joined.clear();
      std::set_union(own.begin(), own.end(), column.begin(), column.end(), std::back_inserter(joined));
      own.clear();
      for (std::int32_t j : joined)
        if (j != i && j != next) own.push_back(j);
      if (given.empty()) waiting.emplace(own.size(), i);
    }
  }
  if (!within(fill, limits)) return fill;
  for (std::vector<std::int32_t>& column : columns) {
    for (std::int32_t& i : column) i = fill.place[i];
    std::sort(column.begin(), column.end());
    fill.below.index.insert(fill.below.index.end(), column.begin(), column.end());
    fill.below.close_row();
    std::vector<std::int32_t>().swap(column);
  }
  fill.complete = true;
  return fill;
}

}  // namespace

Fill find_fill(const Rows32& upper, const FillLimits& limits) {
  const Neighbours near = neighbours(upper);
  std::vector<std::int32_t> in_turn(near.size());
  for (std::size_t i = 0; i < in_turn.size(); ++i) in_turn[i] = static_cast<std::int32_t>(i);
  Fill turn = eliminate(near, in_turn, limits);
  if (turn.complete && turn.blocks == static_cast<std::int64_t>(upper.index.size())) return turn;
  Fill least = eliminate(near, {}, limits);
  const bool better = turn.complete && (!least.complete || turn.products <= least.products);
  return better ? turn : least;
}

}  // namespace ba
