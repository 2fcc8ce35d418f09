// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Projection of eight observations at once, with derivatives; the formulas are those of core/cameras.py.
#pragma once

#include <cmath>
#include <cstdint>

#include "adjustment/layout.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

// As in core/cameras.py: nearest depth, m; cosine of the largest angle to the axis of an equidistant camera.
constexpr double kMinDepth = 1e-6, kLeastCosine = -0.8660254037844387;

// Parameters of the cameras of eight observations, as far as the lens needs them.
struct Cameras {
  V8 param[kParams];
  V8 fisheye;  // 1 for an equidistant lane
};

struct Projected {
  V8 uv[2];
  V8 d_x[2][3];           // d uv / d x
  V8 d_intrinsics[2][3];  // d uv / d (f, k1, k2)
};

// How a ray (a, b) is bent: by the factor g, its derivative by s = a^2 + b^2, what multiplies s and s^2 in
// d g / d (k1, k2), and two tangential terms.
struct Bend {
  V8 g, dg, k1, k2, p1, p2;
};

template <Lens kLens>
[[gnu::always_inline]] inline Bend bend(const Cameras& c, V8 s) {
  const V8 k1 = c.param[4], k2 = c.param[5];
  Bend out{};
  if constexpr (kLens == Lens::kRadial) {
    out.g = 1 + s * (k1 + s * k2);
    out.dg = k1 + 2 * s * k2;
    out.k1 = s;
    out.k2 = s * s;
  } else {
    const V8 k3 = c.param[8], k4 = c.param[9], k5 = c.param[10], k6 = c.param[11];
    const V8 over = 1.0 / (1 + s * (k4 + s * (k5 + s * k6)));
    out.g = (1 + s * (k1 + s * (k2 + s * k3))) * over;
    out.dg = (k1 + s * (2 * k2 + 3 * s * k3) - out.g * (k4 + s * (2 * k5 + 3 * s * k6))) * over;
    out.k1 = s * over;
    out.k2 = s * out.k1;
    out.p1 = c.param[6];
    out.p2 = c.param[7];
  }
  return out;
}

// The lanes of equidistant cameras: the angle to the axis itself, so that points behind the image plane are seen too.
template <bool kDerivatives>
inline void project_fisheye(const V8 (&x)[3], const Cameras& c, Projected& out) {
  for (int l = 0; l < kLanes; ++l) {
    if (c.fisheye[l] == 0.0) continue;
    const double X = x[0][l], Y = x[1][l], Z = x[2][l], fx = c.param[0][l], fy = c.param[1][l];
    const double k1 = c.param[4][l], k2 = c.param[5][l], k3 = c.param[6][l], k4 = c.param[7][l];
    const double flat2 = X * X + Y * Y, over = 1.0 / (flat2 + Z * Z);
    double g, bend, slope = 1.0, by_k1, by_k2 = 0.0;
    if (flat2 < 1e-12 * Z * Z) {
      const double z3 = Z * Z * Z;
      g = 1.0 / Z;
      bend = 2.0 * (k1 - 1.0 / 3.0) / z3;
      by_k1 = flat2 / z3;
    } else {
      const double flat = std::sqrt(flat2), th = std::atan2(flat, Z), t2 = th * th;
      g = th * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / flat;
      slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + 9 * t2 * k4)));
      bend = (slope * Z * over - g) / flat2;
      by_k1 = th * t2 / flat;
      by_k2 = by_k1 * t2;
    }
    out.uv[0][l] = fx * g * X + c.param[2][l];
    out.uv[1][l] = fy * g * Y + c.param[3][l];
    if constexpr (kDerivatives) {
      out.d_x[0][0][l] = fx * (g + bend * X * X);
      out.d_x[0][1][l] = fx * bend * X * Y;
      out.d_x[0][2][l] = -fx * slope * over * X;
      out.d_x[1][0][l] = fy * bend * X * Y;
      out.d_x[1][1][l] = fy * (g + bend * Y * Y);
      out.d_x[1][2][l] = -fy * slope * over * Y;
      out.d_intrinsics[0][0][l] = g * X;
      out.d_intrinsics[0][1][l] = fx * by_k1 * X;
      out.d_intrinsics[0][2][l] = fx * by_k2 * X;
      out.d_intrinsics[1][0][l] = g * Y;
      out.d_intrinsics[1][1][l] = fy * by_k1 * Y;
      out.d_intrinsics[1][2][l] = fy * by_k2 * Y;
    }
  }
}

