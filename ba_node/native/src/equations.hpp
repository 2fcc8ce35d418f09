// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The normal equations of one problem, H = [B E; E' C] and g, at a state. Of E only the weighted rows of the Jacobian
// are kept, as it follows from them: with a for a row's derivative by the point x, that by the pose is (x x a, a).
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "blocks.hpp"
#include "layout.hpp"
#include "pool.hpp"
#include "rows.hpp"

namespace ba {

// C (packed), g and cost of a batch of points.
struct PointSums {
  Packed c;
  V8 g[3];
  V8 cost;
};

template <int kRows>
[[gnu::always_inline]] inline void add_point_rows(const Seen& seen, PointSums& out) {
#pragma GCC unroll 3
  for (int row = 0; row < kRows; ++row) {
    const V8 *d = seen.d_point[row], w = seen.weight[row == 2];
    const V8 a = w * d[0], b = w * d[1], c = w * d[2], r = seen.residual[row];
    out.c[0] += a * d[0];
    out.c[1] += b * d[0];
    out.c[2] += b * d[1];
    out.c[3] += c * d[0];
    out.c[4] += c * d[1];
    out.c[5] += c * d[2];
    out.g[0] += a * r;
    out.g[1] += b * r;
    out.g[2] += c * r;
  }
  out.cost += seen.cost;
}

// The derivative by a pose, from that by the point at x.
[[gnu::always_inline]] inline void pose_row(const V8* x, const V8* a, V8* out) {
  out[0] = x[1] * a[2] - x[2] * a[1];
  out[1] = x[2] * a[0] - x[0] * a[2];
  out[2] = x[0] * a[1] - x[1] * a[0];
  for (int i = 0; i < 3; ++i) out[3 + i] = a[i];
}

template <int D>
class Equations {
 public:
  explicit Equations(const Layout& layout)
      : lines((D == 9 ? 2 : 1) + (layout.has_depth ? 1 : 0)), l_(layout) {
    record.resize(kLanes * l_.n_slots() * lines);
    b.resize(l_.n_free);
    gradient_c.resize(l_.n_free);
    point.resize(3 * l_.n_batches);
    c.resize(6 * l_.n_batches);
    gradient_p.resize(3 * l_.n_batches);
    part_.resize(l_.n_chunks());
  }

  double gradient_norm = 0;
  Buffer<Block<D>> b;
  Buffer<Column<D>> gradient_c;
  // By batch: three registers of points, six of C (packed), three of g.
  Buffer<V8> point, c, gradient_p;
  // By observation: the rows of the Jacobian, each `lines` registers: (a_u, a_v, r_u, r_v); (i_u, i_v, -, -) with
  // i by f, k1, k2 if those are free; (a_depth, r_depth, -) if depth is measured.
  const int lines;
  Buffer<V8> record;

