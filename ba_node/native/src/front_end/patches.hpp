// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Patches of images: cut, and aligned with another image. front_end/patches.py has the equations, and is this file's
// oracle.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "front_end/types.hpp"
#include "simd/target.hpp"

namespace ba::BA_TARGET {

// Values between pixels, at places that are set first; beyond the border as at the border. Images have two rows and
// columns at least.
class Sampler {
 public:
  Sampler(const ImageView& image, std::int64_t n)
      : image_(image), n_(n), x_(n), y_(n), above_(2 * n), below_(2 * n), column_(n), row_(n) {}

  float* x() { return x_.data(); }
  float* y() { return y_.data(); }
  // What is written by the next sample, for those who sample in another way.
  float* pairs() { return above_.data(); }
  std::int32_t* columns() { return column_.data(); }

  void sample(float* out) {
    if (lies_inside()) {
      sample_inside(out);
      return;
    }
    split(x_.data(), image_.width, column_.data());
    split(y_.data(), image_.height, row_.data());
    const float *right = x_.data(), *down = y_.data();
    for (std::int64_t j = 0; j < n_; ++j) {
      const float* above = image_.at + row_[j] * image_.width + column_[j];
      const float* below = above + image_.width;
      const float upper = above[0] + right[j] * (above[1] - above[0]);
      const float lower = below[0] + right[j] * (below[1] - below[0]);
      out[j] = upper + down[j] * (lower - upper);
    }
  }

 private:
  // False if a coordinate is not a number.
  bool lies_inside() const {
    const auto right = static_cast<float>(image_.width - 1), bottom = static_cast<float>(image_.height - 1);
    int outside = 0;
    for (std::int64_t j = 0; j < n_; ++j)
      outside |= !(x_[j] >= 0.0F) | !(x_[j] < right) | !(y_[j] >= 0.0F) | !(y_[j] < bottom);
    return outside == 0;
  }

  // Neighbours in a row are fetched together, and all blended afterwards, many at once.
  void sample_inside(float* out) {
    const auto width = static_cast<std::int32_t>(image_.width);
    float *right = x_.data(), *down = y_.data();
    std::int32_t* pixel = column_.data();
    for (std::int64_t j = 0; j < n_; ++j) {
      const auto column = static_cast<std::int32_t>(right[j]), row = static_cast<std::int32_t>(down[j]);
      right[j] -= static_cast<float>(column);
      down[j] -= static_cast<float>(row);
      pixel[j] = row * width + column;
    }
    float *above = above_.data(), *below = below_.data();
    for (std::int64_t j = 0; j < n_; ++j) {
      std::memcpy(above + 2 * j, image_.at + pixel[j], 2 * sizeof(float));
      std::memcpy(below + 2 * j, image_.at + pixel[j] + width, 2 * sizeof(float));
    }
    for (std::int64_t j = 0; j < n_; ++j) {
      const float first = above[2 * j] + down[j] * (below[2 * j] - above[2 * j]);
      const float second = above[2 * j + 1] + down[j] * (below[2 * j + 1] - above[2 * j + 1]);
      out[j] = first + right[j] * (second - first);
    }
  }

  // Takes coordinates apart into a pixel that has a neighbour and the way from it, which stays in their place.
  void split(float* at, std::int64_t size, std::int32_t* pixel) const {
    const auto last = static_cast<float>(size - 1), last_but_one = static_cast<float>(size - 2);
    for (std::int64_t j = 0; j < n_; ++j) {
      const float inside = at[j] > 0.0F ? std::min(at[j], last) : 0.0F;
      const float whole = std::min(static_cast<float>(static_cast<std::int32_t>(inside)), last_but_one);
      pixel[j] = static_cast<std::int32_t>(whole);
      at[j] = inside - whole;
    }
  }

