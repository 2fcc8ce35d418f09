// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Normal equations of a camera's pose. front_end/pose.py has the equations, and is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "front_end/types.hpp"
#include "simd/target.hpp"

namespace ba::BA_TARGET {

// rotation (3, 3) and translation (3,): camera from map. cauchy: errors of so many sigmas count for a half.
inline void pose_equations(const SeenView& seen, const double* rotation, const double* translation, double cauchy,
                           const PoseEquationsSpan& to) {
  const double f = seen.camera[0], centre_u = seen.camera[1], centre_v = seen.camera[2];
  const double* R = rotation;
  double H[6][6] = {}, b[6] = {};
  for (std::int64_t i = 0; i < seen.n; ++i) {
    const double *X = seen.points + 3 * i, *m = seen.along + 3 * i;
    const double x = R[0] * X[0] + R[1] * X[1] + R[2] * X[2] + translation[0];
    const double y = R[3] * X[0] + R[4] * X[1] + R[5] * X[2] + translation[1];
    const double depth = R[6] * X[0] + R[7] * X[1] + R[8] * X[2] + translation[2];
    const double mx = R[0] * m[0] + R[1] * m[1] + R[2] * m[2];
    const double my = R[3] * m[0] + R[4] * m[1] + R[5] * m[2];
    const double mz = R[6] * m[0] + R[7] * m[1] + R[8] * m[2];
    const double z = std::max(depth, 1e-3), a = f / z, u = x / z, v = y / z, d = depth / z, s = seen.sigma[i];
    const double smear_u = a * (mx - u * mz), smear_v = a * (my - v * mz);
    const double m2 = smear_u * smear_u + smear_v * smear_v;
    const double k = m2 > 0.0 ? (1.0 - 1.0 / std::sqrt(1.0 + m2 / (s * s))) / std::max(m2, 1e-300) / s : 0.0;
    const double uu = 1.0 / s - k * smear_u * smear_u, uv = -k * smear_u * smear_v;
    const double vv = 1.0 / s - k * smear_v * smear_v;
    const double off_u = seen.uv[2 * i] - (f * u + centre_u), off_v = seen.uv[2 * i + 1] - (f * v + centre_v);
    const double error_u = uu * off_u + uv * off_v, error_v = uv * off_u + vv * off_v;
    const double by_u[6] = {-f * u * v, f * (d + u * u), -f * v, a, 0.0, -a * u};
    const double by_v[6] = {-f * (d + v * v), f * u * v, f * u, 0.0, a, -a * v};
    const double squared = error_u * error_u + error_v * error_v;
    const double weight = 1.0 / (1.0 + squared / (cauchy * cauchy));
    to.size[i] = std::sqrt(squared);
    double J[2][6];
    for (int c = 0; c < 6; ++c) {
      J[0][c] = uu * by_u[c] + uv * by_v[c];
      J[1][c] = uv * by_u[c] + vv * by_v[c];
    }
    for (int r = 0; r < 6; ++r) {
      const double wu = weight * J[0][r], wv = weight * J[1][r];
      b[r] += wu * error_u + wv * error_v;
      for (int c = 0; c < 6; ++c) H[r][c] += wu * J[0][c] + wv * J[1][c];
    }
  }
  std::copy_n(&H[0][0], 36, to.matrix);
  std::copy_n(b, 6, to.vector);
}

}  // namespace ba::BA_TARGET
