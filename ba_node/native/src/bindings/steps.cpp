// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "adjustment/steps.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <functional>
#include <tuple>
#include <utility>
#include <vector>

#include "adjustment/sound.hpp"
#include "bindings/arrays.hpp"
#include "bindings/window.hpp"

namespace ba {

namespace {

// Turns and moves.
using Steps = std::pair<Doubles, Doubles>;

StepsView view_of(const Steps& steps) { return {steps.second.shape(0), steps.first.data(), steps.second.data()}; }

template <class F>
Steps between(const Doubles& rotation, const Doubles& translation, const Ints& first, const Ints& second, F work) {
  const py::ssize_t n = first.size();
  Doubles turn({n, py::ssize_t{3}, py::ssize_t{3}}), move({n, py::ssize_t{3}});
  work({rotation.data(), translation.data(), n, first.data(), second.data()},
       {turn.mutable_data(), move.mutable_data()});
  return {turn, move};
}

Steps steps_between(const Doubles& rotation, const Doubles& translation, const Ints& first, const Ints& second) {
  return between(rotation, translation, first, second, steps_of);
}

Steps inverse_steps_between(const Doubles& rotation, const Doubles& translation, const Ints& first,
                            const Ints& second) {
  return between(rotation, translation, first, second, steps_of_inverse);
}

// worth: as StepSigmas.
py::tuple compared(const Steps& steps, const Steps& measured, const std::array<double, 5>& worth) {
  const py::ssize_t n = steps.second.shape(0);
  Doubles sigmas({n}), move({n}), turn({n}), turned({n}), sigma_m({n}), sigma_rad({n});
  compare_steps(view_of(steps), view_of(measured), {worth[0], worth[1], worth[2], worth[3], worth[4]},
                {sigmas.mutable_data(), move.mutable_data(), turn.mutable_data(), turned.mutable_data(),
                 sigma_m.mutable_data(), sigma_rad.mutable_data()});
  return py::make_tuple(sigmas, move, turn, turned, sigma_m, sigma_rad);
}

// limits: as CommonLimits.
using Limits = std::tuple<double, double, double, std::int64_t>;

CommonLimits limits_of(const Limits& limits) {
  const auto& [telling, spread, median, few] = limits;
  return {telling, spread, median, few};
}

// poses: of a solution and of the front-end, body from world, each rotation and translation. pairs: first and second.
py::tuple steps_against(const std::array<Doubles, 4>& poses, const std::pair<Ints, Ints>& pairs,
                        const std::array<double, 5>& worth, const Limits& limits) {
  const Steps steps = inverse_steps_between(poses[0], poses[1], pairs.first, pairs.second);
  const Steps measured = inverse_steps_between(poses[2], poses[3], pairs.first, pairs.second);
  const py::tuple comparison = compared(steps, measured, worth);
  const auto column = [&comparison](int i) { return comparison[i].cast<Doubles>(); };
  const Doubles turned = column(3), sigma_m = column(4), sigma_rad = column(5);
  const CommonLimits at = limits_of(limits);
  const double scale = scale_error(view_of(steps), view_of(measured), sigma_m.data(), at);
  const double turn = turn_error(view_of(steps), view_of(measured), turned.data(), sigma_rad.data(), at);
  return py::make_tuple(steps, measured, comparison, scale, turn);
}

// Of each camera, how many of its observations have a residual up to a gate, and how many there are.
py::tuple agreeing_by_camera(const Ints& camera, const Doubles& norms, double gate, py::ssize_t n_cameras) {
  Ints agreeing({n_cameras}), every({n_cameras});
  std::int64_t *to_agreeing = agreeing.mutable_data(), *to_every = every.mutable_data();
  const std::int64_t* of = camera.data();
  const double* norm = norms.data();
  std::fill_n(to_agreeing, n_cameras, 0);
  std::fill_n(to_every, n_cameras, 0);
  for (py::ssize_t o = 0; o < norms.size(); ++o) {
    ++to_every[of[o]];
    to_agreeing[of[o]] += norm[o] <= gate;
  }
  return py::make_tuple(agreeing, every);
}

std::pair<double, double> medians_off_of(const Steps& steps, const Steps& others, const Doubles& sigma_rad,
                                         const Doubles& sigma_m) {
  return medians_off(view_of(steps), view_of(others), sigma_rad.data(), sigma_m.data());
}

// The places of some points in a column that ascends, one point after the other, and which of them each is of.
py::tuple rows_of_points(const Ints& point, const Ints& wanted) {
  std::vector<std::int64_t> rows, which;
  for (py::ssize_t k = 0; k < wanted.size(); ++k) {
    const std::int64_t *begin = point.data(), *end = begin + point.size();
    const auto [first, last] = std::equal_range(begin, end, wanted.data()[k]);
    for (const std::int64_t* at = first; at != last; ++at) rows.push_back(at - begin);
    which.resize(rows.size(), k);
  }
  const auto taken = [](const std::vector<std::int64_t>& from) {
    return Ints(static_cast<py::ssize_t>(from.size()), from.data());
  };
  return py::make_tuple(taken(rows), taken(which));
}

// Of two images, how many ids they share, and how many of these have the same pixel; None unless the ids of both rise.
py::object shared_pixels(const std::pair<Array<std::uint64_t>, Array<std::uint64_t>>& ids,
                         const std::pair<Doubles, Doubles>& uv) {
  const auto rise = [](const Array<std::uint64_t>& of) {
    return std::adjacent_find(of.data(), of.data() + of.size(), std::greater_equal<>()) == of.data() + of.size();
  };
  if (!rise(ids.first) || !rise(ids.second)) return py::none();
  const std::uint64_t *a = ids.first.data(), *b = ids.second.data();
  const double *p = uv.first.data(), *q = uv.second.data();
  std::int64_t shared = 0, same = 0;
  for (py::ssize_t i = 0, j = 0; i < ids.first.size() && j < ids.second.size();) {
    if (a[i] == b[j]) {
      ++shared;
      same += p[2 * i] == q[2 * j] && p[2 * i + 1] == q[2 * j + 1];
    }
    const bool first = a[i] <= b[j], second = b[j] <= a[i];
    i += first;
    j += second;
  }
  return py::make_tuple(shared, same);
}

// most: as are_sound.
bool are_sound_steps(const py::object& steps, std::int64_t n_keyframes, double most) {
  const Ints keyframes = array_of<std::int64_t>(steps, "keyframes");
  const Doubles rotation = array_of<double>(steps, "rotation"), translation = array_of<double>(steps, "translation"),
                root = array_of<double>(steps, "root_information");
  return are_sound({keyframes.shape(0), keyframes.data(), rotation.data(), translation.data(), root.data()},
                   n_keyframes, most);
}

// most: variances of blocks that are scaled to a unit diagonal.
py::tuple loosest_of(const Doubles& blocks, const Doubles& positions, double most) {
  const auto [sigma_m, sigma_rad] = loosest(blocks.data(), positions.data(), blocks.shape(0), most);
  return py::make_tuple(sigma_m, sigma_rad);
}

}  // namespace

void bind_steps(py::module_& m) {
  m.def("steps_between", &steps_between);
  m.def("inverse_steps_between", &inverse_steps_between);
  m.def("compare_steps", &compared);
  m.def("steps_against", &steps_against);
  m.def("agreeing_by_camera", &agreeing_by_camera);
  m.def("shared_pixels", &shared_pixels);
  m.def("rows_of_points", &rows_of_points);
  m.def("medians_off", &medians_off_of);
  m.def("are_sound", &are_sound_steps);
  m.def("loosest", &loosest_of);
}

}  // namespace ba