  ImageView image_;
  std::int64_t n_;
  std::vector<float> x_, y_, above_, below_;
  std::vector<std::int32_t> column_, row_;
};

// Offsets that are whole pixels side by side: from one of them on, so many.
struct Run {
  std::int64_t begin, length, dx, dy;
};

// Returns the runs of offsets (m, 2), none if one of them is not whole, and sets how far they reach: x, y least and
// most.
inline std::vector<Run> runs_of(const float* offsets, std::int64_t m, std::array<std::int64_t, 4>& reach) {
  std::vector<Run> runs;
  for (std::int64_t j = 0; j < m; ++j) {
    const auto dx = static_cast<std::int64_t>(offsets[2 * j]), dy = static_cast<std::int64_t>(offsets[2 * j + 1]);
    if (static_cast<float>(dx) != offsets[2 * j] || static_cast<float>(dy) != offsets[2 * j + 1]) return {};
    if (!runs.empty() && runs.back().dy == dy && runs.back().dx + runs.back().length == dx)
      ++runs.back().length;
    else
      runs.push_back({j, 1, dx, dy});
    reach = {std::min(reach[0], dx), std::max(reach[1], dx), std::min(reach[2], dy), std::max(reach[3], dy)};
  }
  return runs;
}

// Values at uv (n, 2) by offsets (m, 2). Inside the image all pixels of a patch lie alike between those of the image.
inline void cut_patches(const ImageView& image, const double* uv, std::int64_t n, const float* offsets, std::int64_t m,
                        float* out) {
  Sampler sampler(image, m);
  std::array<std::int64_t, 4> reach{};
  const std::vector<Run> runs = runs_of(offsets, m, reach);
  for (std::int64_t i = 0; i < n; ++i, out += m) {
    const auto u = static_cast<float>(uv[2 * i]), v = static_cast<float>(uv[2 * i + 1]);
    if (!runs.empty() && u + reach[0] >= 0.0F && u + reach[1] < image.width - 1 && v + reach[2] >= 0.0F &&
        v + reach[3] < image.height - 1) {
      const auto column = static_cast<std::int64_t>(u), row = static_cast<std::int64_t>(v);
      const float right = u - static_cast<float>(column), down = v - static_cast<float>(row);
      for (const Run& run : runs) {
        const float* above = image.at + (row + run.dy) * image.width + column + run.dx;
        const float* below = above + image.width;
        for (std::int64_t j = 0; j < run.length; ++j) {
          const float upper = above[j] + right * (above[j + 1] - above[j]);
          const float lower = below[j] + right * (below[j + 1] - below[j]);
          out[run.begin + j] = upper + down * (lower - upper);
        }
      }
      continue;
    }
    float *x = sampler.x(), *y = sampler.y();
    for (std::int64_t j = 0; j < m; ++j) {
      x[j] = u + offsets[2 * j];
      y[j] = v + offsets[2 * j + 1];
    }
    sampler.sample(out);
  }
}

// Aligns one patch after another; bend (n, 2) may be null. Of all that is made of a patch nothing leaves the cache.
class Aligner {
 public:
  Aligner(const ImageView& image, const PatchesView& patches, const AlignLimits& limits)
      : sampler_(image, patches.pixels),
        image_(image),
        patches_(patches),
        limits_(limits),
        size_((patches.pixels + 7) / 8 * 8),
        seen_(static_cast<std::size_t>(size_)),
        values_(seen_),
        weighted_(seen_),
        window_(seen_),
        grid_(2 * static_cast<std::size_t>(size_)),
        by_(3 * static_cast<std::size_t>(size_)),
        jacobian_(by_),
        strip_(static_cast<std::size_t>(patches.height * kStrip)) {
    std::copy_n(patches.window, patches.pixels, window_.data());
    for (std::int64_t j = 0; j < patches.pixels; ++j) {
      grid_[j] = patches.grid[2 * j];
      grid_[size_ + j] = patches.grid[2 * j + 1];
    }
  }

  void align(std::int64_t i, const double* bend, const PlacesSpan& to) {
    const std::int64_t k = patches_.movements;
    double *place = to.place + 2 * i, *affine = to.affine + 4 * i, *inverse = to.inverse + i * k * k;
    prepare(i, inverse);
    strip_begin_ = strip_end_ = 0;
    const double std = std_;
    for (int step = 0; step < limits_.iterations; ++step) {
      const Look seen = look(place, affine, bend == nullptr ? nullptr : bend + 2 * i);
      const double spread = seen.spread, agree = seen.alike[0] / spread / std::max(std_, 1e-6F);
      std::array<double, 3> right{}, move{};
      for (std::int64_t r = 0; r < k; ++r) right[r] = seen.alike[1 + r] * (std / spread);
      for (std::int64_t r = 0; r < k; ++r)
        for (std::int64_t c = 0; c < k; ++c) move[r] += inverse[r * k + c] * right[c];
      to.correlation[i] = agree;
      to.left[i] = 2.0 * std * std * std::max(1.0 - agree, 0.0);
      const double length = k == 2 ? std::hypot(move[0], move[1]) : std::abs(move[0]);
      const double share = std::min(1.0, limits_.farthest_px / std::max(length, 1e-9));
      for (double& each : move) each *= share;
      if (k == 2) {
        place[0] -= affine[0] * move[0] + affine[1] * move[1];
        place[1] -= affine[2] * move[0] + affine[3] * move[1];
      } else {
        const double along = affine[0];
        place[0] -= along * move[0];
        affine[0] -= along * move[1];
        affine[1] -= along * move[2];
      }
      if (!(length > limits_.step_px) || !std::isfinite(length)) break;
    }
  }

