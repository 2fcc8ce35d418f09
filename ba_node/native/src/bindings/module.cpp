// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The Python module ba_node.native._kernels. core/native_kernels.py checks shapes; every call frees the GIL.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <tuple>
#include <utility>
#include <vector>

#include "adjustment/consensus.hpp"
#include "adjustment/kernel.hpp"
#include "adjustment/norms.hpp"
#include "adjustment/relative_poses.hpp"
#include "adjustment/triangulate.hpp"

namespace py = pybind11;

namespace {

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Doubles = Array<double>;
using Ints = Array<std::int64_t>;
using StateArrays = std::tuple<Doubles, Doubles, Doubles, Doubles>;  // rotation, translation, points, intrinsics

ba::StateView view(const StateArrays& s) {
  const Doubles& own = std::get<3>(s);
  return {std::get<0>(s).data(), std::get<1>(s).data(), std::get<2>(s).data(), own.size() ? own.data() : nullptr};
}

Doubles empty(std::vector<py::ssize_t> shape) { return Doubles(std::move(shape)); }

template <class T>
py::array_t<T> copy(const std::vector<T>& values, std::vector<py::ssize_t> shape) {
  py::array_t<T> out(std::move(shape));
  std::copy(values.begin(), values.end(), out.mutable_data());
  return out;
}

// Shapes are those of core/problem.py; the view points into the arrays.
ba::ProblemView view(const Ints& keyframe, const Ints& camera, const Ints& point, const Doubles& uv,
                     const Doubles& sigma, const Doubles& camera_rotation, const Doubles& camera_translation,
                     const Array<std::uint8_t>& model, const Doubles& params, const StateArrays& start) {
  return {std::get<1>(start).shape(0),
          std::get<2>(start).shape(0),
          keyframe.size(),
          model.size(),
          keyframe.data(),
          camera.data(),
          point.data(),
          uv.data(),
          sigma.data(),
          nullptr,
          nullptr,
          camera_rotation.data(),
          camera_translation.data(),
          params.data(),
          model.data(),
          nullptr};
}

Doubles residual_norms(const Ints& keyframe, const Ints& camera, const Ints& point, const Doubles& uv,
                       const Doubles& sigma, const Doubles& camera_rotation, const Doubles& camera_translation,
                       const Array<std::uint8_t>& model, const Doubles& params, const StateArrays& state) {
  const ba::ProblemView problem =
      view(keyframe, camera, point, uv, sigma, camera_rotation, camera_translation, model, params, state);
  const ba::StateView at = view(state);
  Doubles norms = empty({keyframe.size()});
  double* out = norms.mutable_data();
  py::gil_scoped_release release;
  ba::residual_norms(problem, at, out);
  return norms;
}

// Points (n_points, 3), parallax and whether a distance was measured, both (n_points,).
py::tuple triangulate(const Ints& point, const Doubles& centre, const Doubles& direction, const Doubles& px_per_rad,
                      const Doubles& distance, const Doubles& distance_sigma, py::ssize_t n_points) {
  const ba::RaysView rays{point.size(),      point.data(),    centre.data(),        direction.data(),
                          px_per_rad.data(), distance.data(), distance_sigma.data()};
  Doubles points = empty({n_points, 3}), parallax = empty({n_points});
  Array<bool> measured({n_points});
  double *x = points.mutable_data(), *angle = parallax.mutable_data();
  bool* has_distance = measured.mutable_data();
  {
    py::gil_scoped_release release;
    ba::Triangulator(rays, n_points).run(x, angle, has_distance);
  }
  return py::make_tuple(points, parallax, measured);
}

// Whether each ray agrees with the place that most rays of its point agree on, (n_rays,).
Array<bool> agreeing(const Ints& point, const Doubles& centre, const Doubles& direction, const Doubles& px_per_rad,
                     const Doubles& distance, const Doubles& distance_sigma, py::ssize_t n_points, double gate) {
  const ba::RaysView rays{point.size(),      point.data(),    centre.data(),        direction.data(),
                          px_per_rad.data(), distance.data(), distance_sigma.data()};
  Array<bool> agrees({point.size()});
  bool* out = agrees.mutable_data();
  {
    py::gil_scoped_release release;
    ba::Consensus(rays, n_points, gate).run(out);
  }
  return agrees;
}

template <int D>
ba::Kernel<D>* make(const Ints& keyframe, const Ints& camera, const Ints& point, const Doubles& uv, const Doubles& sigma,
                    const Doubles& depth, const Doubles& depth_sigma, const Doubles& camera_rotation,
                    const Doubles& camera_translation, const Array<std::uint8_t>& model, const Doubles& params,
                    const Array<bool>& fixed, int loss, double loss_scale, int cheirality,
                    const std::tuple<Ints, Ints>& factor_pairs, int threads, const StateArrays& start) {
  ba::ProblemView problem =
      view(keyframe, camera, point, uv, sigma, camera_rotation, camera_translation, model, params, start);
  problem.depth = depth.size() ? depth.data() : nullptr;
  problem.depth_sigma = depth_sigma.data();
  problem.fixed = fixed.data();
  const ba::Rules rules{static_cast<ba::Loss>(loss), loss_scale, static_cast<ba::Cheirality>(cheirality)};
  const ba::StateView state = view(start);
  const auto& [row, column] = factor_pairs;
  ba::CoupledPairs pairs;
  pairs.row.assign(row.data(), row.data() + row.size());
  pairs.column.assign(column.data(), column.data() + column.size());
  py::gil_scoped_release release;
  return new ba::Kernel<D>(problem, rules, state, std::move(pairs), threads);
}

// The upper triangle of S: blocks, rows, columns.
template <int D>
py::tuple sparse(ba::Kernel<D>& kernel) {
  const ba::SparseSchur<D>* schur = nullptr;
  {
    py::gil_scoped_release release;
    schur = &kernel.assemble();
  }
  const ba::Rows32& pattern = schur->pattern();
  const auto n = static_cast<py::ssize_t>(pattern.index.size());
  Doubles blocks = empty({n, D, D});
  for (py::ssize_t k = 0; k < n; ++k) ba::write_block(schur->blocks()[k], blocks.mutable_data() + k * D * D, D);
  return py::make_tuple(blocks, copy(pattern.index, {n}), copy(pattern.start, {pattern.count() + 1}));
}

template <int D>
void bind(py::module_& m, const char* name) {
  using K = ba::Kernel<D>;
  py::class_<K>(m, name)
      .def(py::init(&make<D>), py::kw_only(), py::arg("keyframe"), py::arg("camera"), py::arg("point"), py::arg("uv"),
           py::arg("sigma_px"), py::arg("depth_m"), py::arg("depth_sigma_m"), py::arg("camera_rotation"),
           py::arg("camera_translation"), py::arg("camera_model"), py::arg("camera_params"), py::arg("fixed"),
           py::arg("loss"), py::arg("loss_scale"), py::arg("cheirality"), py::arg("factor_pairs"), py::arg("threads"),
           py::arg("start"))
      .def_property_readonly("n_free", &K::n_free)
      .def_property_readonly("n_chunks", &K::n_chunks)
      .def_property_readonly("gradient_norm", &K::gradient_norm)
      .def("linearise",
           [](K& k, const StateArrays& s) {
             py::gil_scoped_release release;
             return k.linearise(view(s));
           })
      .def("linearise_polished",
           [](K& k) {
             py::gil_scoped_release release;
             return k.linearise_polished();
           })
      .def("add_factors",
           [](K& k, const Doubles& diagonal, const Doubles& gradient, const Doubles& pairs) {
             k.add_factors(diagonal.data(), gradient.data(), pairs.data());
           })
      .def("objective",
           [](K& k, const StateArrays& s) {
             py::gil_scoped_release release;
             return k.objective(view(s));
           })
      .def("polish_points",
           [](K& k, const StateArrays& s, int steps) {
             const Doubles& start = std::get<2>(s);
             Doubles points = empty({start.shape(0), 3});
             double* out = points.mutable_data();
             ba::Polished value;
             {
               py::gil_scoped_release release;
               value = k.polish_points(view(s), out, steps);
             }
             return py::make_tuple(value.before, value.after, points);
           })
      .def("diagonals",
           [](const K& k) {
             Doubles d_c = empty({k.n_free(), D}), d_p = empty({k.n_points(), 3});
             k.diagonals(d_c.mutable_data(), d_p.mutable_data());
             return py::make_tuple(d_c, d_p);
           })
      .def("factor",
           [](K& k, const Doubles& damping_c, const Doubles& damping_p) {
             const double *c = damping_c.data(), *p = damping_p.data();
             py::gil_scoped_release release;
             k.factor(c, p);
           })
      .def("damp",
           [](K& k, bool diagonal, double mu) {
             py::gil_scoped_release release;
             k.damp(diagonal, mu);
           })
      .def("move",
           [](K& k, const StateArrays& from, const Doubles& step_c, int steps, StateArrays to) {
             const ba::StateSpan span{std::get<0>(to).mutable_data(), std::get<1>(to).mutable_data(),
                                      std::get<2>(to).mutable_data(), std::get<3>(to).mutable_data()};
             const double* step = step_c.data();
             ba::Moved moved;
             {
               py::gil_scoped_release release;
               moved = k.move(view(from), step, steps, span);
             }
             return py::make_tuple(moved.predicted, moved.damping, moved.objective.before, moved.objective.after);
           })
      .def("rhs",
           [](const K& k, py::array_t<double, py::array::c_style> out) { k.rhs(out.mutable_data()); })
      .def("dense",
           [](K& k, py::array_t<double, py::array::c_style> out) {
             double* s = out.mutable_data();
             py::gil_scoped_release release;
             k.dense(s);
           })
      .def("solve",
           [](K& k, py::array_t<double, py::array::c_style> out) {
             double* x = out.mutable_data();
             py::gil_scoped_release release;
             return k.solve(x);
           })
      .def("sparse", &sparse<D>)
      .def("analyse",
           [](K& k, std::int64_t max_blocks, double max_products) {
             const ba::Fill* fill = nullptr;
             {
               py::gil_scoped_release release;
               fill = &k.analyse({max_blocks, max_products});
             }
             return py::make_tuple(fill->complete, fill->blocks, fill->products);
           })
      .def("pairs", [](const K& k) { return py::make_tuple(k.n_edges(), k.n_pairs()); })
      .def("solve_sparse",
           [](K& k) -> py::object {
             Doubles x = empty({k.n_free() * D});
             double* out = x.mutable_data();
             bool found = false;
             {
               py::gil_scoped_release release;
               found = k.solve_sparse(out);
             }
             return found ? py::object(x) : py::none();
           })
      .def("pcg",
           [](K& k, const Doubles& scale, int kind, std::tuple<double, std::int64_t, double, double> limits, bool formed,
              py::array_t<double, py::array::c_style> out) {
             const auto [t_eps, max_iterations, radius, q_eps] = limits;
             const double* d = scale.data();
             double* x = out.mutable_data();
             ba::PcgEnd end;
             {
               py::gil_scoped_release release;
               end = k.pcg(d, static_cast<ba::Preconditioner>(kind), {t_eps, max_iterations, radius, q_eps}, formed, x);
             }
             return py::make_tuple(end.found, end.iterations, end.on_boundary);
           })
      .def("product",
           [](K& k, const Doubles& x) {
             Doubles out = empty({k.n_free() * D});
             const double* in = x.data();
             double* y = out.mutable_data();
             {
               py::gil_scoped_release release;
               k.product(in, y);
             }
             return out;
           })
      .def("diagonal_blocks",
           [](K& k) {
             Doubles out = empty({k.n_free(), D, D});
             double* blocks = out.mutable_data();
             {
               py::gil_scoped_release release;
               k.diagonal_blocks(blocks);
             }
             return out;
           })
      .def("back_substitute", [](K& k, const Doubles& step_c) {
        Doubles step_p = empty({k.n_points(), 3});
        const double* in = step_c.data();
        double* out = step_p.mutable_data();
        double reduction = 0;
        {
          py::gil_scoped_release release;
          reduction = k.back_substitute(in, nullptr, out);
        }
        return py::make_tuple(step_p, reduction);
      });
}

ba::RelativePoses* make_relative_poses(const Ints& keyframes, const Doubles& rotation, const Doubles& translation,
                                       const Doubles& root_information, int loss, double loss_scale, const Ints& column,
                                       const Ints& pair) {
  return new ba::RelativePoses({pair.size(), keyframes.data(), rotation.data(), translation.data(), root_information.data(),
                                static_cast<ba::FactorLoss>(loss), loss_scale},
                               column.data(), column.size(), pair.data());
}

void bind_relative_poses(py::module_& m) {
  using R = ba::RelativePoses;
  py::class_<R>(m, "RelativePoses")
      .def(py::init(&make_relative_poses), py::kw_only(), py::arg("keyframes"), py::arg("rotation"), py::arg("translation"),
           py::arg("root_information"), py::arg("loss"), py::arg("loss_scale"), py::arg("column"), py::arg("pair"))
      .def("value",
           [](const R& r, const Doubles& rotation, const Doubles& translation) {
             return r.value({rotation.data(), translation.data(), nullptr, nullptr});
           })
      // Adds to gradient, diagonal and pairs.
      .def("linearise", [](const R& r, const Doubles& rotation, const Doubles& translation, Doubles gradient,
                           Doubles diagonal, Doubles pairs) {
        return r.linearise({rotation.data(), translation.data(), nullptr, nullptr},
                           {gradient.mutable_data(), diagonal.mutable_data(), pairs.mutable_data()});
      });
}

}  // namespace

