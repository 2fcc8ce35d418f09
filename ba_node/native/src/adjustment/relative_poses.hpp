// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Factors on relative poses of keyframes; the equations stand in core/factors.py, which is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "simd/target.hpp"
#include "targets/target.hpp"

namespace ba::BA_TARGET {

class RelativePoses final : public RelativePoseFactors {
 public:
  // The arrays are copied.
  explicit RelativePoses(const RelativePosesView& p)
      : keyframes_(p.keyframes, p.keyframes + 2 * p.n),
        column_(p.column, p.column + p.n_keyframes),
        pair_(p.pair, p.pair + p.n),
        rotation_(p.rotation, p.rotation + 9 * p.n),
        translation_(p.translation, p.translation + 3 * p.n),
        root_(p.root_information, p.root_information + 36 * p.n),
        lever_arm_(3 * p.n),
        loss_(p.loss),
        scale_(p.loss_scale) {
    if (p.lever_arm) std::copy_n(p.lever_arm, 3 * p.n, lever_arm_.begin());
  }

  double value(const StateView& s) const override {
    double total = 0;
    for (std::size_t f = 0; f < pair_.size(); ++f) {
      double e[6], r[6], weight;
      error(s, f, e);
      whiten(f, e, r);
      total += cost(r, weight);
    }
    return 0.5 * total;
  }

  double linearise(const StateView& s, const FactorSums& out) const override {
    double total = 0;
    for (std::size_t f = 0; f < pair_.size(); ++f) {
      double e[6], r[6], a[36], weight;
      error(s, f, e);
      whiten(f, e, r);
      jacobian(s, f, e, a);
      total += cost(r, weight);
      add(f, a, r, weight, out);
    }
    return 0.5 * total;
  }

 private:
  // Poses of both ends; the point l of body j has the place of the origin of a body at t_j - l.
  struct Ends {
    const double *ri, *ti, *rj;
    double tj[3];
  };

  Ends ends(const StateView& s, std::size_t f) const {
    static constexpr double kUnit[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, kZero[3] = {0, 0, 0};
    const std::int64_t i = keyframes_[2 * f], j = keyframes_[2 * f + 1];
    const double *t = s.translation + 3 * j, *l = &lever_arm_[3 * f];
    return {i < 0 ? kUnit : s.rotation + 9 * i,
            i < 0 ? kZero : s.translation + 3 * i,
            s.rotation + 9 * j,
            {t[0] - l[0], t[1] - l[1], t[2] - l[2]}};
  }

  void error(const StateView& s, std::size_t f, double* e) const {
    const Ends at = ends(s, f);
    const double *ri = at.ri, *rj = at.rj, *ti = at.ti, *tj = at.tj;
    const double *rm = &rotation_[9 * f], *tm = &translation_[3 * f];
    double ij[9], turned[9];
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c)
        ij[3 * r + c] = ri[3 * r] * rj[3 * c] + ri[3 * r + 1] * rj[3 * c + 1] + ri[3 * r + 2] * rj[3 * c + 2];
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) turned[3 * r + c] = rm[r] * ij[c] + rm[3 + r] * ij[3 + c] + rm[6 + r] * ij[6 + c];
    log(turned, e);
    for (int r = 0; r < 3; ++r)
      e[3 + r] = ti[r] - (ij[3 * r] * tj[0] + ij[3 * r + 1] * tj[1] + ij[3 * r + 2] * tj[2]) - tm[r];
  }

