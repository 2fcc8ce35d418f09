// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "adjustment/views.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>
#include <vector>

#include "adjustment/quaternions.hpp"
#include "adjustment/trial.hpp"
#include "bindings/arrays.hpp"
#include "bindings/window.hpp"
namespace ba {

namespace {

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

Ints views_of_landmarks(const Column<std::int64_t>& last, const Column<std::int64_t>& previous, const Ints& landmarks,
                        std::int64_t newest) {
  const std::int64_t *from = last.data(), *before = previous.data();
  const RowsView which = rows_view(landmarks);
  return ints(unless_short(which.n, [&] { return views_of(from, before, which, newest); }));
}

Ints distinct_landmarks(const py::object& table, const Ints& begin, const Ints& end, Column<std::int64_t> scratch) {
  const TableView view = TableArrays(table).view();
  const auto previous = column_of<std::int64_t>(table, "previous");
  const RowsView from = rows_view(begin);
  // After a rest these lines have left the caches, and whoever asks who sees what gathers its views next, by landmark.
  for (std::int64_t k = 0; k < from.n; ++k) {
    const std::int64_t first = from.row[k], last = end.data()[k];
    fetch_ahead(previous.data(), first, last);
    fetch_ahead(view.keyframe, first, last);
    fetch_ahead(view.camera, first, last);
    fetch_ahead(view.outlier, first, last);
    fetch_ahead(view.uv, 2 * first, 2 * last);
    fetch_ahead(view.sigma, first, last);
    fetch_ahead(view.depth, first, last);
  }
  return ints(distinct(view.landmark, from, end.data(), scratch.mutable_data()));
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
  const RowsView asked = rows_view(rows);
  const auto n = static_cast<py::ssize_t>(count_placed(from, asked, keyframes));
  Ints row({n}), keyframe({n}), camera({n}), point({n});
  Doubles uv({n, py::ssize_t{2}}), sigma({n}), depth({n});
  const ViewsSpan out{row.mutable_data(), keyframe.mutable_data(), camera.mutable_data(), point.mutable_data(),
                      uv.mutable_data(),  sigma.mutable_data(),    depth.mutable_data()};
  bool measured = false;
  unless_short(asked.n, [&] {
    if (put_in_order(from, asked, keyframes, landmarks, out, measured)) return;
    const std::vector<PlacedView> views = placed(from, asked, keyframes, landmarks);
    measured = false;
    for (py::ssize_t i = 0; i < n; ++i) measured |= out.put(i, from, views[i]);
  });
  return py::make_tuple(row, keyframe, camera, point, uv, sigma, measured ? depth : Doubles({py::ssize_t{0}}));
}

// What core.problem.Observations holds, of some rows; with other numbers of points and keyframes where these are given.
py::tuple take(const py::object& observations, const Ints& rows, const Ints& of_point, const Ints& of_keyframe) {
  const Ints keyframe = array_of<std::int64_t>(observations, "keyframe"),
             camera = array_of<std::int64_t>(observations, "camera"),
             point = array_of<std::int64_t>(observations, "point");
  const Doubles uv = array_of<double>(observations, "uv"), sigma = array_of<double>(observations, "sigma_px"),
                depth = array_of<double>(observations, "depth_m"),
                depth_sigma = array_of<double>(observations, "depth_sigma_m");
  const py::ssize_t n = rows.size(), n_depths = depth.size() ? n : 0;
  Ints to_keyframe({n}), to_camera({n}), to_point({n});
  Doubles to_uv({n, py::ssize_t{2}}), to_sigma({n}), to_depth({n_depths}), to_depth_sigma({n_depths});
  const auto taken = [&rows, n](const auto& from, auto& to) {
    const auto* source = from.data();
    auto* out = to.mutable_data();
    for (py::ssize_t i = 0; i < n; ++i) out[i] = source[rows.data()[i]];
  };
  const auto renumbered = [n](const Ints& number, Ints& to) {
    std::int64_t* out = to.mutable_data();
    if (number.size())
      for (py::ssize_t i = 0; i < n; ++i) out[i] = number.data()[out[i]];
  };
  taken(keyframe, to_keyframe);
  taken(camera, to_camera);
  taken(point, to_point);
  taken(sigma, to_sigma);
  renumbered(of_point, to_point);
  renumbered(of_keyframe, to_keyframe);
  double* pixels = to_uv.mutable_data();
  for (py::ssize_t i = 0; i < n; ++i) std::copy_n(uv.data() + 2 * rows.data()[i], 2, pixels + 2 * i);
  if (n_depths) {
    taken(depth, to_depth);
    taken(depth_sigma, to_depth_sigma);
  }
  return py::make_tuple(to_keyframe, to_camera, to_point, to_uv, to_sigma, to_depth, to_depth_sigma);
}

// point: of each observation that may be tried. least_views, hash: as TriedLimits.
Ints tracks_to_try(const Column<std::uint64_t>& track_id, const Ints& point, std::int64_t wanted,
                   std::int64_t least_views, std::uint64_t hash) {
  return ints(to_try(track_id.data(), track_id.size(), rows_view(point), {wanted, least_views, hash}));
}

// Of rotations (n, 3, 3), and back.
Doubles quaternions(const Doubles& rotation) {
  const py::ssize_t n = rotation.size() / 9;
  Doubles out({n, py::ssize_t{4}});
  for (py::ssize_t i = 0; i < n; ++i) quaternion_of(rotation.data() + 9 * i, out.mutable_data() + 4 * i);
  return out;
}

Doubles rotations(const Doubles& quaternion) {
  const py::ssize_t n = quaternion.size() / 4;
  Doubles out({n, py::ssize_t{3}, py::ssize_t{3}});
  for (py::ssize_t i = 0; i < n; ++i) rotation_of(quaternion.data() + 4 * i, out.mutable_data() + 9 * i);
  return out;
}

// bounds: of pixels, sigma from and to, depth from and to.
bool are_sane_tracks(const Column<std::uint64_t>& ids, const Doubles& uv, const Doubles& sigma, const Doubles& depth,
                     const std::array<double, 5>& bounds) {
  const auto [pixel, least_sigma, most_sigma, least_depth, most_depth] = bounds;
  bool good = ids.size() > 0;
  for (py::ssize_t i = 1; i < ids.size(); ++i) good &= ids.data()[i] > ids.data()[i - 1];
  for (py::ssize_t i = 0; i < uv.size(); ++i) good &= std::abs(uv.data()[i]) <= pixel;
  for (py::ssize_t i = 0; i < sigma.size(); ++i)
    good &= least_sigma <= sigma.data()[i] && sigma.data()[i] <= most_sigma;
  for (py::ssize_t i = 0; i < depth.size(); ++i) {
    const double d = depth.data()[i];
    good &= std::isnan(d) || (least_depth <= d && d <= most_depth);
  }
  return good;
}

}  // namespace

void bind_views(py::module_& m) {
  m.def("views_of", &views_of_landmarks);
  m.def("distinct_landmarks", &distinct_landmarks);
  m.def("inliers_by_keyframe", &inliers_by_keyframe);
  m.def("are_sane_tracks", &are_sane_tracks);
  m.def("tracks_to_try", &tracks_to_try);
  m.def("quaternions", &quaternions);
  m.def("rotations", &rotations);
  m.def("gather", &gather);
  m.def("take", &take);
}

}  // namespace ba
