// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The numpy arrays of Python's dataclasses, held while a view of them is in use. core/ has checked their shapes.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <array>
#include <cstddef>
#include <string>
#include <vector>

#include "targets/target.hpp"

namespace ba {

namespace py = pybind11;

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Doubles = Array<double>;
using Ints = Array<std::int64_t>;
// Never converted: what is written would be lost, and to copy a map's column takes longer than the call.
template <class T>
using Column = py::array_t<T, py::array::c_style>;
using OutDoubles = Column<double>;

inline Ints ints(const std::vector<std::int64_t>& values) {
  return Ints(static_cast<py::ssize_t>(values.size()), values.data());
}

inline Doubles empty(std::vector<py::ssize_t> shape) { return Doubles(std::move(shape)); }

template <class T>
Array<T> array_of(const py::handle& object, const char* attribute) {
  return object.attr(attribute).cast<Array<T>>();
}

// The enumerator of a name.
template <class Enum, std::size_t N>
Enum named(const std::array<const char*, N>& names, const std::string& name, const char* what) {
  for (std::size_t i = 0; i < N; ++i)
    if (name == names[i]) return static_cast<Enum>(i);
  std::string known;
  for (const char* each : names) known += std::string(known.empty() ? "" : ", ") + each;
  throw py::value_error(std::string(what) + " '" + name + "': the C++ kernels have " + known);
}

inline Loss loss_named(const std::string& name) {
  return named<Loss>(std::array{"squared", "huber", "cauchy"}, name, "loss");
}
inline Cheirality cheirality_named(const std::string& name) {
  return named<Cheirality>(std::array{"keep", "constant", "drop"}, name, "cheirality");
}
inline Preconditioner preconditioner_named(const std::string& name) {
  return named<Preconditioner>(std::array{"none", "schur_block", "schur_diag", "b_block", "b_diag"}, name,
                               "preconditioner");
}

// core.problem.State.
struct StateArrays {
  explicit StateArrays(const py::handle& state)
      : rotation(array_of<double>(state, "rotation")),
        translation(array_of<double>(state, "translation")),
        points(array_of<double>(state, "points")),
        intrinsics(array_of<double>(state, "intrinsics")) {}

  StateView view() const {
    return {rotation.data(), translation.data(), points.data(), intrinsics.size() ? intrinsics.data() : nullptr};
  }

  Doubles rotation, translation, points, intrinsics;
};

// The same, to be written to.
struct StateRoom {
  explicit StateRoom(const py::handle& state)
      : rotation(state.attr("rotation").cast<OutDoubles>()),
        translation(state.attr("translation").cast<OutDoubles>()),
        points(state.attr("points").cast<OutDoubles>()),
        intrinsics(state.attr("intrinsics").cast<OutDoubles>()) {}

  StateSpan span() {
    return {rotation.mutable_data(), translation.mutable_data(), points.mutable_data(), intrinsics.mutable_data()};
  }

  OutDoubles rotation, translation, points, intrinsics;
};

// core.problem.Problem, without its factors.
struct ProblemArrays {
  explicit ProblemArrays(const py::handle& problem)
      : fixed(array_of<bool>(problem, "fixed")), start(problem.attr("start")) {
    const py::object seen = problem.attr("observations"), cameras = problem.attr("cameras");
    keyframe = array_of<std::int64_t>(seen, "keyframe");
    camera = array_of<std::int64_t>(seen, "camera");
    point = array_of<std::int64_t>(seen, "point");
    uv = array_of<double>(seen, "uv");
    sigma = array_of<double>(seen, "sigma_px");
    depth = array_of<double>(seen, "depth_m");
    depth_sigma = array_of<double>(seen, "depth_sigma_m");
    camera_rotation = array_of<double>(cameras, "rotation");
    camera_translation = array_of<double>(cameras, "translation");
    params = array_of<double>(cameras, "params");
    model = array_of<std::uint8_t>(cameras, "model");
  }

  ProblemView view() const {
    ProblemView v;
    v.n_keyframes = start.translation.shape(0);
    v.n_points = start.points.shape(0);
    v.n_obs = keyframe.size();
    v.n_cameras = model.size();
    v.keyframe = keyframe.data();
    v.camera = camera.data();
    v.point = point.data();
    v.uv = uv.data();
    v.sigma = sigma.data();
    v.depth = depth.size() ? depth.data() : nullptr;
    v.depth_sigma = depth_sigma.data();
    v.camera_rotation = camera_rotation.data();
    v.camera_translation = camera_translation.data();
    v.params = params.data();
    v.model = model.data();
    v.fixed = fixed.data();
    return v;
  }

  Ints keyframe, camera, point;
  Doubles uv, sigma, depth, depth_sigma, camera_rotation, camera_translation, params;
  Array<std::uint8_t> model;
  Array<bool> fixed;
  StateArrays start;
};

// core.triangulation.Rays.
struct RaysArrays {
  explicit RaysArrays(const py::handle& rays)
      : point(array_of<std::int64_t>(rays, "point")),
        centre(array_of<double>(rays, "centre")),
        direction(array_of<double>(rays, "direction")),
        px_per_rad(array_of<double>(rays, "px_per_rad")),
        distance(array_of<double>(rays, "distance_m")),
        distance_sigma(array_of<double>(rays, "distance_sigma_m")) {}

  RaysView view() const {
    return {point.size(),      point.data(),    centre.data(),        direction.data(),
            px_per_rad.data(), distance.data(), distance_sigma.data()};
  }

  Ints point;
  Doubles centre, direction, px_per_rad, distance, distance_sigma;
};

}  // namespace ba
