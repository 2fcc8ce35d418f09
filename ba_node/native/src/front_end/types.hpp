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

// Patches (n, height, width) as patches.cut gives them: whole ones for 2 movements, of rows for 3, with a prior of each
// on the diagonal of the Hessian. pixels are those that are compared, at grid (pixels, 2) around the centre.
struct PatchesView {
  std::int64_t n, height, width, movements, pixels;
  const float *at, *grid, *window;
  const double* prior;
};

// Where patches are: (n, 2) px, (n, 2, 2), how they look there, and the inverse of the Hessian, (n, k, k).
struct PlacesSpan {
  double *place, *affine, *correlation, *left, *inverse;
};

struct AlignLimits {
  int iterations;
  double step_px, farthest_px;
  float least_variance;
  double least_hessian;
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