  double linearise(Rows& rows, const StateView& s, Pool& pool) {
    rows.load_images(s);
    rows.with_kind([&](auto lens, auto depth) {
      pool.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
        part_[chunk] = linearise_chunk<decltype(lens)::value, decltype(depth)::value>(rows, s, chunk);
      });
      pool.each(l_.n_free, [&](std::int64_t k, int) { sum_keyframe<decltype(depth)::value>(k); });
    });
    double total = 0, norm2 = 0;
    for (double part : part_) total += part;
    for (const auto& x : gradient_c) norm2 += dot(x, x);
    V8 squares{};
    for (const V8& x : gradient_p) squares += x * x;
    gradient_norm = std::sqrt(norm2 + sum(squares));
    return total;
  }

 private:
  template <Lens kLens, bool kDepth>
  double linearise_chunk(const Rows& rows, const StateView& s, std::int64_t chunk) {
    V8 total{};
    for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
      V8 x[3];
      rows.load_points(i, s.points, x);
      PointSums sums{};
      for (std::int64_t slot = l_.slot_begin[i]; slot < l_.slot_begin[i + 1]; ++slot) {
        Images images;
        Seen seen;
        rows.gather<kLens>(slot, images);
        rows.see<kLens, kDepth, true, true>(slot, images, x, seen);
        add_point_rows<kDepth ? 3 : 2>(seen, sums);
        keep<kDepth>(seen, slot);
      }
      for (int j = 0; j < 3; ++j) point[3 * i + j] = x[j];
      for (int j = 0; j < 6; ++j) c[6 * i + j] = sums.c[j];
      for (int j = 0; j < 3; ++j) gradient_p[3 * i + j] = sums.g[j];
      total += sums.cost;
    }
    return 0.5 * sum(total);
  }

  template <bool kDepth>
  [[gnu::always_inline]] void keep(const Seen& seen, std::int64_t slot) {
    const auto write = [&](int line, V8(&r)[8]) {
      transpose(r);
      for (int l = 0; l < kLanes; ++l) record[(kLanes * slot + l) * lines + line] = r[l];
    };
    const V8 w = seen.root[0];
    V8 r[8];
    for (int i = 0; i < 6; ++i) r[i] = w * seen.d_point[i / 3][i % 3];
    r[6] = w * seen.residual[0];
    r[7] = w * seen.residual[1];
    write(0, r);
    if constexpr (D == 9) {
      for (int i = 0; i < 6; ++i) r[i] = w * seen.d_intrinsics[i / 3][i % 3];
      r[6] = r[7] = V8{};
      write(1, r);
    }
    if constexpr (kDepth) {
      for (int i = 0; i < 3; ++i) r[i] = seen.root[1] * seen.d_point[2][i];
      r[3] = seen.root[1] * seen.residual[2];
      for (int i = 4; i < 8; ++i) r[i] = V8{};
      write(lines - 1, r);
    }
  }

  // B and g of free keyframe k.
  template <bool kDepth>
  void sum_keyframe(std::int64_t k) {
    constexpr int kRows = kDepth ? 3 : 2;
    V8 h[D * (D + 1) / 2] = {}, g[D] = {};
    for (std::int64_t first = l_.keyframe_seen[k]; first < l_.keyframe_seen[k + 1]; first += kLanes) {
      V8 j[3][D], r[3];
      load_rows<kDepth>(first, j, r);
      int t = 0;
#pragma GCC unroll 9
      for (int m = 0; m < D; ++m) {
#pragma GCC unroll 3
        for (int row = 0; row < kRows; ++row) g[m] += j[row][m] * r[row];
#pragma GCC unroll 9
        for (int n = 0; n <= m; ++n, ++t)
#pragma GCC unroll 3
          for (int row = 0; row < kRows; ++row) h[t] += j[row][m] * j[row][n];
      }
    }
    Block<D>& block = b[k];
    clear(&block, 1);
    clear(&gradient_c[k], 1);
    int t = 0;
    for (int m = 0; m < D; ++m) {
      set(gradient_c[k], m, sum(g[m]));
      for (int n = 0; n <= m; ++n, ++t) {
        const double value = sum(h[t]);
        set_entry(block, m, n, value);
        set_entry(block, n, m, value);
      }
    }
  }

  // Rows of the Jacobian by the keyframe, and residuals, of eight observations of one keyframe.
  template <bool kDepth>
  [[gnu::always_inline]] void load_rows(std::int64_t first, V8 (&j)[3][D], V8 (&r)[3]) const {
    V8 x[3], t[8];
    alignas(64) double columns[3][kLanes];
    const auto read = [&](int line) {
#pragma GCC unroll 8
      for (int l = 0; l < kLanes; ++l) {
        const std::int32_t o = l_.seen[first + l];
        t[l] = o < 0 ? V8{} : record[o * static_cast<std::int64_t>(lines) + line];
      }
      transpose(t);
    };
    for (int l = 0; l < kLanes; ++l) {
      const std::int32_t p = l_.seen_point[first + l];
      for (int i = 0; i < 3; ++i) columns[i][l] = point[3 * (p / kLanes) + i][p % kLanes];
    }
    for (int i = 0; i < 3; ++i) x[i] = load(columns[i]);
    read(0);
    r[0] = t[6];
    r[1] = t[7];
    pose_row(x, t, j[0]);
    pose_row(x, t + 3, j[1]);
    if constexpr (D == 9) {
      read(1);
      for (int i = 0; i < 3; ++i) {
        j[0][6 + i] = t[i];
        j[1][6 + i] = t[3 + i];
        j[2][6 + i] = V8{};
      }
    }
    if constexpr (kDepth) {
      read(lines - 1);
      pose_row(x, t, j[2]);
      r[2] = t[3];
    }
  }

  static void set(Column<D>& x, int i, double value) {
    if constexpr (D == 9) {
      if (i == 8) {
        x.b = value;
        return;
      }
    }
    x.a[i] = value;
  }
  const Layout& l_;
  std::vector<double> part_;
};

}  // namespace ba