 private:
  // What an image shows where a template is: how far it spreads, and its products with the template and what it changes
  // by.
  struct Look {
    double spread;
    std::array<float, 4> alike;
  };

  // Columns of a strip, and those on either side of what is looked at first.
  static constexpr std::int64_t kStrip = 64, kBeside = 4;

  // Makes a template of a patch, as patches._Templates.of: weighted values, their standard deviation, Jacobian; and the
  // inverse of its Hessian.
  void prepare(std::int64_t i, double* inverse) {
    const std::int64_t n = patches_.pixels, k = patches_.movements, wide = patches_.width;
    const std::int64_t step = k == 3 ? 1 : 2;  // rows that are not compared are there for differences across rows
    const float* patch = patches_.at + i * patches_.height * wide;
    float *values = values_.data(), *weighted = weighted_.data(), *by = by_.data();
    const float* w = window_.data();
    std::int64_t j = 0;
    for (std::int64_t row = step - 1; j < n; row += step)
      for (std::int64_t column = 1; column + 1 < wide; column += 2, ++j) {
        const float* at = patch + row * wide + column;
        values[j] = at[0];
        by[j] = 0.5F * (at[1] - at[-1]);
        if (k == 2) by[size_ + j] = 0.5F * (at[wide] - at[-wide]);
      }
    for (std::int64_t r = 1; r < k && k == 3; ++r)
      for (j = 0; j < n; ++j) by[r * size_ + j] = by[j] * grid_[(r - 1) * size_ + j];
    const float mean = product(values, w);
    for (j = 0; j < n; ++j) {
      values[j] -= mean;
      weighted[j] = values[j] * w[j];
    }
    const float variance = product(values, weighted);
    std_ = std::sqrt(variance);
    std::array<double, 9> H{};
    for (std::int64_t r = 0; r < k; ++r) {
      float *movement = by + r * size_, *moved = jacobian_.data() + r * size_;
      const float middle = product(movement, w);
      // Values have a mean of 0: what they share with a movement does not depend on its mean.
      const float along = product(movement, weighted) / std::max(variance, limits_.least_variance);
      for (j = 0; j < n; ++j) {
        movement[j] -= middle + along * values[j];
        moved[j] = movement[j] * w[j];
      }
      for (std::int64_t c = 0; c <= r; ++c) H[3 * r + c] = H[3 * c + r] = product(moved, by + c * size_);
      H[4 * r] += patches_.prior[r] + limits_.least_hessian;
    }
    if (k == 2) {
      const double scale = 1.0 / (H[0] * H[4] - H[1] * H[1]);
      inverse[0] = H[4] * scale;
      inverse[1] = inverse[2] = -H[1] * scale;
      inverse[3] = H[0] * scale;
      return;
    }
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        const int a = (r + 1) % 3, b = (r + 2) % 3, d = (c + 1) % 3, e = (c + 2) % 3;
        inverse[3 * r + c] = H[3 * a + d] * H[3 * b + e] - H[3 * a + e] * H[3 * b + d];
      }
    const double determinant = H[0] * inverse[0] + H[1] * inverse[1] + H[2] * inverse[2];
    for (int r = 0; r < 9; ++r) inverse[r] /= determinant;
  }

  Look look(const double* place, const double* affine, const double* bend) {
    const std::int64_t n = patches_.pixels, k = patches_.movements;
    const auto u = static_cast<float>(place[0]), v = static_cast<float>(place[1]);
    const auto xx = static_cast<float>(affine[0]), xy = static_cast<float>(affine[1]);
    const auto yx = static_cast<float>(affine[2]), yy = static_cast<float>(affine[3]);
    const float gx = bend == nullptr ? 0.0F : static_cast<float>(bend[0]);
    const float gy = bend == nullptr ? 0.0F : static_cast<float>(bend[1]);
    const float *px = grid_.data(), *py = px + size_;
    float *s = seen_.data(), *to_x = sampler_.x(), *to_y = sampler_.y();
    if (k == 3 && bend == nullptr && yx == 0.0F && yy == 1.0F && look_along(u, v, xx, xy)) {
      // It has been looked at.
    } else {
      for (std::int64_t j = 0; j < n; ++j) {
        const float depth = 1.0F / (1.0F + gx * px[j] + gy * py[j]);
        to_x[j] = u + (xx * px[j] + xy * py[j]) * depth;
        to_y[j] = v + (yx * px[j] + yy * py[j]) * depth;
      }
      sampler_.sample(s);
    }
    const float mean = product(s, window_.data());
    for (std::int64_t j = 0; j < n; ++j) s[j] -= mean;
    Look result{0.0, {product(s, weighted_.data())}};
    for (std::int64_t r = 0; r < k; ++r) result.alike[1 + r] = product(s, jacobian_.data() + r * size_);
    for (std::int64_t j = 0; j < n; ++j) s[j] *= s[j];
    result.spread = std::sqrt(std::max(product(s, window_.data()), 1e-6F));
    return result;
  }

