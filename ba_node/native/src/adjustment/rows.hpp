// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What a state says about eight observations, one of each point of a batch: residuals, their derivatives by the points,
// robust costs. The equations stand in core/objective.py, which is this file's oracle.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "adjustment/layout.hpp"
#include "adjustment/project.hpp"
#include "simd/simd.hpp"

namespace ba::BA_TARGET {

constexpr double kBehindNorm = 100.0;

// Diagonal entries below this are not damped by less.
constexpr double kMinDiagonal = 1e-6;

// The images of eight observations.
struct Images {
  V8 rotation[9];  // camera from world
  V8 translation[3];
  Cameras cameras;
};

// Eight observations. Derivatives and residuals are whitened; rows u, v and depth.
struct Evaluation {
  V8 residual[3];
  V8 d_point[3][3];
  V8 d_intrinsics[2][3];
  V8 weight[2];  // of the pixel rows, of the depth row
  V8 cost;
};

// Lower triangle, packed 00 10 11 20 21 22.
using Packed = V8[6];

// L^-1 of C plus damping; rows of undetermined directions are zero.
inline void inverse_cholesky(const Packed& c, const V8 (&damping)[3], Packed& li) {
  const V8 d0 = c[0] + damping[0], d1 = c[2] + damping[1], d2 = c[5] + damping[2];
  const V8 floor = 1e-14 * maximum(d0, maximum(d1, d2)) + 1e-300;
  const auto inverse_root = [floor](V8 pivot) {
    const Mask sound = pivot > floor;
    return select(sound, 1.0 / root(select(sound, pivot, splat(1.0))), V8{});
  };
  const V8 i00 = inverse_root(d0);
  const V8 l10 = c[1] * i00, l20 = c[3] * i00;
  const V8 i11 = inverse_root(d1 - l10 * l10);
  const V8 l21 = (c[4] - l20 * l10) * i11;
  const V8 i22 = inverse_root(d2 - l20 * l20 - l21 * l21);
  li[0] = i00;
  li[1] = -l10 * i00 * i11;
  li[2] = i11;
  li[3] = -(l20 * i00 + l21 * li[1]) * i22;
  li[4] = -l21 * i11 * i22;
  li[5] = i22;
}

// L^-1 x and L^-T x.
inline void lower_times(const Packed& li, const V8 (&x)[3], V8 (&out)[3]) {
  out[0] = li[0] * x[0];
  out[1] = li[1] * x[0] + li[2] * x[1];
  out[2] = li[3] * x[0] + li[4] * x[1] + li[5] * x[2];
}
inline void upper_times(const Packed& li, const V8 (&x)[3], V8 (&out)[3]) {
  out[0] = li[0] * x[0] + li[1] * x[1] + li[3] * x[2];
  out[1] = li[2] * x[1] + li[4] * x[2];
  out[2] = li[5] * x[2];
}

// Psi and the IRLS weight of residuals of a squared norm.
[[gnu::always_inline]] inline void robust(const CostModel& model, V8 norm2, V8& cost, V8& weight) {
  cost = norm2;
  weight = splat(1.0);
  if (model.loss == Loss::kSquared) return;
  const double c = model.scale;
  if (model.loss == Loss::kCauchy) {
    const V8 ratio = norm2 * (1.0 / (c * c));
    cost = (c * c) * log1p(ratio);
    weight = 1.0 / (1.0 + ratio);
    return;
  }
  const Mask outside = norm2 > c * c;
  if (!any(outside)) return;
  const V8 norm = root(select(outside, norm2, splat(1.0)));
  const V8 falling = c / norm;
  cost = select(outside, c * (2 * norm - c), norm2);
  weight = select(outside, falling, splat(1.0));
}

class Rows {
 public:
  Rows(Layout& layout, const CostModel& cost_model, const StateView& start)
      : l_(layout),
        cost_(cost_model),
        stride_(layout.lens == Lens::kPinhole ? 16
                : layout.lens == Lens::kMixed ? 32
                                              : 24) {
    image_.assign(stride_ * std::max<std::size_t>(l_.images.size(), 1), 0.0);
    if (cost_.cheirality == Cheirality::kDrop) drop_behind(layout, start);
  }

  // The scale of Huber's loss, 0 for another.
  double huber() const { return cost_.loss == Loss::kHuber ? cost_.scale : 0.0; }
  double least_promise() const { return cost_.least_promise; }

