// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Conjugate gradients on S in the scaled space x~ = D x, inside a region (Steihaug; Algorithms 1, 3 and 4).
// core/linear.py is this file's oracle and says when it stops; core/reduced.py says what the scaled space is.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "adjustment/types.hpp"
#include "linalg/blocks.hpp"
#include "parallel/memory.hpp"

namespace ba::BA_TARGET {

// M^-1 of diagonal blocks, or of the diagonal, scaled.
template <int D>
class DiagonalInverse {
 public:
  // blocks: n diagonal blocks, null for M = I; scale: 1/D, n x D; whole: the blocks, not their diagonals alone.
  void set(const Block<D>* blocks, std::int64_t n, const double* scale, bool whole) {
    is_identity_ = blocks == nullptr;
    whole_ = whole;
    inverse_.resize(is_identity_ ? 0 : n * D * (whole ? D : 1));
    for (std::int64_t k = 0; k < n && !is_identity_; ++k) {
      const double* s = scale + k * D;
      if (whole) {
        invert(blocks[k], s, &inverse_[k * D * D]);
      } else {
        for (int i = 0; i < D; ++i) inverse_[k * D + i] = reciprocal(entry(blocks[k], i, i) * s[i] * s[i]);
      }
    }
  }

  void apply(const Buffer<double>& r, Buffer<double>& z) const {
    if (is_identity_) {
      std::copy(r.begin(), r.end(), z.begin());
    } else if (!whole_) {
      for (std::size_t i = 0; i < r.size(); ++i) z[i] = inverse_[i] * r[i];
    } else {
      for (std::size_t k = 0; k * D < r.size(); ++k) {
        const double *m = &inverse_[k * D * D], *from = &r[k * D];
        double out[D] = {};
        for (int c = 0; c < D; ++c)
          for (int i = 0; i < D; ++i) out[i] += m[c * D + i] * from[c];
        std::copy_n(out, D, &z[k * D]);
      }
    }
  }

 private:
  static double reciprocal(double x) { return x > 0.0 ? 1.0 / x : 1.0; }

  // The inverse of a scaled block; of its diagonal if it is not positive definite.
  static void invert(const Block<D>& block, const double* s, double* out) {
    double l[D][D], k[D][D] = {};
    bool positive = true;
    for (int j = 0; j < D && positive; ++j) {
      for (int i = j; i < D; ++i) {
        double value = entry(block, i, j) * s[i] * s[j];
        for (int m = 0; m < j; ++m) value -= l[i][m] * l[j][m];
        if (i == j) positive = value > 0.0 && std::isfinite(value);
        l[i][j] = i == j ? std::sqrt(value) : value / l[j][j];
      }
    }
    std::fill_n(out, D * D, 0.0);
    if (!positive) {
      for (int i = 0; i < D; ++i) out[i * D + i] = reciprocal(entry(block, i, i) * s[i] * s[i]);
      return;
    }
    for (int j = 0; j < D; ++j) {  // k = L^-1
      k[j][j] = 1.0 / l[j][j];
      for (int i = j + 1; i < D; ++i) {
        double value = 0;
        for (int m = j; m < i; ++m) value -= l[i][m] * k[m][j];
        k[i][j] = value / l[i][i];
      }
    }
    for (int c = 0; c < D; ++c)
      for (int r = 0; r < D; ++r)
        for (int m = std::max(r, c); m < D; ++m) out[c * D + r] += k[m][r] * k[m][c];
  }

  bool is_identity_ = true, whole_ = false;
  Buffer<double> inverse_;
};

class Pcg {
 public:
  // Room for n unknowns.
  void resize(std::int64_t n) {
    for (Buffer<double>* v : {&x_, &r_, &z_, &d_, &ad_, &t_}) v->resize(n);
  }

  // Solve S x = rhs. product(in, out): S in; precondition(r, z): z = M^-1 r; scale: 1/D; x: out.
  template <class Product, class Precondition>
  PcgEnd solve(Product product, Precondition precondition, const double* rhs, const double* scale,
               const PcgLimits& limits, double* x) {
    const std::size_t n = x_.size();
    for (std::size_t i = 0; i < n; ++i) {
      x_[i] = 0.0;
      r_[i] = scale[i] * rhs[i];
    }
    const double norm_b = std::sqrt(dot(r_, r_));
    PcgEnd end = iterate(product, precondition, rhs, scale, limits, norm_b);
    for (std::size_t i = 0; i < n; ++i) x[i] = scale[i] * x_[i];
    return end;
  }

 private:
  static double dot(const Buffer<double>& a, const Buffer<double>& b) {
    double out = 0;
    for (std::size_t i = 0; i < a.size(); ++i) out += a[i] * b[i];
    return out;
  }

  template <class Product, class Precondition>
  PcgEnd iterate(Product product, Precondition precondition, const double* rhs, const double* scale,
                 const PcgLimits& limits, double norm_b) {
    if (norm_b == 0.0 || !std::isfinite(norm_b)) return {norm_b == 0.0, false, 0};
    const std::size_t n = x_.size();
    const double target = std::min(limits.t_eps, norm_b) * norm_b;
    precondition(r_, z_);
    d_ = z_;
    double rz = dot(r_, z_), gained = 0;
    for (std::int64_t j = 0; j < limits.max_iterations; ++j) {
      for (std::size_t i = 0; i < n; ++i) t_[i] = scale[i] * d_[i];
      product(t_.data(), ad_.data());
      for (std::size_t i = 0; i < n; ++i) ad_[i] *= scale[i];
      const double curvature = dot(d_, ad_);
      if (!std::isfinite(curvature) || !std::isfinite(rz)) return {j > 0, false, j};
      if (curvature <= 0.0) {
        if (std::isfinite(limits.radius)) to_boundary(limits.radius);
        return {true, true, j};
      }
      const double alpha = rz / curvature;
      for (std::size_t i = 0; i < n; ++i) t_[i] = x_[i] + alpha * d_[i];
      if (std::sqrt(dot(t_, t_)) >= limits.radius) {
        to_boundary(limits.radius);
        return {true, true, j + 1};
      }
      double model = 0, norm2 = 0;
      for (std::size_t i = 0; i < n; ++i) {
        x_[i] = t_[i];
        r_[i] -= alpha * ad_[i];
        model += x_[i] * (scale[i] * rhs[i] + r_[i]);
        norm2 += r_[i] * r_[i];
      }
      const double before = gained;
      gained = 0.5 * model;
      if (std::sqrt(norm2) <= target || static_cast<double>(j + 1) * (gained - before) < limits.q_eps * gained)
        return {true, false, j + 1};
      precondition(r_, z_);
      const double rz_next = dot(r_, z_), beta = rz_next / rz;
      for (std::size_t i = 0; i < n; ++i) d_[i] = z_[i] + beta * d_[i];
      rz = rz_next;
    }
    return {true, false, limits.max_iterations};
  }

  // x + tau d with tau >= 0 and norm `radius` (3.93), free of cancellation.
  void to_boundary(double radius) {
    const double a = dot(d_, d_), b = dot(x_, d_), c = dot(x_, x_) - radius * radius;
    const double root = std::sqrt(std::max(b * b - a * c, 0.0));
    const double tau = b > 0.0 ? -c / (b + root) : (root - b) / a;
    for (std::size_t i = 0; i < x_.size(); ++i) x_[i] += tau * d_[i];
    const double shrink = radius / std::sqrt(dot(x_, x_));
    for (double& value : x_) value *= shrink;
  }

  Buffer<double> x_, r_, z_, d_, ad_, t_;
};

}  // namespace ba::BA_TARGET
