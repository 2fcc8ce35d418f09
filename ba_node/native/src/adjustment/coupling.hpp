// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// E = Jc'Jp, which couples keyframes and points, by what is kept of it (equations.hpp): its products, and Z = E L^-T by
// edges, with C + D = L L'.
#pragma once

#include <cstdint>
#include <vector>

#include "adjustment/equations.hpp"
#include "adjustment/layout.hpp"
#include "adjustment/rows.hpp"
#include "linalg/blocks.hpp"

namespace ba::BA_TARGET {

template <int D>
class Coupling {
 public:
  Coupling(const Layout& layout, const Equations<D>& equations) : l_(layout), equations_(equations) {
    inverse_l_.resize(6 * l_.n_batches);
    scaled_gradient_.resize(3 * l_.n_batches);
    step_.resize(l_.n_free + 1);
    clear(&step_[l_.n_free], 1);
    find_columns();
  }

  // L^-1 of the points of a batch.
  Packed& inverse_l(std::int64_t batch) { return *reinterpret_cast<Packed*>(&inverse_l_[6 * batch]); }
  const Packed& inverse_l(std::int64_t batch) const { return *reinterpret_cast<const Packed*>(&inverse_l_[6 * batch]); }

  // y = L^-1 gp of the points of a batch.
  V8* scaled_gradient(std::int64_t batch) { return &scaled_gradient_[3 * batch]; }
  const V8* scaled_gradient(std::int64_t batch) const { return &scaled_gradient_[3 * batch]; }

  // The step of the free keyframes (n_free x D) that project_step is of.
  void load_step(const double* step) {
    for (std::int64_t k = 0; k < l_.n_free; ++k) {
      V8 a = {};
      for (int i = 0; i < (D == 9 ? 8 : 6); ++i) a[i] = step[k * D + i];
      step_[k].a = a;
      if constexpr (D == 9) step_[k].b = step[k * D + 8];
    }
  }
  const Column<D>& step(std::int64_t k) const { return step_[k]; }

  // Z of the edges of a batch, z[edge].
  void edges_of(std::int64_t batch, Edge<D>* z) const {
    if (l_.has_depth || l_.has_rigs) {
      edges_of_batch<true>(batch, z);
    } else {
      edges_of_batch<false>(batch, z);
    }
  }

  // Z of a batch whose points all have the edges of the first, by lane: z[18 k + 6 c + r] is row r of column c of their
  // edge k. Add Z y to sums[6 k + r].
  void edges_by_lane(std::int64_t batch, V8* z, V8* sums) const {
    if (l_.has_depth || l_.has_rigs) {
      edges_of_lanes<true>(batch, z, sums);
    } else {
      edges_of_lanes<false>(batch, z, sums);
    }
  }

  // Add E p to sums for p of the points of a batch.
  void add_coupling(std::int64_t batch, const V8 (&p)[3], Column<D>* sums) const {
    const auto none = static_cast<std::int32_t>(l_.n_free);
    const V8* x = &equations_.point[3 * batch];
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      V8 t[8], h[3], out[8] = {}, ninth{};
      read_lanes(slot, 0, t);
      const V8 u = t[0] * p[0] + t[1] * p[1] + t[2] * p[2], v = t[3] * p[0] + t[4] * p[1] + t[5] * p[2];
      for (int i = 0; i < 3; ++i) h[i] = t[i] * u + t[3 + i] * v;
      if constexpr (D == 9) {
        read_lanes(slot, 1, t);
        for (int i = 0; i < 2; ++i) out[6 + i] = t[i] * u + t[3 + i] * v;
        ninth = t[2] * u + t[5] * v;
      }
      if (l_.has_depth) {
        read_lanes(slot, equations_.registers - 1, t);
        const V8 w = t[0] * p[0] + t[1] * p[1] + t[2] * p[2];
        for (int i = 0; i < 3; ++i) h[i] += t[i] * w;
      }
      pose_row(x, h, out);
      transpose(out);
      // Where there is no observation its record is zero.
      for (int l = 0; l < kLanes; ++l) {
        const std::int32_t column = image_column_[l_.slot_image[kLanes * slot + l]];
        if (column == none) continue;
        sums[column].a += out[l];
        if constexpr (D == 9) sums[column].b += ninth[l];
      }
    }
  }