  // Call f(lens, depth) with the lens that the problem needs and whether it measures depth, both as types. Where
  // keyframes have intrinsics of their own (D = 9) the lens is radial at least.
  template <int D, class F>
  void with_kind(F f) const {
    if (l_.lens == Lens::kMixed) {
      with_depth<Lens::kMixed>(f);
    } else if (l_.lens == Lens::kRational) {
      with_depth<Lens::kRational>(f);
    } else if (D == 9 || l_.lens == Lens::kRadial) {
      with_depth<Lens::kRadial>(f);
    } else if constexpr (D == 6) {
      with_depth<Lens::kPinhole>(f);
    }
  }

  // Camera from world and the parameters of every image.
  void load_images(const StateView& s) {
    for (std::size_t m = 0; m < l_.images.size(); ++m) {
      const std::int64_t k = l_.images[m] / l_.n_cameras, c = l_.images[m] % l_.n_cameras;
      const double *r = s.rotation + 9 * k, *t = s.translation + 3 * k;
      const double *q = &l_.camera_rotation[9 * c], *o = &l_.camera_translation[3 * c];
      double* out = &image_[stride_ * m];
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j)
          out[3 * i + j] = q[3 * i] * r[j] + q[3 * i + 1] * r[3 + j] + q[3 * i + 2] * r[6 + j];
        out[9 + i] = q[3 * i] * t[0] + q[3 * i + 1] * t[1] + q[3 * i + 2] * t[2] + o[i];
      }
      double* param = out + 12;
      const int used = l_.lens == Lens::kPinhole ? 4 : kParams;
      std::copy_n(&l_.params[kParams * c], used, param);
      if (l_.lens == Lens::kMixed) param[kParams] = l_.model[c];
      if (l_.own_intrinsics) {
        const double* own = s.intrinsics + 3 * k;
        param[0] *= own[0];
        param[1] *= own[0];
        param[4] += own[1];
        param[5] += own[2];
      }
    }
  }

  template <Lens kLens>
  [[gnu::always_inline]] void gather(std::int64_t slot, Images& out) const {
    V8 r[8];
    columns(slot, 0, r);
    for (int i = 0; i < 8; ++i) out.rotation[i] = r[i];
    columns(slot, 8, r);
    out.rotation[8] = r[0];
    for (int i = 0; i < 3; ++i) out.translation[i] = r[1 + i];
    for (int i = 0; i < 4; ++i) out.cameras.param[i] = r[4 + i];
    if constexpr (kLens != Lens::kPinhole) {
      columns(slot, 16, r);
      for (int i = 0; i < 8; ++i) out.cameras.param[4 + i] = r[i];
    }
    if constexpr (kLens == Lens::kMixed) {
      columns(slot, 24, r);
      out.cameras.fisheye = r[0];
    }
  }

  // Everything about the observations of a slot; without derivatives residual and cost alone.
  template <Lens kLens, bool kDepth, bool kDerivatives>
  [[gnu::always_inline]] void evaluate(std::int64_t slot, const Images& im, const V8 (&x)[3], Evaluation& out) const {
    const std::int64_t at = kLanes * slot;
    V8 y[3];
    for (int i = 0; i < 3; ++i)
      y[i] =
          im.rotation[3 * i] * x[0] + im.rotation[3 * i + 1] * x[1] + im.rotation[3 * i + 2] * x[2] + im.translation[i];
    const V8 whiten = load(&l_.inverse_sigma[at]);
    const bool keep = cost_.cheirality == Cheirality::kKeep;
    const Mask hidden = behind<kLens>(y, im.cameras, keep), none = whiten == 0.0, off = hidden | none;
    y[0] = select(off, V8{}, y[0]);
    y[1] = select(off, V8{}, y[1]);
    y[2] = select(off, splat(1.0), y[2]);
    Projected q;
    project<kLens, kDerivatives>(y, im.cameras, q);
    const V8 scale = select(off, V8{}, whiten);
    out.residual[0] = (q.uv[0] - load(&l_.u[at])) * scale;
    out.residual[1] = (q.uv[1] - load(&l_.v[at])) * scale;
    robust(cost_, out.residual[0] * out.residual[0] + out.residual[1] * out.residual[1], out.cost, out.weight[0]);
    if (!keep) out.cost = select(hidden & ~none, splat(cost_of(kBehindNorm)), out.cost);
    V8 depth_scale{};
    if constexpr (kDepth) {
      V8 cost;
      depth_scale = select(off, V8{}, load(&l_.inverse_depth_sigma[at]));
      out.residual[2] = (y[2] - load(&l_.depth[at])) * depth_scale;
      robust(cost_, out.residual[2] * out.residual[2], cost, out.weight[1]);
      out.cost += cost;
    }
    if constexpr (kDerivatives) {
      for (int c = 0; c < 3; ++c) {
        for (int row = 0; row < 2; ++row) {
          V8 d = q.d_x[row][row] * im.rotation[3 * row + c] + q.d_x[row][2] * im.rotation[6 + c];
          if constexpr (kLens != Lens::kPinhole) d += q.d_x[row][1 - row] * im.rotation[3 * (1 - row) + c];
          out.d_point[row][c] = scale * d;
          if constexpr (kLens != Lens::kPinhole) out.d_intrinsics[row][c] = scale * q.d_intrinsics[row][c];
        }
        if constexpr (kDepth) out.d_point[2][c] = depth_scale * im.rotation[6 + c];
      }
    }
  }

  // The points of a batch, from the caller's array.
  void load_points(std::int64_t batch, const double* points, V8 (&x)[3]) const {
    const std::int32_t* of_lane = &l_.point[kLanes * batch];
    for (int i = 0; i < 3; ++i)
      x[i] = each([=](int l) { return points[3 * static_cast<std::int64_t>(of_lane[l]) + i]; });
  }
  void store_points(std::int64_t batch, const V8 (&x)[3], double* points) const {
    for (int l = 0; l < l_.lanes(batch); ++l) {
      double* p = points + 3 * static_cast<std::int64_t>(l_.point[kLanes * batch + l]);
      for (int i = 0; i < 3; ++i) p[i] = x[i][l];
    }
  }

  // 1/2 sum of the costs of a chunk.
  template <Lens kLens, bool kDepth>
  double objective(std::int64_t chunk, const StateView& s) const {
    V8 total{};
    for (std::int64_t b = l_.chunks[chunk]; b < l_.chunks[chunk + 1]; ++b) {
      V8 x[3];
      load_points(b, s.points, x);
      for (std::int64_t slot = l_.slot_begin[b]; slot < l_.slot_begin[b + 1]; ++slot) {
        Images im;
        Evaluation obs;
        gather<kLens>(slot, im);
        evaluate<kLens, kDepth, false>(slot, im, x, obs);
        total += obs.cost;
      }
    }
    return 0.5 * sum(total);
  }

 private:
  template <Lens kLens, class F>
  void with_depth(F f) const {
    if (l_.has_depth) {
      f(std::integral_constant<Lens, kLens>(), std::true_type());
    } else {
      f(std::integral_constant<Lens, kLens>(), std::false_type());
    }
  }

  // Eight numbers of the images of a slot.
  [[gnu::always_inline]] void columns(std::int64_t slot, int offset, V8 (&r)[8]) const {
    const std::int32_t* image = &l_.slot_image[kLanes * slot];
    const double* numbers = &image_[offset];
    if (kWhole && l_.has_one_image(slot)) {
#pragma GCC unroll 8
      for (int i = 0; i < kLanes; ++i) r[i] = splat(numbers[stride_ * image[0] + i]);
      return;
    }
#pragma GCC unroll 8
    for (int l = 0; l < kLanes; ++l) r[l] = load(numbers + stride_ * image[l]);
    transpose(r);
  }

  double cost_of(double norm) const {
    if (cost_.loss == Loss::kCauchy)
      return cost_.scale * cost_.scale * std::log1p(norm * norm / (cost_.scale * cost_.scale));
    if (cost_.loss == Loss::kSquared || norm <= cost_.scale) return norm * norm;
    return cost_.scale * (2 * norm - cost_.scale);
  }

  // Observations of points that start behind their camera count for nothing.
  void drop_behind(Layout& layout, const StateView& s) {
    load_images(s);
    for (std::int64_t b = 0; b < l_.n_batches; ++b) {
      V8 x[3];
      load_points(b, s.points, x);
      for (std::int64_t at = kLanes * l_.slot_begin[b]; at < kLanes * l_.slot_begin[b + 1]; ++at) {
        const double* r = &image_[stride_ * l_.slot_image[at]];
        const int l = static_cast<int>(at % kLanes);
        double y[3];
        for (int i = 0; i < 3; ++i)
          y[i] = r[3 * i] * x[0][l] + r[3 * i + 1] * x[1][l] + r[3 * i + 2] * x[2][l] + r[9 + i];
        const bool fisheye = l_.lens == Lens::kMixed && r[12 + kParams] != 0.0;
        if (is_behind(y, fisheye)) layout.inverse_sigma[at] = 0.0;
      }
    }
  }

  const Layout& l_;
  CostModel cost_;
  std::int64_t stride_;  // doubles an image: rotation, translation, parameters
  Buffer<double> image_;
};

}  // namespace ba::BA_TARGET
