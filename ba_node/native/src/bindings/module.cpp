// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The Python module ba_node.native._kernels; its face is _kernels.pyi. Every call frees the GIL.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstddef>
#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings/arrays.hpp"
#include "bindings/window.hpp"
#include "parallel/memory.hpp"
#include "targets/target.hpp"

namespace ba {

namespace {

// What this processor can run, the widest first.
std::vector<const Target*> supported_targets() {
  std::vector<const Target*> out;
#if defined(__x86_64__)
  __builtin_cpu_init();
  [[maybe_unused]] const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                                         __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
#if defined(BA_HAS_AVX512)
  if (has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
    out.push_back(&avx512::kTarget);
#endif
#if defined(BA_HAS_AVX2)
  if (has_avx2) out.push_back(&avx2::kTarget);
#endif
#endif
  out.push_back(&baseline::kTarget);
  return out;
}

const Target* target = &baseline::kTarget;

py::tuple target_names() {
  py::list names;
  for (const Target* each : supported_targets()) names.append(each->name);
  return py::tuple(names);
}

void use_target(const std::string& name) {
  for (const Target* each : supported_targets()) {
    if (name != each->name) continue;
    target = each;
    return;
  }
  throw py::value_error("target '" + name + "' is not one that this processor runs");
}

}  // namespace

const Target& active_target() { return *target; }

namespace {

Doubles residual_norms(const py::object& problem, const py::object& state) {
  const ProblemArrays arrays(problem);
  const StateArrays at(state);
  Doubles norms = empty({arrays.keyframe.size()});
  double* out = norms.mutable_data();
  unless_short(norms.size(), [&] { target->residual_norms(arrays.view(), at.view(), out); });
  return norms;
}

// cost: loss and its scale, sigmas. limits: as ResectionLimits. None if the keyframe stays where it is.
py::object resect(const py::object& problem, std::int64_t keyframe, const std::pair<std::string, double>& cost,
                  const std::tuple<std::int64_t, std::int64_t, double, double>& limits) {
  const ProblemArrays arrays(problem);
  const auto& [least, iterations, least_gain, damping] = limits;
  CostModel model;
  model.loss = loss_named(cost.first);
  model.scale = cost.second;
  double pose[12];
  const ProblemView view = arrays.view();
  Array<bool> alone({static_cast<py::ssize_t>(view.n_points)});
  if (!target->resect(view, arrays.start.view(), keyframe, model, {least, iterations, least_gain, damping}, pose,
                      alone.mutable_data()))
    return py::none();
  Doubles rotation = empty({3, 3}), translation = empty({3});
  std::copy_n(pose, 9, rotation.mutable_data());
  std::copy_n(pose + 9, 3, translation.mutable_data());
  return py::make_tuple(rotation, translation, alone);
}

py::tuple triangulate(const py::object& rays, py::ssize_t n_points) {
  const RaysArrays arrays(rays);
  Doubles points = empty({n_points, 3}), parallax = empty({n_points});
  Array<bool> measured({n_points});
  double *x = points.mutable_data(), *angle = parallax.mutable_data();
  bool* has_distance = measured.mutable_data();
  without_gil([&] { target->triangulate(arrays.view(), n_points, x, angle, has_distance); });
  return py::make_tuple(points, parallax, measured);
}

Array<bool> agreeing(const py::object& rays, py::ssize_t n_points, double gate) {
  const RaysArrays arrays(rays);
  Array<bool> agrees({arrays.point.size()});
  bool* out = agrees.mutable_data();
  without_gil([&] { target->agreeing(arrays.view(), n_points, gate, out); });
  return agrees;
}

py::tuple consensus(const py::object& rays, py::ssize_t n_points, double gate) {
  const RaysArrays arrays(rays);
  Doubles points = empty({n_points, 3}), parallax = empty({n_points});
  Array<bool> measured({n_points}), agrees({arrays.point.size()});
  double *x = points.mutable_data(), *angle = parallax.mutable_data();
  bool *has_distance = measured.mutable_data(), *out = agrees.mutable_data();
  without_gil([&] { target->consensus(arrays.view(), n_points, gate, x, angle, has_distance, out); });
  return py::make_tuple(points, parallax, measured, agrees);
}

// cost: loss, its scale, cheirality and the least promise of a point's own step.
Kernel* make_kernel(const py::object& problem, const std::tuple<std::string, double, std::string, double>& cost,
                    const std::tuple<Ints, Ints>& factor_pairs, int threads) {
  const ProblemArrays arrays(problem);
  const auto& [loss, scale, cheirality, least_promise] = cost;
  KernelArguments arguments;
  arguments.problem = arrays.view();
  arguments.cost = {loss_named(loss), scale, cheirality_named(cheirality), least_promise};
  arguments.start = arrays.start.view();
  const auto& [row, column] = factor_pairs;
  arguments.factors.row.assign(row.data(), row.data() + row.size());
  arguments.factors.column.assign(column.data(), column.data() + column.size());
  arguments.threads = threads;
  const auto make = arrays.start.intrinsics.size() ? target->make_kernel9 : target->make_kernel6;
  return without_gil([&] { return make(std::move(arguments)); });
}

template <class T>
py::array_t<T> copy(const std::vector<T>& values) {
  return py::array_t<T>(static_cast<py::ssize_t>(values.size()), values.data());
}

py::tuple schur_pattern(Kernel& k) {
  const Rows32& pattern = *without_gil([&] { return &k.schur_pattern(); });
  return py::make_tuple(copy(pattern.index), copy(pattern.start));
}

void sparse(Kernel& k, const Ints& place, const Ints& mirrored, OutDoubles out) {
  const std::int64_t *to = place.data(), *turned = mirrored.data();
  double* blocks = out.mutable_data();
  without_gil([&] { k.sparse(to, turned, blocks); });
}

py::tuple inner_iterations(Kernel& k, const py::object& state, int steps) {
  const StateArrays s(state);
  Doubles points = empty({s.points.shape(0), 3});
  double* out = points.mutable_data();
  const Objectives value = without_gil([&] { return k.inner_iterations(s.view(), out, steps); });
  return py::make_tuple(value.before, value.after, points);
}

py::tuple step(Kernel& k, const py::object& from, const Doubles& step_c, int steps, const py::object& to) {
  const StateArrays start(from);
  StateRoom room(to);
  const StateSpan span = room.span();
  const double* by = step_c.data();
  const StepResult out = without_gil([&] { return k.step(start.view(), by, steps, span); });
  return py::make_tuple(out.predicted, out.damping, out.objective.before, out.objective.after);
}

py::tuple pcg(Kernel& k, const Doubles& scale, const std::string& kind, const py::object& limits, bool formed,
              OutDoubles out) {
  const PcgLimits at{limits.attr("t_eps").cast<double>(), limits.attr("max_iterations").cast<std::int64_t>(),
                     limits.attr("radius").cast<double>(), limits.attr("q_eps").cast<double>()};
  const Preconditioner preconditioner = preconditioner_named(kind);
  const double* d = scale.data();
  double* x = out.mutable_data();
  const PcgEnd end = without_gil([&] { return k.pcg(d, preconditioner, at, formed, x); });
  return py::make_tuple(end.found, end.iterations, end.on_boundary);
}

py::object solve_sparse(Kernel& k) {
  Doubles x = empty({k.n_free() * k.size()});
  double* out = x.mutable_data();
  return without_gil([&] { return k.solve_sparse(out); }) ? py::object(x) : py::none();
}

py::tuple back_substitute(Kernel& k, const Doubles& step_c) {
  Doubles step_p = empty({k.n_points(), 3});
  const double* in = step_c.data();
  double* out = step_p.mutable_data();
  const double reduction = without_gil([&] { return k.back_substitute(in, out); });
  return py::make_tuple(step_p, reduction);
}

void bind_assembly(py::class_<Kernel>& kernel) {
  kernel.def_property_readonly("n_free", &Kernel::n_free)
      .def_property_readonly("n_chunks", &Kernel::n_chunks)
      .def_property_readonly("gradient_norm", &Kernel::gradient_norm)
      .def("pairs", [](const Kernel& k) { return py::make_tuple(k.n_edges(), k.n_pairs()); })
      .def("linearise",
           [](Kernel& k, const py::object& state) {
             const StateArrays s(state);
             return without_gil([&] { return k.linearise(s.view()); });
           })
      .def("linearise_prepared", [](Kernel& k) { return without_gil([&] { return k.linearise_prepared(); }); })
      .def("add_factors", [](Kernel& k, const Doubles& diagonal, const Doubles& gradient,
                             const Doubles& pairs) { k.add_factors(diagonal.data(), gradient.data(), pairs.data()); })
      .def("objective",
           [](Kernel& k, const py::object& state) {
             const StateArrays s(state);
             return without_gil([&] { return k.objective(s.view()); });
           })
      .def("inner_iterations", &inner_iterations)
      .def("gradient",
           [](const Kernel& k) {
             Doubles out = empty({k.n_free(), k.size()});
             k.gradient(out.mutable_data());
             return out;
           })
      .def("diagonals",
           [](const Kernel& k, bool of_points) {
             Doubles d_c = empty({k.n_free(), k.size()}), d_p = empty({of_points ? k.n_points() : 0, 3});
             k.diagonals(d_c.mutable_data(), of_points ? d_p.mutable_data() : nullptr);
             return py::make_tuple(d_c, d_p);
           })
      .def("step", &step);
}

void bind_reduced_system(py::class_<Kernel>& kernel) {
  kernel
      .def("factor",
           [](Kernel& k, const Doubles& damping_c, const Doubles& damping_p) {
             const double *c = damping_c.data(), *p = damping_p.data();
             without_gil([&] { k.factor(c, p); });
           })
      .def("damp", [](Kernel& k, bool diagonal, double mu) { without_gil([&] { k.damp(diagonal, mu); }); })
      .def("length2", [](const Kernel& k, bool diagonal, const Doubles& x) { return k.length2(diagonal, x.data()); })
      .def("rhs", [](Kernel& k, OutDoubles out) { k.rhs(out.mutable_data()); })
      .def("dense",
           [](Kernel& k, OutDoubles out) {
             double* s = out.mutable_data();
             without_gil([&] { k.dense(s); });
           })
      .def("solve",
           [](Kernel& k, OutDoubles out) {
             double* x = out.mutable_data();
             return without_gil([&] { return k.solve(x); });
           })
      .def("sparse", &sparse)
      .def("schur_pattern", &schur_pattern)
      .def("analyse",
           [](Kernel& k, std::int64_t max_blocks, double max_products) {
             const Fill& fill = *without_gil([&] { return &k.analyse({max_blocks, max_products}); });
             return py::make_tuple(fill.complete, fill.blocks, fill.products);
           })
      .def("solve_sparse", &solve_sparse)
      .def("pcg", &pcg)
      .def("product",
           [](Kernel& k, const Doubles& x) {
             Doubles out = empty({k.n_free() * k.size()});
             const double* in = x.data();
             double* y = out.mutable_data();
             without_gil([&] { k.product(in, y); });
             return out;
           })
      .def("diagonal_blocks",
           [](Kernel& k) {
             Doubles out = empty({k.n_free(), k.size(), k.size()});
             double* blocks = out.mutable_data();
             without_gil([&] { k.diagonal_blocks(blocks); });
             return out;
           })
      .def("back_substitute", &back_substitute);
}

// columns, starts: of the rows of the upper triangle of a matrix by d x d blocks.
SparseFactor* make_factor(int d, const Ints& columns, const Ints& starts) {
  Rows32 upper;
  upper.index.assign(columns.data(), columns.data() + columns.size());
  upper.start.assign(starts.data(), starts.data() + starts.size());
  const auto make = d == 9 ? target->make_factor9 : target->make_factor6;
  return without_gil([&] { return make(upper); });
}

RelativePoseFactors* make_relative_poses(const py::object& factors, const Ints& column, const Ints& pair) {
  const Ints keyframes = array_of<std::int64_t>(factors, "keyframes");
  const Doubles rotation = array_of<double>(factors, "rotation"),
                translation = array_of<double>(factors, "translation"),
                root_information = array_of<double>(factors, "root_information");
  Doubles lever_arm;
  RelativePosesView view;
  if (py::hasattr(factors, "lever_arm")) {
    lever_arm = array_of<double>(factors, "lever_arm");
    view.lever_arm = lever_arm.data();
  }
  view.n = pair.size();
  view.n_keyframes = column.size();
  view.keyframes = keyframes.data();
  view.column = column.data();
  view.pair = pair.data();
  view.rotation = rotation.data();
  view.translation = translation.data();
  view.root_information = root_information.data();
  view.loss = loss_named(factors.attr("loss").cast<std::string>());
  view.loss_scale = factors.attr("loss_scale").cast<double>();
  return target->make_relative_poses(view);
}

void bind_relative_poses(py::module_& m) {
  py::class_<RelativePoseFactors>(m, "RelativePoses")
      .def(py::init(&make_relative_poses))
      .def("value",
           [](const RelativePoseFactors& f, const py::object& state) { return f.value(StateArrays(state).view()); })
      // Adds to gradient, diagonal and pairs.
      .def("linearise", [](const RelativePoseFactors& f, const py::object& state, OutDoubles gradient,
                           OutDoubles diagonal, OutDoubles pairs) {
        return f.linearise(StateArrays(state).view(),
                           {gradient.mutable_data(), diagonal.mutable_data(), pairs.mutable_data()});
      });
}

void bind_sparse_factor(py::module_& m) {
  py::class_<SparseFactor>(m, "SparseFactor")
      .def(py::init(&make_factor))
      .def("solve", [](SparseFactor& f, const Doubles& blocks, OutDoubles x) {
        const double* from = blocks.data();
        double* out = x.mutable_data();
        return without_gil([&] { return f.solve(from, out); });
      });
}

}  // namespace

}  // namespace ba

PYBIND11_MODULE(_kernels, m) {
  ba::Slabs::shared().warm();
  ba::empty({0});  // has pybind11 find what it needs of numpy, which the first solve would wait for
  m.doc() = "Kernels of bundle adjustment in C++; see ba_node/core/kernels.py.";
  pybind11::class_<ba::Kernel> kernel(m, "Kernel");
  kernel.def(pybind11::init(&ba::make_kernel));
  ba::bind_assembly(kernel);
  ba::bind_reduced_system(kernel);
  ba::bind_sparse_factor(m);
  ba::bind_relative_poses(m);
  ba::bind_window(m);
  ba::bind_patches(m);
  ba::bind_bal(m);
  m.def("targets", &ba::target_names);
  m.def("target", [] { return ba::target->name; });
  m.def("use_target", &ba::use_target);
  m.def("allocations", [] { return ba::allocations.load(); });
  m.def("residual_norms", &ba::residual_norms);
  m.def("resect", &ba::resect);
  m.def("triangulate", &ba::triangulate);
  m.def("agreeing", &ba::agreeing);
  m.def("consensus", &ba::consensus);
}
