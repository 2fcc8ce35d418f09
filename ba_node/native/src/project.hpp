// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Projection of eight observations at once, with derivatives; the formulas are those of core/cameras.py.
#pragma once

#include <cmath>
#include <cstdint>

#include "simd.hpp"

namespace ba {

constexpr int kLanes = 8;
constexpr int kParams = 12;

// What a whole problem needs; a lane with less distortion has zeros in the rest.
enum class Lens : std::uint8_t { kPinhole, kRadial, kRational, kMixed };

struct Lanes {
  alignas(64) double x[3][kLanes];         // point in the camera frame, m
  alignas(64) double param[kParams][kLanes];
  alignas(64) double fisheye[kLanes];      // 1 for an equidistant lane
};

struct Projected {
  alignas(64) double uv[2][kLanes];
  alignas(64) double d_x[2][3][kLanes];    // d uv / d x
  alignas(64) double d_intrinsics[2][3][kLanes];  // d uv / d (f, k1, k2)
};

// Factor g of the ray, its derivative by s = a^2 + b^2, and what multiplies s and s^2 in d g / d (k1, k2).
struct Factor {
  double g, dg, k1, k2;
};

inline Factor equidistant_factor(double s, const double* k, int stride) {
  const double k1 = k[0], k2 = k[stride], k3 = k[2 * stride], k4 = k[3 * stride];
  if (s < 1e-12) return {1.0, k1 - 1.0 / 3.0, s, s * s};
  const double r = std::sqrt(s), th = std::atan(r), t2 = th * th;
  const double g = th * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
  const double slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + 9 * t2 * k4)));
  const double f = th * t2 / r;
  return {g, (slope / (1 + s) - g) / (2 * s), f, f * t2};
}

template <Lens kLens, bool kDerivatives>
inline void project(const Lanes& in, Projected& out) {
  for (int l = 0; l < kLanes; ++l) {
    const double iz = 1.0 / in.x[2][l];
    const double a = in.x[0][l] * iz, b = in.x[1][l] * iz;
    const double fx = in.param[0][l], fy = in.param[1][l];
    double da = a, db = b;                        // distorted ray
    double jaa = 1, jab = 0, jba = 0, jbb = 1;    // its derivative by (a, b)
    double ka1 = 0, ka2 = 0;                      // d g / d k1, d g / d k2
    if constexpr (kLens != Lens::kPinhole) {
      const double s = a * a + b * b;
      const double k1 = in.param[4][l], k2 = in.param[5][l];
      double g, dg;
      if constexpr (kLens == Lens::kRadial) {
        g = 1 + s * (k1 + s * k2);
        dg = k1 + 2 * s * k2;
        ka1 = s;
        ka2 = s * s;
      } else {
        const double k3 = in.param[8][l], k4 = in.param[9][l], k5 = in.param[10][l], k6 = in.param[11][l];
        const double over = 1.0 / (1 + s * (k4 + s * (k5 + s * k6)));
        g = (1 + s * (k1 + s * (k2 + s * k3))) * over;
        dg = (k1 + s * (2 * k2 + 3 * s * k3) - g * (k4 + s * (2 * k5 + 3 * s * k6))) * over;
        ka1 = s * over;
        ka2 = s * ka1;
      }
      double p1 = 0, p2 = 0;
      if constexpr (kLens == Lens::kRational || kLens == Lens::kMixed) {
        p1 = in.param[6][l];
        p2 = in.param[7][l];
      }
      if constexpr (kLens == Lens::kMixed) {
        if (in.fisheye[l] != 0.0) {
          const Factor f = equidistant_factor(s, &in.param[4][l], kLanes);
          g = f.g;
          dg = f.dg;
          ka1 = f.k1;
          ka2 = f.k2;
          p1 = p2 = 0;
        }
      }
      da = a * g;
      db = b * g;
      jaa = g + 2 * dg * a * a;
      jab = jba = 2 * dg * a * b;
      jbb = g + 2 * dg * b * b;
      if constexpr (kLens == Lens::kRational || kLens == Lens::kMixed) {
        da += 2 * p1 * a * b + p2 * (s + 2 * a * a);
        db += p1 * (s + 2 * b * b) + 2 * p2 * a * b;
        const double cross = 2 * (p1 * a + p2 * b);
        jaa += 2 * p1 * b + 6 * p2 * a;
        jab += cross;
        jba += cross;
        jbb += 6 * p1 * b + 2 * p2 * a;
      }
    }
    out.uv[0][l] = fx * da + in.param[2][l];
    out.uv[1][l] = fy * db + in.param[3][l];
    if constexpr (kDerivatives) {
      const double sx = fx * iz, sy = fy * iz;
      out.d_x[0][0][l] = sx * jaa;
      out.d_x[0][1][l] = sx * jab;
      out.d_x[0][2][l] = -sx * (jaa * a + jab * b);
      out.d_x[1][0][l] = sy * jba;
      out.d_x[1][1][l] = sy * jbb;
      out.d_x[1][2][l] = -sy * (jba * a + jbb * b);
      out.d_intrinsics[0][0][l] = da;
      out.d_intrinsics[0][1][l] = fx * ka1 * a;
      out.d_intrinsics[0][2][l] = fx * ka2 * a;
      out.d_intrinsics[1][0][l] = db;
      out.d_intrinsics[1][1][l] = fy * ka1 * b;
      out.d_intrinsics[1][2][l] = fy * ka2 * b;
    }
  }
}

}  // namespace ba
