// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Who sees what in a scene's tables: what numpy does in a dozen passes over the same observations, in one.
//
// A scratch array holds -1 for each row of keyframes or landmarks, and does again when a call ends, so that no call
// costs more as the tables grow.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

namespace ba {

// Columns of scene.records.ObservationTable.
struct TableView {
  const std::int32_t *keyframe, *camera, *landmark;
  const float *uv, *sigma, *depth;
  const bool* outlier;
};

// Some of its rows: n of them.
struct RowsView {
  std::int64_t n;
  const std::int64_t* row;
};

// Numbers a list of rows in a scratch array, from 0 on, as long as it lives.
class Numbered {
 public:
  Numbered(const RowsView& listed, std::int64_t* scratch) : listed_(listed), scratch_(scratch) {
    for (std::int64_t i = 0; i < listed_.n; ++i) scratch_[listed_.row[i]] = i;
  }
  Numbered(const Numbered&) = delete;
  Numbered& operator=(const Numbered&) = delete;
  ~Numbered() {
    for (std::int64_t i = 0; i < listed_.n; ++i) scratch_[listed_.row[i]] = -1;
  }

  std::int64_t operator[](std::int64_t row) const { return scratch_[row]; }

 private:
  RowsView listed_;
  std::int64_t* scratch_;
};

// The rows of all views of some landmarks, or of the newest of each, by landmark and in order of arrival.
inline std::vector<std::int64_t> views_of(const std::int64_t* last, const std::int64_t* previous,
                                          const RowsView& landmarks, std::int64_t newest) {
  std::vector<std::int64_t> rows;
  for (std::int64_t i = 0; i < landmarks.n; ++i) {
    const std::size_t begin = rows.size();
    std::int64_t left = newest;
    for (std::int64_t row = last[landmarks.row[i]]; row >= 0 && left != 0; row = previous[row], --left)
      rows.push_back(row);
    std::reverse(rows.begin() + static_cast<std::ptrdiff_t>(begin), rows.end());
  }
  return rows;
}

// Ask for the lines that hold some elements of a column, which is read from there on in no order that a processor
// knows.
template <class T>
void fetch_ahead(const T* column, std::int64_t begin, std::int64_t end) {
  constexpr std::int64_t kEach = 64 / sizeof(T);
  for (std::int64_t i = begin; i < end; i += kEach) __builtin_prefetch(column + i, 0, 2);
}

// The different values of a column in the rows from each begin to its end, as they come.
inline std::vector<std::int64_t> distinct(const std::int32_t* column, const RowsView& begin, const std::int64_t* end,
                                          std::int64_t* scratch) {
  std::vector<std::int64_t> found;
  for (std::int64_t k = 0; k < begin.n; ++k)
    for (std::int64_t row = begin.row[k]; row < end[k]; ++row) {
      std::int64_t& mark = scratch[column[row]];
      if (mark >= 0) continue;
      mark = 0;
      found.push_back(column[row]);
    }
  for (const std::int64_t value : found) scratch[value] = -1;
  return found;
}

// The keyframes of those of some views that are no outliers, as they come, and how many of these each has.
inline std::pair<std::vector<std::int64_t>, std::vector<std::int64_t>> counted(const TableView& table,
                                                                               const RowsView& rows,
                                                                               std::int64_t* scratch) {
  std::vector<std::int64_t> found, count;
  for (std::int64_t i = 0; i < rows.n; ++i) {
    if (table.outlier[rows.row[i]]) continue;
    std::int64_t& number = scratch[table.keyframe[rows.row[i]]];
    if (number < 0) {
      number = static_cast<std::int64_t>(found.size());
      found.push_back(table.keyframe[rows.row[i]]);
      count.push_back(0);
    }
    ++count[number];
  }
  for (const std::int64_t keyframe : found) scratch[keyframe] = -1;
  return {std::move(found), std::move(count)};
}

// A view by its place in a problem.
struct PlacedView {
  std::int64_t point, keyframe, camera, row;

  bool operator<(const PlacedView& other) const {
    if (point != other.point) return point < other.point;
    return keyframe != other.keyframe ? keyframe < other.keyframe : camera < other.camera;
  }
};

// Where views are written: as core.problem.Observations has them, and their rows.
struct ViewsSpan {
  std::int64_t *row, *keyframe, *camera, *point;
  double *uv, *sigma, *depth;

  // Writes the i-th; returns whether its depth was measured.
  bool put(std::int64_t i, const TableView& table, const PlacedView& v) const {
    row[i] = v.row;
    keyframe[i] = v.keyframe;
    camera[i] = v.camera;
    point[i] = v.point;
    uv[2 * i] = table.uv[2 * v.row];
    uv[2 * i + 1] = table.uv[2 * v.row + 1];
    sigma[i] = table.sigma[v.row];
    depth[i] = table.depth[v.row];
    return !std::isnan(depth[i]);
  }
};

// How many of some views are by keyframes in a list.
inline std::int64_t count_placed(const TableView& table, const RowsView& rows, const Numbered& keyframes) {
  return std::count_if(rows.row, rows.row + rows.n,
                       [&](std::int64_t row) { return keyframes[table.keyframe[row]] >= 0; });
}

// Writes these as they come, if that is sorted by point, keyframe, camera, as it mostly is; else returns false.
inline bool put_in_order(const TableView& table, const RowsView& rows, const Numbered& keyframes,
                         const Numbered& landmarks, const ViewsSpan& out, bool& measured) {
  PlacedView last{-1, -1, -1, -1};
  std::int64_t n = 0;
  for (std::int64_t i = 0; i < rows.n; ++i) {
    const std::int64_t row = rows.row[i], keyframe = keyframes[table.keyframe[row]];
    if (keyframe < 0) continue;
    const PlacedView v{landmarks[table.landmark[row]], keyframe, table.camera[row], row};
    if (v < last) return false;
    measured |= out.put(n++, table, v);
    last = v;
  }
  return true;
}

// Those of some views whose keyframe is in a list, sorted by point, keyframe, camera; all landmarks are in theirs.
inline std::vector<PlacedView> placed(const TableView& table, const RowsView& rows, const Numbered& keyframes,
                                      const Numbered& landmarks) {
  std::vector<PlacedView> out;
  out.reserve(rows.n);
  for (std::int64_t i = 0; i < rows.n; ++i) {
    const std::int64_t row = rows.row[i], keyframe = keyframes[table.keyframe[row]];
    if (keyframe >= 0) out.push_back({landmarks[table.landmark[row]], keyframe, table.camera[row], row});
  }
  // Mostly they come by point, and in order.
  const auto by_point = [](const PlacedView& a, const PlacedView& b) { return a.point < b.point; };
  if (!std::is_sorted(out.begin(), out.end(), by_point)) {
    std::sort(out.begin(), out.end());
    return out;
  }
  for (auto begin = out.begin(); begin != out.end();) {
    auto end = begin;
    bool sorted = true;
    for (; end != out.end() && end->point == begin->point; ++end) sorted &= end == begin || !(*end < end[-1]);
    if (!sorted) std::sort(begin, end);
    begin = end;
  }
  return out;
}

}  // namespace ba