PYBIND11_MODULE(_kernels, m) {
  ba::Slabs::shared().warm();
  empty({0});  // has pybind11 find what it needs of numpy, which the first solve would wait for
  m.doc() = "Kernels of bundle adjustment in C++; see ba_node/core/kernels.py.";
  bind<6>(m, "Kernel6");
  bind<9>(m, "Kernel9");
  bind_relative_poses(m);
  m.def("allocations", [] { return ba::allocations.load(); });
  m.def("residual_norms", &residual_norms, py::kw_only(), py::arg("keyframe"), py::arg("camera"), py::arg("point"),
        py::arg("uv"), py::arg("sigma_px"), py::arg("camera_rotation"), py::arg("camera_translation"),
        py::arg("camera_model"), py::arg("camera_params"), py::arg("state"));
  m.def("triangulate", &triangulate, py::kw_only(), py::arg("point"), py::arg("centre"), py::arg("direction"),
        py::arg("px_per_rad"), py::arg("distance_m"), py::arg("distance_sigma_m"), py::arg("n_points"));
  m.def("agreeing", &agreeing, py::kw_only(), py::arg("point"), py::arg("centre"), py::arg("direction"),
        py::arg("px_per_rad"), py::arg("distance_m"), py::arg("distance_sigma_m"), py::arg("n_points"),
        py::arg("gate"));
}
