// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Poses after a step, R <- R Exp(dphi), t <- t + R dt (4.1-4.19); core/parameterisation.py is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "adjustment/layout.hpp"

namespace ba::BA_TARGET {

// The rotation of a rotation vector, by Rodrigues' formula, row by row.
inline void so3_exp(const double* phi, double* out) {
  const double x = phi[0], y = phi[1], z = phi[2], angle2 = x * x + y * y + z * z, angle = std::sqrt(angle2);
  // Below this angle (rad) the series is exact to the last digit.
  const bool small = angle < 1e-4;
  const double half = std::sin(0.5 * angle);
  const double a = small ? 1.0 - angle2 / 6.0 : std::sin(angle) / angle;
  const double b = small ? 0.5 - angle2 / 24.0 : 2.0 * half * half / angle2;
  const double full[9] = {1.0 - b * (y * y + z * z), b * x * y - a * z,         b * x * z + a * y,
                          b * x * y + a * z,         1.0 - b * (x * x + z * z), b * y * z - a * x,
                          b * x * z - a * y,         b * y * z + a * x,         1.0 - b * (x * x + y * y)};
  std::copy_n(full, 9, out);
}

// All poses, and intrinsics where they are free, after a step (n_free x size) of the free ones.
inline void retract_keyframes(const Layout& l, const StateView& from, const double* step, int size,
                              const StateSpan& to) {
  std::copy_n(from.rotation, 9 * l.n_keyframes, to.rotation);
  std::copy_n(from.translation, 3 * l.n_keyframes, to.translation);
  if (l.own_intrinsics) std::copy_n(from.intrinsics, 3 * l.n_keyframes, to.intrinsics);
  for (std::int64_t i = 0; i < l.n_free; ++i) {
    const std::int64_t k = l.free_keyframe[i];
    const double *p = step + size * i, *r = from.rotation + 9 * k;
    double turn[9];
    so3_exp(p, turn);
    for (int row = 0; row < 3; ++row) {
      const double* a = r + 3 * row;
      for (int c = 0; c < 3; ++c)
        to.rotation[9 * k + 3 * row + c] = a[0] * turn[c] + a[1] * turn[3 + c] + a[2] * turn[6 + c];
      to.translation[3 * k + row] += a[0] * p[3] + a[1] * p[4] + a[2] * p[5];
    }
    if (l.own_intrinsics)
      for (int j = 0; j < 3; ++j) to.intrinsics[3 * k + j] += p[6 + j];
  }
}

inline bool all_finite(const double* first, std::int64_t count) {
  return std::all_of(first, first + count, [](double x) { return std::isfinite(x); });
}

}  // namespace ba::BA_TARGET
