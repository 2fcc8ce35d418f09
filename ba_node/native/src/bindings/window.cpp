// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "bindings/window.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "adjustment/views.hpp"
#include "bindings/arrays.hpp"

namespace ba {

namespace {

// Never converted: what is written would be lost, and to copy a map's column takes longer than the call.
template <class T>
using Column = py::array_t<T, py::array::c_style>;

template <class T>
Column<T> column_of(const py::handle& table, const char* name) {
  return table.attr(name).cast<Column<T>>();
}

// scene.records.ObservationTable.
struct TableArrays {
  explicit TableArrays(const py::handle& table)
      : keyframe(column_of<std::int32_t>(table, "keyframe")),
        camera(column_of<std::int32_t>(table, "camera")),
        landmark(column_of<std::int32_t>(table, "landmark")),
        uv(column_of<float>(table, "uv")),
        sigma(column_of<float>(table, "sigma_px")),
        depth(column_of<float>(table, "depth_m")),
        outlier(column_of<bool>(table, "outlier")) {}

  TableView view() const {
    return {keyframe.data(), camera.data(), landmark.data(), uv.data(), sigma.data(), depth.data(), outlier.data()};
  }

  Column<std::int32_t> keyframe, camera, landmark;
  Column<float> uv, sigma, depth;
  Column<bool> outlier;
};

RowsView rows_view(const Ints& rows) { return {rows.size(), rows.data()}; }

Ints ints(const std::vector<std::int64_t>& values) {
  return Ints(static_cast<py::ssize_t>(values.size()), values.data());
}

Ints views_of_landmarks(const Column<std::int64_t>& last, const Column<std::int64_t>& previous, const Ints& landmarks,
                        std::int64_t newest) {
  return ints(views_of(last.data(), previous.data(), rows_view(landmarks), newest));
}

Ints distinct_landmarks(const py::object& table, const Ints& begin, const Ints& end, Column<std::int64_t> scratch) {
  const auto landmark = column_of<std::int32_t>(table, "landmark");
  return ints(distinct(landmark.data(), rows_view(begin), end.data(), scratch.mutable_data()));
}

py::tuple inliers_by_keyframe(const py::object& table, const Ints& rows, Column<std::int64_t> scratch) {
  const auto [keyframe, count] = counted(TableArrays(table).view(), rows_view(rows), scratch.mutable_data());
  return py::make_tuple(ints(keyframe), ints(count));
}

// scratch: of keyframes and of landmarks.
py::tuple gather(const py::object& table, const Ints& rows, const std::pair<Ints, Ints>& listed,
                 const std::pair<Column<std::int64_t>, Column<std::int64_t>>& scratch) {
  const TableArrays arrays(table);
  const TableView from = arrays.view();
  Column<std::int64_t> of_keyframe = scratch.first, of_landmark = scratch.second;
  const Numbered keyframes(rows_view(listed.first), of_keyframe.mutable_data());
  const Numbered landmarks(rows_view(listed.second), of_landmark.mutable_data());
  const std::vector<PlacedView> views = placed(from, rows_view(rows), keyframes, landmarks);
  const auto n = static_cast<py::ssize_t>(views.size());
  Ints row({n}), keyframe({n}), camera({n}), point({n});
  Doubles uv({n, py::ssize_t{2}}), sigma({n}), depth({n});
  std::int64_t *to_row = row.mutable_data(), *to_keyframe = keyframe.mutable_data(), *to_camera = camera.mutable_data(),
               *to_point = point.mutable_data();
  double *to_uv = uv.mutable_data(), *to_sigma = sigma.mutable_data(), *to_depth = depth.mutable_data();
  bool measured = false;
  for (py::ssize_t i = 0; i < n; ++i) {
    const PlacedView& v = views[i];
    to_row[i] = v.row;
    to_keyframe[i] = v.keyframe;
    to_camera[i] = v.camera;
    to_point[i] = v.point;
    to_uv[2 * i] = from.uv[2 * v.row];
    to_uv[2 * i + 1] = from.uv[2 * v.row + 1];
    to_sigma[i] = from.sigma[v.row];
    to_depth[i] = from.depth[v.row];
    measured |= !std::isnan(to_depth[i]);
  }
  return py::make_tuple(row, keyframe, camera, point, uv, sigma, measured ? depth : Doubles({py::ssize_t{0}}));
}

}  // namespace

void bind_window(py::module_& m) {
  m.def("views_of", &views_of_landmarks);
  m.def("distinct_landmarks", &distinct_landmarks);
  m.def("inliers_by_keyframe", &inliers_by_keyframe);
  m.def("gather", &gather);
}

}  // namespace ba
