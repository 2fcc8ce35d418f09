// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "adjustment/steps.hpp"

#include <pybind11/stl.h>

#include <array>
#include <tuple>
#include <utility>

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

double scale_error_of(const Steps& steps, const Steps& measured, const Doubles& sigma_m, const Limits& limits) {
  return scale_error(view_of(steps), view_of(measured), sigma_m.data(), limits_of(limits));
}

double turn_error_of(const Steps& steps, const Steps& measured, const Doubles& turned, const Doubles& sigma_rad,
                     const Limits& limits) {
  return turn_error(view_of(steps), view_of(measured), turned.data(), sigma_rad.data(), limits_of(limits));
}

std::pair<double, double> medians_off_of(const Steps& steps, const Steps& others, const Doubles& sigma_rad,
                                         const Doubles& sigma_m) {
  return medians_off(view_of(steps), view_of(others), sigma_rad.data(), sigma_m.data());
}

}  // namespace

void bind_steps(py::module_& m) {
  m.def("steps_between", &steps_between);
  m.def("inverse_steps_between", &inverse_steps_between);
  m.def("compare_steps", &compared);
  m.def("scale_error", &scale_error_of);
  m.def("turn_error", &turn_error_of);
  m.def("medians_off", &medians_off_of);
}

}  // namespace ba