// Which lanes no camera of their model can see, cameras.behind of core/cameras.py; with keep, as far as a number is
// left.
template <Lens kLens>
[[gnu::always_inline]] inline Mask behind(const V8 (&x)[3], const Cameras& c, bool keep) {
  const Mask plane = keep ? magnitude(x[2]) < kMinDepth * 1e-6 : x[2] <= kMinDepth;
  if constexpr (kLens != Lens::kMixed) return plane;
  const V8 distance = root(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
  const Mask beyond = (x[2] <= kLeastCosine * distance) | (distance <= kMinDepth);
  const Mask fisheye = c.fisheye != 0.0;
  return (fisheye & beyond) | (~fisheye & plane);
}

inline bool is_behind(const double (&x)[3], bool fisheye) {
  if (!fisheye) return x[2] <= kMinDepth;
  const double distance = std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
  return x[2] <= kLeastCosine * distance || distance <= kMinDepth;
}

template <Lens kLens, bool kDerivatives>
[[gnu::always_inline]] inline void project(const V8 (&x)[3], const Cameras& c, Projected& out) {
  const V8 iz = 1.0 / x[2];
  const V8 a = x[0] * iz, b = x[1] * iz;
  const V8 fx = c.param[0], fy = c.param[1];
  V8 da = a, db = b;                                    // distorted ray
  V8 jaa = splat(1.0), jab{}, jba{}, jbb = splat(1.0);  // its derivative by (a, b)
  Bend n{};
  if constexpr (kLens != Lens::kPinhole) {
    const V8 s = a * a + b * b;
    n = bend<kLens>(c, s);
    da = a * n.g;
    db = b * n.g;
    jaa = n.g + 2 * n.dg * a * a;
    jab = jba = 2 * n.dg * a * b;
    jbb = n.g + 2 * n.dg * b * b;
    if constexpr (kLens != Lens::kRadial) {
      da += 2 * n.p1 * a * b + n.p2 * (s + 2 * a * a);
      db += n.p1 * (s + 2 * b * b) + 2 * n.p2 * a * b;
      const V8 cross = 2 * (n.p1 * a + n.p2 * b);
      jaa += 2 * n.p1 * b + 6 * n.p2 * a;
      jab += cross;
      jba += cross;
      jbb += 6 * n.p1 * b + 2 * n.p2 * a;
    }
  }
  out.uv[0] = fx * da + c.param[2];
  out.uv[1] = fy * db + c.param[3];
  if constexpr (kDerivatives) {
    const V8 sx = fx * iz, sy = fy * iz;
    if constexpr (kLens == Lens::kPinhole) {
      out.d_x[0][0] = sx;
      out.d_x[0][2] = -sx * a;
      out.d_x[1][1] = sy;
      out.d_x[1][2] = -sy * b;
      return;
    }
    out.d_x[0][0] = sx * jaa;
    out.d_x[0][1] = sx * jab;
    out.d_x[0][2] = -sx * (jaa * a + jab * b);
    out.d_x[1][0] = sy * jba;
    out.d_x[1][1] = sy * jbb;
    out.d_x[1][2] = -sy * (jba * a + jbb * b);
    out.d_intrinsics[0][0] = da;
    out.d_intrinsics[0][1] = fx * n.k1 * a;
    out.d_intrinsics[0][2] = fx * n.k2 * a;
    out.d_intrinsics[1][0] = db;
    out.d_intrinsics[1][1] = fy * n.k1 * b;
    out.d_intrinsics[1][2] = fy * n.k2 * b;
  }
  if constexpr (kLens == Lens::kMixed) project_fisheye<kDerivatives>(x, c, out);
}

}  // namespace ba::BA_TARGET
