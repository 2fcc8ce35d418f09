// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The kernels as a whole, through the table of their target.
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "check.hpp"
#include "matrices.hpp"
#include "targets/target.hpp"

using namespace ba;

namespace {

// Keyframes along a line, the first fixed, of which so many in a row observe each point, 4 to 8 m ahead; noise of a
// pixel, start off.
struct Scene {
  static constexpr std::int64_t kKeyframes = 6, kPoints = 150;

  explicit Scene(std::int64_t track = kKeyframes) {
    matrices::Numbers numbers(1);
    for (std::int64_t k = 0; k < kKeyframes; ++k) {
      for (int i = 0; i < 9; ++i) rotation.push_back(i % 4 == 0 ? 1.0 : 0.0);
      for (int i = 0; i < 3; ++i) translation.push_back((i == 0 ? -0.3 * static_cast<double>(k) : 0.0));
      fixed.push_back(k == 0);
    }
    for (std::int64_t p = 0; p < kPoints; ++p) {
      const double x[3] = {2 * numbers.next(), 2 * numbers.next(), 6 + 2 * numbers.next()};
      const std::int64_t first = p * (kKeyframes - track + 1) / kPoints;
      for (std::int64_t k = first; k < first + track; ++k) {
        keyframe.push_back(k);
        camera.push_back(0);
        point.push_back(p);
        uv.push_back(400 * (x[0] + translation[3 * k]) / x[2] + 320 + numbers.next());
        uv.push_back(400 * x[1] / x[2] + 240 + numbers.next());
        sigma.push_back(1.0);
      }
      for (double each : x) points.push_back(each + 0.05 * numbers.next());
    }
    for (std::int64_t i = 3; i < 3 * kKeyframes; ++i) translation[i] += 0.01 * numbers.next();
  }

  StateView state() const { return {rotation.data(), translation.data(), points.data(), nullptr}; }

  std::unique_ptr<Kernel> kernel(int threads) const {
    KernelArguments arguments;
    ProblemView& p = arguments.problem;
    p.n_keyframes = kKeyframes;
    p.n_points = kPoints;
    p.n_obs = static_cast<std::int64_t>(keyframe.size());
    p.n_cameras = 1;
    p.keyframe = keyframe.data();
    p.camera = camera.data();
    p.point = point.data();
    p.uv = uv.data();
    p.sigma = sigma.data();
    p.camera_rotation = rotation.data();  // that of the first keyframe is I
    p.camera_translation = zero;
    p.params = params;
    p.model = &model;
    p.fixed = reinterpret_cast<const bool*>(fixed.data());
    arguments.cost.loss = Loss::kHuber;
    arguments.cost.scale = 1.5;
    arguments.start = state();
    arguments.threads = threads;
    return std::unique_ptr<Kernel>(BA_TARGET::kTarget.make_kernel6(std::move(arguments)));
  }

  std::vector<double> rotation, translation, points, uv, sigma;
  std::vector<std::int64_t> keyframe, camera, point;
  std::vector<std::uint8_t> fixed;
  double zero[3] = {}, params[kParams] = {400, 400, 320, 240};
  std::uint8_t model = 0;
};

struct Stepped {
  double start = 0;
  StepResult result;
  std::vector<double> x, rotation, translation, points;
};

Stepped step(const Scene& scene, int threads) {
  const std::unique_ptr<Kernel> kernel = scene.kernel(threads);
  Stepped out;
  out.start = kernel->linearise(scene.state());
  kernel->damp(true, 1e-4);
  out.x.resize(kernel->n_free() * 6);
  CHECK(kernel->solve(out.x.data()));
  out.rotation = scene.rotation;
  out.translation = scene.translation;
  out.points = scene.points;
  out.result = kernel->step(scene.state(), out.x.data(), 2,
                            {out.rotation.data(), out.translation.data(), out.points.data(), nullptr});
  return out;
}

}  // namespace

TEST(a_step_lowers_the_objective_as_predicted) {
  const Scene scene;
  const Stepped out = step(scene, 1);
  CHECK(out.start > 1000);
  CHECK(out.result.objective.before < 0.5 * out.start);
  CHECK(out.result.objective.after <= out.result.objective.before);
  CHECK(out.result.predicted > 0.5 * (out.start - out.result.objective.before));
}

TEST(any_number_of_threads_gives_the_same_bits) {
  const Scene scene;
  const Stepped one = step(scene, 1);
  for (const int threads : {2, 3}) {
    const Stepped other = step(scene, threads);
    CHECK_NEAR(other.result.objective.after, one.result.objective.after, 0);
    CHECK_NEAR(matrices::distance(other.points, one.points), 0, 0);
    CHECK_NEAR(matrices::distance(other.translation, one.translation), 0, 0);
  }
}

namespace {

void check_linear_solvers(const Scene& scene) {
  const std::unique_ptr<Kernel> kernel = scene.kernel(2);
  kernel->linearise(scene.state());
  kernel->damp(true, 1e-2);
  const std::int64_t n = kernel->n_free() * 6;
  std::vector<double> dense(n), sparse(n), iterated(n), product(n), rhs(n);
  const std::vector<double> scale(n, 1.0);
  CHECK(kernel->solve(dense.data()));
  CHECK(kernel->analyse({1 << 20, 1e12}).complete);
  CHECK(kernel->solve_sparse(sparse.data()));
  CHECK_NEAR(matrices::distance(sparse, dense), 0, 1e-10);
  for (const bool formed : {false, true}) {
    const PcgLimits limits{1e-13, 1000, std::numeric_limits<double>::infinity(), 0};
    CHECK(kernel->pcg(scale.data(), Preconditioner::kSchurBlock, limits, formed, iterated.data()).found);
    CHECK_NEAR(matrices::distance(iterated, dense), 0, 1e-8);
  }
  kernel->product(dense.data(), product.data());
  kernel->rhs(rhs.data());
  double largest = 0;
  for (double value : rhs) largest = std::max(largest, std::abs(value));
  CHECK_NEAR(matrices::distance(product, rhs) / largest, 0, 1e-10);
}

}  // namespace

TEST(all_linear_solvers_agree) { check_linear_solvers(Scene()); }

TEST(all_linear_solvers_agree_on_tracks) { check_linear_solvers(Scene(3)); }
