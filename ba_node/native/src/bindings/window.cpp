// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "bindings/window.hpp"

#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <limits>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "adjustment/choice.hpp"
#include "adjustment/sound.hpp"
#include "adjustment/trial.hpp"
#include "bindings/arrays.hpp"

namespace ba {

namespace {

// seen: of each observation as a unit vector in its camera; empty for cameras without distortion. None if it must not
// be.
py::object rays(const py::object& problem, const Doubles& seen) {
  const ProblemArrays arrays(problem);
  const ProblemView view = arrays.view();
  const auto n = static_cast<py::ssize_t>(view.n_obs);
  if (seen.size() < 3 * n && !all_straight(view)) return py::none();
  Doubles centre({n, py::ssize_t{3}}), direction({n, py::ssize_t{3}}), px_per_rad({n}), distance({n}),
      distance_sigma({n});
  const RaysSpan out{centre.mutable_data(), direction.mutable_data(), px_per_rad.mutable_data(),
                     distance.mutable_data(), distance_sigma.mutable_data()};
  const StateView at = arrays.start.view();
  const double* in_cameras = seen.size() ? seen.data() : nullptr;
  const bool good = unless_short(n, [&] { return rays_of(view, at, in_cameras, out); });
  return py::make_tuple(py::make_tuple(centre, direction, px_per_rad, distance, distance_sigma), good);
}

// limits: of AgreementLimits all but the gate.
py::tuple agreed(const py::object& rays, py::ssize_t n_points, double gate, const std::array<double, 4>& limits) {
  const RaysArrays arrays(rays);
  const RaysView view = arrays.view();
  Doubles points({n_points, py::ssize_t{3}}), parallax({n_points});
  Array<bool> measured({n_points}), good({n_points}), agrees({arrays.point.size()});
  active_target().consensus(view, n_points, gate, points.mutable_data(), parallax.mutable_data(),
                            measured.mutable_data(), agrees.mutable_data());
  tells_place(view, n_points, points.data(), parallax.data(), measured.data(), agrees.data(),
              {gate, limits[0], limits[1], limits[2], limits[3]}, good.mutable_data());
  return py::make_tuple(points, good, measured);
}

// flags: usable (n_obs,); least: of a keyframe, whether it may take part at all (n_kf,) and how many points it has to
// see (n_kf,); points: whether they may take part, and whether they count (n_pt,).
py::tuple determined_of(const py::object& observations, const Array<bool>& usable,
                        const std::tuple<Array<bool>, Ints, std::int64_t>& least,
                        const std::pair<Array<bool>, Array<bool>>& points) {
  const Ints keyframe = array_of<std::int64_t>(observations, "keyframe"),
             point = array_of<std::int64_t>(observations, "point");
  const Doubles depth = array_of<double>(observations, "depth_m");
  const auto& [may, least_points, least_observations] = least;
  Determined found({point.size(), point.data(), keyframe.data(), usable.data(), depth.size() ? depth.data() : nullptr},
                   points.second.data(), {may.data(), least_points.data(), least_observations});
  found.keep_points.assign(points.first.data(), points.first.data() + points.first.size());
  found.keep_keyframes.resize(may.size());
  found.run();
  const auto flags = [](const std::vector<char>& from) {
    Array<bool> out({static_cast<py::ssize_t>(from.size())});
    std::copy(from.begin(), from.end(), out.mutable_data());
    return out;
  };
  return py::make_tuple(ints(found.rows()), flags(found.keep_keyframes), flags(found.keep_points));
}

// off: of each keyframe, what its residuals are divided by. limits: as MotionLimits.
Array<bool> move_more_than_noise(const py::object& observations, const Doubles& norms, const Doubles& off,
                                 std::int64_t n_points, const std::array<double, 5>& limits) {
  const Ints keyframe = array_of<std::int64_t>(observations, "keyframe"),
             point = array_of<std::int64_t>(observations, "point");
  Array<bool> found({static_cast<py::ssize_t>(n_points)});
  const MotionLimits at{limits[0], limits[1], limits[2], limits[3], limits[4]};
  leave_more_than_noise({norms.size(), point.data(), keyframe.data(), norms.data(), off.data()}, n_points, at,
                        found.mutable_data());
  return found;
}

// unplaced: points that have no place, (n_pt,). of_noise, limits: as NoiseLimits and MotionLimits.
py::tuple seem_to_move(const py::object& observations, const Doubles& norms, const Array<bool>& unplaced,
                       const Array<bool>& unrefined, const std::tuple<double, double, std::int64_t>& of_noise,
                       const std::array<double, 5>& limits) {
  const Ints keyframe = array_of<std::int64_t>(observations, "keyframe"),
             point = array_of<std::int64_t>(observations, "point");
  std::vector<double> counted(norms.data(), norms.data() + norms.size());
  for (std::size_t o = 0; o < counted.size(); ++o)
    if (unplaced.data()[point.data()[o]]) counted[o] = std::numeric_limits<double>::infinity();
  const auto& [at_rank, rank, known] = of_noise;
  ResidualsView seen{norms.size(), point.data(), keyframe.data(), counted.data(), nullptr};
  Doubles off({unrefined.size()});
  const std::vector<double> times = off_noise(seen, unrefined.data(), unrefined.size(), {at_rank, rank, known});
  std::copy(times.begin(), times.end(), off.mutable_data());
  seen.off = off.data();
  Array<bool> found({unplaced.size()});
  leave_more_than_noise(seen, unplaced.size(), {limits[0], limits[1], limits[2], limits[3], limits[4]},
                        found.mutable_data());
  return py::make_tuple(off, found);
}

// As residual_norms, of some observations.
Doubles residual_norms_of(const py::object& problem, const py::object& state, const Ints& rows) {
  const ProblemArrays arrays(problem);
  const StateArrays at(state);
  ProblemView view = arrays.view();
  const auto taken = [&rows](const auto* from, std::int64_t width) {
    std::vector<std::decay_t<decltype(*from)>> out;
    out.reserve(width * rows.size());
    for (py::ssize_t i = 0; i < rows.size(); ++i)
      out.insert(out.end(), from + width * rows.data()[i], from + width * (rows.data()[i] + 1));
    return out;
  };
  const auto keyframe = taken(view.keyframe, 1), camera = taken(view.camera, 1), point = taken(view.point, 1);
  const auto uv = taken(view.uv, 2), sigma = taken(view.sigma, 1);
  view.n_obs = rows.size();
  view.keyframe = keyframe.data();
  view.camera = camera.data();
  view.point = point.data();
  view.uv = uv.data();
  view.sigma = sigma.data();
  view.depth = view.depth_sigma = nullptr;
  Doubles norms({rows.size()});
  active_target().residual_norms(view, at.view(), norms.mutable_data());
  return norms;
}

// points: where they are and began, (n, 3) m; of: the centre (3,) and what may not be far away, (n,) or (0,). limits:
// as ReturnLimits.
py::tuple may_have_run_away_of(const Ints& point, const Doubles& norms, const std::pair<Doubles, Doubles>& points,
                               const std::pair<Doubles, Array<bool>>& of, const std::array<double, 3>& limits) {
  const py::ssize_t n = points.first.shape(0);
  Array<bool> away({n}), began({n}), leapt({n}), doubted({n});
  Ints agreeing({n});
  may_have_run_away({point.size(), n, point.data(), norms.data()}, points.first.data(), points.second.data(),
                    of.first.data(), of.second.size() ? of.second.data() : nullptr, {limits[0], limits[1], limits[2]},
                    {away.mutable_data(), began.mutable_data(), leapt.mutable_data(), doubted.mutable_data(),
                     agreeing.mutable_data()});
  return py::make_tuple(doubted, agreeing, away, began, leapt);
}

Array<bool> stand_out_of(const py::object& observations, const Doubles& norms, std::int64_t n_cameras, double far) {
  const Ints camera = array_of<std::int64_t>(observations, "camera"),
             point = array_of<std::int64_t>(observations, "point");
  Array<bool> found({norms.size()});
  stand_out({norms.size(), 0, point.data(), norms.data()}, camera.data(), n_cameras, far, found.mutable_data());
  return found;
}

// Of each keyframe, how many of some observations it has, and how many of them are of points that are marked.
py::tuple seen_by_keyframe(const py::object& observations, const Array<bool>& used, const Array<bool>& marked,
                           py::ssize_t n_keyframes) {
  const Ints keyframe = array_of<std::int64_t>(observations, "keyframe"),
             point = array_of<std::int64_t>(observations, "point");
  Ints every({n_keyframes}), well({n_keyframes});
  std::int64_t *to_every = every.mutable_data(), *to_well = well.mutable_data();
  std::fill_n(to_every, n_keyframes, 0);
  std::fill_n(to_well, n_keyframes, 0);
  for (py::ssize_t o = 0; o < point.size(); ++o) {
    if (!used.data()[o]) continue;
    ++to_every[keyframe.data()[o]];
    to_well[keyframe.data()[o]] += marked.data()[point.data()[o]];
  }
  return py::make_tuple(every, well);
}

// rows: views of the tracks, and which of these each is of; seen: of each, as in rays. limits: as TrialLimits.
py::object explained(const py::object& problem, const std::tuple<Ints, Ints, Doubles>& views,
                     const std::pair<std::int64_t, std::int64_t>& tracks, const std::array<Doubles, 4>& poses,
                     const std::tuple<double, double, double, std::int64_t, std::int64_t>& limits) {
  const ProblemArrays arrays(problem);
  const auto& [rows, track, seen] = views;
  const auto& [parallax, bound, behind, least_views, least_residuals] = limits;
  const auto [n_tried, n_out] = tracks;
  if (seen.size() < 3 * rows.size() && !all_straight(arrays.view())) return py::none();
  Trial trial(active_target(), arrays.view(), {rows.size(), n_tried, rows.data(), track.data()},
              seen.size() ? seen.data() : nullptr);
  const Explained found = trial.explained({{poses[0].data(), poses[2].data()}, {poses[1].data(), poses[3].data()}},
                                          n_out, {parallax, bound, behind, least_views, least_residuals});
  Doubles held_out({py::ssize_t{2}}), mean({py::ssize_t{2}, static_cast<py::ssize_t>(found.mean[0].size())}),
      points({static_cast<py::ssize_t>(n_out), py::ssize_t{3}});
  std::copy_n(found.held_out.data(), 2, held_out.mutable_data());
  for (int s = 0; s < 2; ++s) std::copy(found.mean[s].begin(), found.mean[s].end(), mean.mutable_data(s));
  std::copy_n(found.points.data(), 3 * n_out, points.mutable_data());
  return py::make_tuple(held_out, mean, found.parallax, points);
}

bool is_sound_problem(const py::object& problem) {
  const ProblemArrays arrays(problem);
  const ProblemView view = arrays.view();
  const StateView start = arrays.start.view();
  return unless_short(view.n_obs, [&] { return is_sound(view, start); });
}

}  // namespace

void bind_window(py::module_& m) {
  bind_views(m);
  bind_steps(m);
  m.def("explained", &explained);
  m.def("agreed", &agreed);
  m.def("is_sound", &is_sound_problem);
  m.def("seem_to_move", &seem_to_move);
  m.def("residual_norms_of", &residual_norms_of);
  m.def("rays", &rays);
  m.def("determined", &determined_of);
  m.def("move_more_than_noise", &move_more_than_noise);
  m.def("may_have_run_away", &may_have_run_away_of);
  m.def("stand_out", &stand_out_of);
  m.def("seen_by_keyframe", &seen_by_keyframe);
}

}  // namespace ba
