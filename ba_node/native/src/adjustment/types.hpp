// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What callers hand to the kernels and get back: plain data, the same for every target.
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "linalg/types.hpp"

namespace ba {

constexpr int kParams = 12;  // of a camera, as in core/cameras.py

// Arrays of the caller; see core/problem.py for shapes. They outlive nothing: copied where kept.
struct ProblemView {
  std::int64_t n_keyframes = 0, n_points = 0, n_obs = 0, n_cameras = 0;
  const std::int64_t *keyframe = nullptr, *camera = nullptr, *point = nullptr;
  const double *uv = nullptr, *sigma = nullptr;
  const double *depth = nullptr, *depth_sigma = nullptr;  // depth null if there is none
  const double *camera_rotation = nullptr, *camera_translation = nullptr, *params = nullptr;
  const std::uint8_t* model = nullptr;
  const bool* fixed = nullptr;
};

struct StateView {
  const double *rotation, *translation, *points, *intrinsics;  // intrinsics null if the cameras' own are used
};

// Where a state is written: as StateView.
struct StateSpan {
  double *rotation, *translation, *points, *intrinsics;
};

enum class Loss : std::uint8_t { kSquared, kHuber, kCauchy };
enum class Cheirality : std::uint8_t { kKeep, kConstant, kDrop };

struct CostModel {
  Loss loss = Loss::kSquared;
  double scale = 1.0;
  Cheirality cheirality = Cheirality::kKeep;
  double least_promise = 1e-8;  // share of its cost below which a point takes no step of its own
};

// As in core/resection.py.
struct ResectionLimits {
  std::int64_t least, iterations;
  double least_gain, damping;
};

// Pairs (i, j > i) of free keyframes, sorted, that factors couple.
struct CoupledPairs {
  std::vector<std::int32_t> row, column;

  std::size_t size() const { return row.size(); }
};

// Objectives at the start and at the end of inner iterations.
struct Objectives {
  double before = 0, after = 0;
};

// What a step did: by what the model said the objective would fall, and the objective before and after inner
// iterations.
struct StepResult {
  double predicted = 0;
  double damping = 0;  // 1/2 p' D p
  Objectives objective{std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::quiet_NaN()};
};

// Views as rays: n_rays rows, in any order.
struct RaysView {
  std::int64_t n_rays;
  const std::int64_t* point;
  const double* centre;      // (n_rays, 3) m
  const double* direction;   // (n_rays, 3) unit vectors
  const double* px_per_rad;  // focal length over sigma
  const double* distance;    // m, NaN where none was measured
  const double* distance_sigma;
};

// Factors on relative poses. Arrays of the caller: n x 2 keyframes, n x 9 rotation and n x 3 translation of j in i,
// n x 36 W; column: of each keyframe among the free ones, -1 if fixed; pair: n, of each factor, -1 if one end is fixed.
// i is -1 where it is the world; lever_arm: n x 3 of the point of body j whose place is meant, null for its origin.
struct RelativePosesView {
  std::int64_t n = 0, n_keyframes = 0;
  const std::int64_t *keyframes = nullptr, *column = nullptr, *pair = nullptr;
  const double *rotation = nullptr, *translation = nullptr, *root_information = nullptr, *lever_arm = nullptr;
  Loss loss = Loss::kSquared;
  double loss_scale = 1.0;
};

// Sums that the factors are added to: n_free x 6, n_free x 36, n_pairs x 36.
struct FactorSums {
  double *gradient, *diagonal, *pairs;
};

}  // namespace ba