  // W A, row by row: the derivative by the step of i; that by the step of j is its negative.
  void jacobian(const StateView& s, std::size_t f, const double* e, double* out) const {
    const Ends at = ends(s, f);
    const double *ri = at.ri, *rj = at.rj, *tj = at.tj;
    double inverse[9], turned[9], q[3], moved[9];
    inverse_right_jacobian(e, inverse);
    for (int r = 0; r < 3; ++r) q[r] = rj[r] * tj[0] + rj[3 + r] * tj[1] + rj[6 + r] * tj[2];
    for (int r = 0; r < 3; ++r) {
      const double *a = inverse + 3 * r, *b = ri + 3 * r;
      for (int c = 0; c < 3; ++c) turned[3 * r + c] = a[0] * rj[c] + a[1] * rj[3 + c] + a[2] * rj[6 + c];
      // R_i [q]x
      moved[3 * r] = b[1] * q[2] - b[2] * q[1];
      moved[3 * r + 1] = b[2] * q[0] - b[0] * q[2];
      moved[3 * r + 2] = b[0] * q[1] - b[1] * q[0];
    }
    const double* w = &root_[36 * f];
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 3; ++c) {
        double turn = 0, shift = 0;
        for (int k = 0; k < 3; ++k) {
          turn += w[6 * r + k] * turned[3 * k + c] + w[6 * r + 3 + k] * moved[3 * k + c];
          shift += w[6 * r + 3 + k] * ri[3 * k + c];
        }
        out[6 * r + c] = turn;
        out[6 * r + 3 + c] = shift;
      }
  }

  void whiten(std::size_t f, const double* e, double* r) const {
    const double* w = &root_[36 * f];
    for (int i = 0; i < 6; ++i) {
      r[i] = 0;
      for (int k = 0; k < 6; ++k) r[i] += w[6 * i + k] * e[k];
    }
  }

  // Psi, and the IRLS weight.
  double cost(const double* r, double& weight) const {
    double squared = 0;
    for (int i = 0; i < 6; ++i) squared += r[i] * r[i];
    weight = 1.0;
    if (loss_ == Loss::kSquared) return squared;
    if (loss_ == Loss::kHuber) {
      const double norm = std::sqrt(squared), near = std::min(norm, scale_);
      weight = scale_ / std::max(norm, scale_);
      return near * (2.0 * norm - near);
    }
    const double ratio = squared / (scale_ * scale_);
    weight = 1.0 / (1.0 + ratio);
    return scale_ * scale_ * std::log1p(ratio);
  }

  void add(std::size_t f, const double* a, const double* r, double weight, const FactorSums& out) const {
    double h[36], g[6];
    for (int i = 0; i < 6; ++i) {
      g[i] = 0;
      for (int k = 0; k < 6; ++k) g[i] += a[6 * k + i] * r[k];
      g[i] *= weight;
      for (int j = 0; j < 6; ++j) {
        double sum = 0;
        for (int k = 0; k < 6; ++k) sum += a[6 * k + i] * a[6 * k + j];
        h[6 * i + j] = weight * sum;
      }
    }
    for (int end = 0; end < 2; ++end) {
      const std::int64_t of = keyframes_[2 * f + end], k = of < 0 ? -1 : column_[of];
      if (k < 0) continue;
      for (int i = 0; i < 6; ++i) out.gradient[6 * k + i] += end ? -g[i] : g[i];
      for (int i = 0; i < 36; ++i) out.diagonal[36 * k + i] += h[i];
    }
    // Symmetric: alike for both orders of the pair.
    if (pair_[f] >= 0)
      for (int i = 0; i < 36; ++i) out.pairs[36 * pair_[f] + i] -= h[i];
  }

  // The rotation vector of a rotation, angle in [0, pi], through the quaternion with the largest divisor (Shepperd).
  static void log(const double* r, double* out) {
    const double xx = r[0], yy = r[4], zz = r[8];
    const double a = r[7] - r[5], b = r[2] - r[6], c = r[3] - r[1];
    const double d = r[3] + r[1], e = r[2] + r[6], f = r[7] + r[5];
    const double rows[4][4] = {{1 + xx - yy - zz, d, e, a},
                               {d, 1 - xx + yy - zz, f, b},
                               {e, f, 1 - xx - yy + zz, c},
                               {a, b, c, 1 + xx + yy + zz}};
    int best = 0;
    for (int i = 1; i < 4; ++i)
      if (rows[i][i] > rows[best][best]) best = i;
    double q[4], norm = 0;
    for (int i = 0; i < 4; ++i) norm += rows[best][i] * rows[best][i];
    norm = std::sqrt(norm);
    for (int i = 0; i < 4; ++i) q[i] = (rows[best][3] < 0 ? -1.0 : 1.0) * rows[best][i] / norm;
    const double sine = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]);
    const double small = sine / q[3];
    const double scale = sine < kSmall ? 2.0 / q[3] * (1.0 - small * small / 3.0) : 2.0 * std::atan2(sine, q[3]) / sine;
    for (int i = 0; i < 3; ++i) out[i] = scale * q[i];
  }

  // I + [phi]x / 2 + (1 - t/2 cot(t/2)) / t^2 [phi]x^2.
  static void inverse_right_jacobian(const double* phi, double* out) {
    const double x = phi[0], y = phi[1], z = phi[2], angle2 = x * x + y * y + z * z;
    double factor = 1.0 / 12.0 + angle2 / 720.0;
    if (angle2 >= kSmall * kSmall) {
      const double half = 0.5 * std::sqrt(angle2);
      factor = (1.0 - half * std::cos(half) / std::sin(half)) / angle2;
    }
    const double full[9] = {
        1.0 - factor * (y * y + z * z), factor * x * y - 0.5 * z,       factor * x * z + 0.5 * y,
        factor * x * y + 0.5 * z,       1.0 - factor * (x * x + z * z), factor * y * z - 0.5 * x,
        factor * x * z - 0.5 * y,       factor * y * z + 0.5 * x,       1.0 - factor * (x * x + y * y)};
    std::copy_n(full, 9, out);
  }

  static constexpr double kSmall = 1e-4;  // as in core/geometry.py

  std::vector<std::int64_t> keyframes_, column_, pair_;
  std::vector<double> rotation_, translation_, root_, lever_arm_;
  Loss loss_;
  double scale_;
};

}  // namespace ba::BA_TARGET
