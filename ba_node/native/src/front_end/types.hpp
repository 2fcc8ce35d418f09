// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What the kernels of the front-end are given and where they put what they find.
#pragma once

#include <cstdint>

namespace ba {

// Grey values (height, width).
struct ImageView {
  const float* at;
  std::int64_t height, width;
};

// As patches.Templates, with the inverse of its Hessian; pixels are those that are compared, values in each of n.
struct TemplatesView {
  std::int64_t n, movements, pixels;
  const float *weighted, *std, *jacobian;
  const double* inverse;
  const float *grid, *window;
};

// Where templates are: (n, 2) px, (n, 2, 2), and how they look there.
struct PlacesSpan {
  double *place, *affine, *correlation, *left;
};

struct AlignLimits {
  int iterations;
  double step_px, farthest_px;
};

// Points and where a camera sees them, as pose.Seen: (n, 3), (n, 3), (n, 2), (n,); the camera is (focal, u, v), px.
struct SeenView {
  std::int64_t n;
  const double *points, *along, *uv, *sigma, *camera;
};

// Normal equations of a pose, (6, 6) and (6,), and each point's error in sigmas, (n,).
struct PoseEquationsSpan {
  double *matrix, *vector, *size;
};

}  // namespace ba