  // What moves along rows alone is looked at in these rows, which are taken from between those of the image once.
  // Returns false where they do not lie inside it.
  bool look_along(float u, float v, float xx, float xy) {
    const std::int64_t n = patches_.pixels, rows = patches_.height, columns = n / rows;
    const float *px = grid_.data(), *py = px + size_;
    const float half = std::abs(px[0]), reach = (std::abs(xx) + std::abs(xy)) * half;
    if (!(u - reach >= 0.0F) || !(u + reach < static_cast<float>(image_.width - 1)) || !(v - half >= 0.0F) ||
        !(v + half < static_cast<float>(image_.height - 1)) || !(reach < static_cast<float>(kStrip / 2 - kBeside - 2)))
      return false;
    const auto begin = static_cast<std::int64_t>(u - reach), end = static_cast<std::int64_t>(u + reach) + 2;
    if (begin < strip_begin_ || end > strip_end_) {
      strip_begin_ = std::max<std::int64_t>(begin - kBeside, 0);
      strip_end_ = std::min(end + kBeside, image_.width);
      for (std::int64_t r = 0; r < rows; ++r) {
        const float y = v + py[r * columns];
        const auto row = static_cast<std::int64_t>(y);
        const float down = y - static_cast<float>(row);
        const float* above = image_.at + row * image_.width + strip_begin_;
        const float* below = above + image_.width;
        float* to = strip_.data() + r * kStrip;
        for (std::int64_t c = 0; c < strip_end_ - strip_begin_; ++c) to[c] = above[c] + down * (below[c] - above[c]);
      }
    }
    float *right = sampler_.x(), *pairs = sampler_.pairs(), *s = seen_.data();
    std::int32_t* column = sampler_.columns();
    for (std::int64_t j = 0; j < n; ++j) {
      const float x = u + (xx * px[j] + xy * py[j]);
      column[j] = static_cast<std::int32_t>(x);
      right[j] = x - static_cast<float>(column[j]);
    }
    const float* strip = strip_.data() - strip_begin_;
    for (std::int64_t r = 0, j = 0; r < rows; ++r, strip += kStrip)
      for (std::int64_t c = 0; c < columns; ++c, ++j)
        std::memcpy(pairs + 2 * j, strip + column[j], 2 * sizeof(float));
    for (std::int64_t j = 0; j < n; ++j) s[j] = pairs[2 * j] + right[j] * (pairs[2 * j + 1] - pairs[2 * j]);
    return true;
  }

  // Of size_ values, in eight sums, so that none waits for another.
  float product(const float* a, const float* b) const {
    using Lanes = float __attribute__((vector_size(8 * sizeof(float))));
    Lanes sums{}, one, other;
    for (std::int64_t j = 0; j < size_; j += 8) {
      std::memcpy(&one, a + j, sizeof(one));
      std::memcpy(&other, b + j, sizeof(other));
      sums += one * other;
    }
    return ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]));
  }

  Sampler sampler_;
  ImageView image_;
  PatchesView patches_;
  AlignLimits limits_;
  std::int64_t size_;  // of the buffers of pixels, with zeros behind those of a patch
  std::vector<float> seen_, values_, weighted_, window_, grid_, by_, jacobian_;  // the grid as x, then y
  std::vector<float> strip_;
  std::int64_t strip_begin_ = 0, strip_end_ = 0;  // columns of the image
  float std_ = 0.0F;
};

inline void align_patches(const ImageView& image, const PatchesView& patches, const AlignLimits& limits,
                          const double* bend, const PlacesSpan& to) {
  Aligner aligner(image, patches, limits);
  for (std::int64_t i = 0; i < patches.n; ++i) aligner.align(i, bend, to);
}

}  // namespace ba::BA_TARGET
