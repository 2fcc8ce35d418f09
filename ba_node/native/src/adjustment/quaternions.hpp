// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Rotations and quaternions x y z w, as core/geometry.py has them, to the same bits.
#pragma once

#include <algorithm>
#include <cmath>

namespace ba {

inline double length4(const double* q) { return std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]); }

// r: row by row.
inline void quaternion_of(const double* r, double* out) {
  const double xx = r[0], yy = r[4], zz = r[8];
  const double a = r[7] - r[5], b = r[2] - r[6], c = r[3] - r[1];
  const double squares[4] = {1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz};
  const double d = r[3] + r[1], e = r[2] + r[6], f = r[7] + r[5];
  const double rows[4][4] = {
      {squares[0], d, e, a}, {d, squares[1], f, b}, {e, f, squares[2], c}, {a, b, c, squares[3]}};
  const double* q = rows[std::max_element(squares, squares + 4) - squares];
  const double length = length4(q);
  for (int i = 0; i < 4; ++i) out[i] = q[i] / length;
  if (out[3] < 0.0)
    for (int i = 0; i < 4; ++i) out[i] = -out[i];
}

inline void rotation_of(const double* quaternion, double* out) {
  const double length = length4(quaternion);
  const double x = quaternion[0] / length, y = quaternion[1] / length, z = quaternion[2] / length,
               w = quaternion[3] / length;
  const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - z * w),     2 * (x * z + y * w),
                       2 * (x * y + z * w),     1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                       2 * (x * z - y * w),     2 * (y * z + x * w),     1 - 2 * (x * x + y * y)};
  std::copy_n(r, 9, out);
}

}  // namespace ba