  // Z' step = L^-1 Jp' Jc step of a batch.
  [[gnu::always_inline]] void project_step(std::int64_t batch, V8 (&out)[3]) const {
    const V8* x = &equations_.point[3 * batch];
    V8 z[3] = {};
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      V8 s[8], t[8], q[3], last{};
      const std::int32_t* image = &l_.slot_image[kLanes * slot];
      // Where there is no observation its record is zero.
      if (kWhole && l_.has_one_image(slot)) {
        const Column<D>& step = step_[image_column_[image[0]]];
#pragma GCC unroll 8
        for (int i = 0; i < (D == 9 ? 8 : 6); ++i) s[i] = splat(step.a[i]);
        if constexpr (D == 9) last = splat(step.b);
      } else {
#pragma GCC unroll 8
        for (int l = 0; l < kLanes; ++l) s[l] = step_[image_column_[image[l]]].a;
        if constexpr (D == 9) last = each([&](int l) { return step_[image_column_[image[l]]].b; });
        transpose(s);
      }
      q[0] = s[1] * x[2] - s[2] * x[1] + s[3];
      q[1] = s[2] * x[0] - s[0] * x[2] + s[4];
      q[2] = s[0] * x[1] - s[1] * x[0] + s[5];
      V8 u{}, v{};
      if constexpr (D == 9) {
        read_lanes(slot, 1, t);
        u = t[0] * s[6] + t[1] * s[7] + t[2] * last;
        v = t[3] * s[6] + t[4] * s[7] + t[5] * last;
      }
      read_lanes(slot, 0, t);
      u += t[0] * q[0] + t[1] * q[1] + t[2] * q[2];
      v += t[3] * q[0] + t[4] * q[1] + t[5] * q[2];
      for (int i = 0; i < 3; ++i) z[i] += t[i] * u + t[3 + i] * v;
      if (l_.has_depth) {
        read_lanes(slot, equations_.registers - 1, t);
        const V8 w = t[0] * q[0] + t[1] * q[1] + t[2] * q[2];
        for (int i = 0; i < 3; ++i) z[i] += t[i] * w;
      }
    }
    lower_times(inverse_l(batch), z, out);
  }

 private:
  // kGeneral: edges of several observations, or with depth.
  template <bool kGeneral>
  void edges_of_batch(std::int64_t batch, Edge<D>* z) const {
    const V8(&x)[3] = *reinterpret_cast<const V8(*)[3]>(&equations_.point[3 * batch]);
    const Packed& li = inverse_l(batch);
    V8 c[6] = {}, f[D == 9 ? 9 : 1] = {};
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      couple<kGeneral>(slot, c, f);
      store_edges(slot, li, x, c, f, z);
    }
  }

  template <bool kGeneral>
  void edges_of_lanes(std::int64_t batch, V8* z, V8* sums) const {
    const V8(&x)[3] = *reinterpret_cast<const V8(*)[3]>(&equations_.point[3 * batch]);
    const Packed& li = inverse_l(batch);
    const V8* y = scaled_gradient(batch);
    V8 c[6] = {}, f[D == 9 ? 9 : 1] = {};
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot) {
      couple<kGeneral>(slot, c, f);
      if (l_.slot_edge[kLanes * slot] < 0) continue;
      V8 columns[3][8], ninth[8];
      scale(li, c, f, columns, ninth);
      for (int col = 0; col < 3; ++col) pose_row(x, columns[col] + 3, columns[col]);
      for (int r = 0; r < 6; ++r) {
        sums[r] += columns[0][r] * y[0] + columns[1][r] * y[1] + columns[2][r] * y[2];
        for (int col = 0; col < 3; ++col) z[6 * col + r] = columns[col][r];
      }
      z += 18;
      sums += 6;
    }
  }

  // sum a a' (packed) and, where intrinsics are free, sum i a' over the rows of the observations of an edge so far.
  template <bool kGeneral>
  [[gnu::always_inline]] void couple(std::int64_t slot, V8 (&c)[6], V8* f) const {
    V8 t[8];
    const auto read = [&](int reg) { read_lanes(slot, reg, t); };
    const auto add = [&c](const V8* a) {
      c[0] += a[0] * a[0];
      c[1] += a[1] * a[0];
      c[2] += a[1] * a[1];
      c[3] += a[2] * a[0];
      c[4] += a[2] * a[1];
      c[5] += a[2] * a[2];
    };
    if constexpr (kGeneral) {
      const Mask same = load(&l_.same_edge[kLanes * slot]) != 0.0;
      for (int i = 0; i < 6; ++i) c[i] = select(same, c[i], V8{});
      for (int i = 0; i < (D == 9 ? 9 : 0); ++i) f[i] = select(same, f[i], V8{});
    } else {
      for (int i = 0; i < 6; ++i) c[i] = V8{};
      for (int i = 0; i < (D == 9 ? 9 : 0); ++i) f[i] = V8{};
    }
    read(0);
    add(t);
    add(t + 3);
    if constexpr (D == 9) {
      V8 a[6];
      for (int i = 0; i < 6; ++i) a[i] = t[i];
      read(1);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) f[3 * i + j] += t[i] * a[j] + t[3 + i] * a[3 + j];
    }
    if constexpr (kGeneral) {
      if (l_.has_depth) {
        read(equations_.registers - 1);
        add(t);
      }
    }
  }

  // Z of the edges that end in a slot, z[edge].
  [[gnu::always_inline]] void store_edges(std::int64_t slot, const Packed& li, const V8 (&x)[3], const V8 (&c)[6],
                                          const V8* f, Edge<D>* z) const {
    V8 columns[3][8], ninth[8] = {};
    scale(li, c, f, columns, ninth);
#pragma GCC unroll 3
    for (int col = 0; col < 3; ++col) {
      pose_row(x, columns[col] + 3, columns[col]);
      if constexpr (D == 6) {
        columns[col][6] = columns[col][0];
        columns[col][7] = columns[col][1];
      }
      transpose(columns[col]);
    }
    if constexpr (D == 9) transpose(ninth);
    const std::int32_t* edge = &l_.slot_edge[kLanes * slot];
    for (int l = 0; l < kLanes; ++l) {
      if (edge[l] < 0) continue;
      for (int col = 0; col < 3; ++col) z[edge[l]].a[col] = columns[col][l];
      if constexpr (D == 9) z[edge[l]].b = ninth[l];
    }
  }

  // C L^-T and F L^-T: with E = (x x C; C; F), of the columns of Z what is below the rows of the rotation. ninth: row 8
  // of each, if any.
  [[gnu::always_inline]] static void scale(const Packed& li, const V8 (&c)[6], const V8* f, V8 (&columns)[3][8],
                                           V8 (&ninth)[8]) {
    const V8 full[3][3] = {{c[0], c[1], c[3]}, {c[1], c[2], c[4]}, {c[3], c[4], c[5]}};
#pragma GCC unroll 3
    for (int i = 0; i < 3; ++i) {
      V8 w[3];
      const V8* a = full[i];
      w[0] = a[0] * li[0];
      w[1] = a[0] * li[1] + a[1] * li[2];
      w[2] = a[0] * li[3] + a[1] * li[4] + a[2] * li[5];
#pragma GCC unroll 3
      for (int col = 0; col < 3; ++col) columns[col][3 + i] = w[col];
      if constexpr (D == 9) {
        const V8* b = f + 3 * i;
        w[0] = b[0] * li[0];
        w[1] = b[0] * li[1] + b[1] * li[2];
        w[2] = b[0] * li[3] + b[1] * li[4] + b[2] * li[5];
#pragma GCC unroll 3
        for (int col = 0; col < 3; ++col) (i < 2 ? columns[col][6 + i] : ninth[col]) = w[col];
      }
    }
  }

  // Register `reg` of the records of a slot, each number by lane.
  [[gnu::always_inline]] void read_lanes(std::int64_t slot, int reg, V8 (&t)[8]) const {
    const V8* record = &equations_.record[kLanes * slot * equations_.registers + reg];
#pragma GCC unroll 8
    for (int l = 0; l < kLanes; ++l) t[l] = record[l * equations_.registers];
    transpose(t);
  }

  // Which free keyframe each image is of; n_free if of none.
  void find_columns() {
    image_column_.assign(l_.images.size(), static_cast<std::int32_t>(l_.n_free));
    const std::int64_t none = kLanes * l_.n_slots(), lists = static_cast<std::int64_t>(l_.list_begin.size()) - 1;
    for (std::int64_t list = 0; list < lists; ++list)
      for (std::int64_t i = l_.list_begin[list]; i < l_.list_begin[list + 1]; ++i)
        if (l_.listed[i] < none)
          image_column_[l_.slot_image[l_.listed[i]]] = static_cast<std::int32_t>(list % l_.n_free);
  }

  const Layout& l_;
  const Equations<D>& equations_;
  std::vector<std::int32_t> image_column_;
  Buffer<V8> inverse_l_, scaled_gradient_;
  Buffer<Column<D>> step_;  // the last is zero
};

}  // namespace ba::BA_TARGET
