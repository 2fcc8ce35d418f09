// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// The normal equations of one problem, H = [B E; E' C] and g, at a state. Of E only the weighted rows of the Jacobian
// are kept, as it follows from them: with a for a row's derivative by the point x, that by the pose is (x x a, a).
#pragma once

#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "adjustment/layout.hpp"
#include "adjustment/rows.hpp"
#include "linalg/blocks.hpp"
#include "parallel/pool.hpp"

namespace ba::BA_TARGET {

// C (packed), g and cost of a batch of points.
struct PointSums {
  Packed c;
  V8 g[3];
  V8 cost;
};

template <int kRows>
[[gnu::always_inline]] inline void add_point_rows(const Evaluation& obs, PointSums& out) {
#pragma GCC unroll 3
  for (int row = 0; row < kRows; ++row) {
    const V8 *d = obs.d_point[row], w = obs.weight[row == 2];
    const V8 a = w * d[0], b = w * d[1], c = w * d[2], r = obs.residual[row];
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
  out.cost += obs.cost;
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
  explicit Equations(const Layout& layout) : registers(registers_with(layout.has_depth)), l_(layout) {
    record.resize((kLanes * l_.n_slots() + 1) * registers);
    clear(&record[kLanes * l_.n_slots() * registers], registers);
    point.resize(3 * l_.n_batches);
    c.resize(6 * l_.n_batches);
    gradient_p.resize(3 * l_.n_batches);
    b.resize(l_.n_free);
    gradient_c.resize(l_.n_free);
    partial_.resize(l_.n_chunks());
    const std::int64_t lists = l_.n_lists() > 1 ? l_.n_lists() * l_.n_free : 0;
    partial_b_.resize(lists);
    partial_gradient_.resize(lists);
  }

  double gradient_norm = 0;
  // By batch: three registers of points, six of C (packed), three of g.
  Buffer<V8> point, c, gradient_p;
  // By observation: the rows of the Jacobian: (a_u, a_v, r_u, r_v); (i_u, i_v, -, -) with i by f, k1, k2 if those are
  // free; (a_depth, r_depth, -) if depth is measured. The last is zero, of no observation.
  Buffer<V8> record;
  Buffer<Block<D>> b;
  Buffer<Column<D>> gradient_c;
  // Rows of the Jacobian an observation, each `registers` registers.
  const int registers;

  double linearise(Rows& rows, const StateView& s, Pool& pool) {
    rows.load_images(s);
    rows.with_kind<D>([&](auto lens, auto depth) {
      pool.each(l_.n_chunks(), [&](std::int64_t chunk, int) {
        partial_[chunk] = linearise_chunk<decltype(lens)::value, decltype(depth)::value>(rows, s, chunk);
      });
    });
    sum_keyframes(pool);
    double total = 0;
    for (double partial : partial_) total += partial;
    return total;
  }

  // Add to B and to the gradient what factors have: n_free x 36 and n_free x 6.
  void add_factors(const double* diagonal, const double* gradient) {
    for (std::int64_t k = 0; k < l_.n_free; ++k)
      for (int i = 0; i < 6; ++i) {
        set(gradient_c[k], i, at(gradient_c[k], i) + gradient[6 * k + i]);
        for (int j = 0; j < 6; ++j) set_entry(b[k], i, j, entry(b[k], i, j) + diagonal[36 * k + 6 * i + j]);
      }
    find_gradient_norm();
  }

  // Registers a record, and those that stage() needs for a slot.
  static constexpr int registers_with(bool depth) { return (D == 9 ? 2 : 1) + (depth ? 1 : 0); }
  static constexpr int staged_with(bool depth) { return kLanes * registers_with(depth) + 2; }

  // Rows of a slot, by lane, into `to`; weights last.
  template <bool kDepth>
  [[gnu::always_inline]] static void stage(const Evaluation& obs, V8* to) {
    constexpr int kRegisters = registers_with(kDepth);
    for (int i = 0; i < 6; ++i) to[i] = obs.d_point[i / 3][i % 3];
    to[6] = obs.residual[0];
    to[7] = obs.residual[1];
    to[kLanes * kRegisters] = obs.weight[0];
    if constexpr (D == 9)
      for (int i = 0; i < 6; ++i) to[kLanes + i] = obs.d_intrinsics[i / 3][i % 3];
    if constexpr (kDepth) {
      V8* last = to + kLanes * (kRegisters - 1);
      for (int i = 0; i < 3; ++i) last[i] = obs.d_point[2][i];
      last[3] = obs.residual[2];
      to[kLanes * kRegisters + 1] = obs.weight[1];
    }
  }

  // The rows of a batch as staged, and what else follows from them at x, for a linearisation to come: that is all but
  // sum_keyframes().
  template <bool kDepth>
  void prepare(std::int64_t batch, const V8 (&x)[3], const PointSums& sums, const V8* rows) {
    for (std::int64_t slot = l_.slot_begin[batch]; slot < l_.slot_begin[batch + 1]; ++slot, rows += staged_with(kDepth))
      write<kDepth>(rows, slot);
    put(batch, x, sums);
  }

  // B and the keyframes' part of the gradient, of what is kept of the observations.
  void sum_keyframes(Pool& pool) {
    const std::int64_t partials = l_.n_lists(), n = l_.n_free;
    const auto sum_list = [this](std::int64_t list, Block<D>& block, Column<D>& gradient) {
      if (l_.has_depth) {
        sum_keyframe<true>(list, block, gradient);
      } else {
        sum_keyframe<false>(list, block, gradient);
      }
    };
    if (partials == 1) {
      pool.each(n, [&](std::int64_t k, int) { sum_list(k, b[k], gradient_c[k]); });
    } else {
      // Each thread what it has obs itself.
      pool.each(partials * kTasksOfList, [&](std::int64_t task, int) {
        const std::int64_t partial = task / kTasksOfList, range = task % kTasksOfList;
        for (std::int64_t i = partial * n + n * range / kTasksOfList; i < partial * n + n * (range + 1) / kTasksOfList;
             ++i)
          sum_list(i, partial_b_[i], partial_gradient_[i]);
      });
      for (std::int64_t k = 0; k < n; ++k) {
        b[k] = partial_b_[k];
        gradient_c[k] = partial_gradient_[k];
        for (std::int64_t i = k + n; i < partials * n; i += n) {
          add(b[k], partial_b_[i]);
          add(gradient_c[k], partial_gradient_[i]);
        }
      }
    }
    find_gradient_norm();
  }

 private:
  // Tasks that the keyframes of a list are summed in.
  static constexpr std::int64_t kTasksOfList = 4;

  void find_gradient_norm() {
    double norm2 = 0;
    for (const auto& x : gradient_c) norm2 += dot(x, x);
    V8 squares{};
    for (const V8& x : gradient_p) squares += x * x;
    gradient_norm = std::sqrt(norm2 + sum(squares));
  }

  template <Lens kLens, bool kDepth>
  double linearise_chunk(const Rows& rows, const StateView& s, std::int64_t chunk) {
    V8 total{};
    for (std::int64_t i = l_.chunks[chunk]; i < l_.chunks[chunk + 1]; ++i) {
      V8 x[3];
      rows.load_points(i, s.points, x);
      PointSums sums{};
      for (std::int64_t slot = l_.slot_begin[i]; slot < l_.slot_begin[i + 1]; ++slot) {
        Images images;
        Evaluation obs;
        V8 staged[staged_with(kDepth)];
        rows.gather<kLens>(slot, images);
        rows.evaluate<kLens, kDepth, true>(slot, images, x, obs);
        add_point_rows<kDepth ? 3 : 2>(obs, sums);
        stage<kDepth>(obs, staged);
        write<kDepth>(staged, slot);
      }
      put(i, x, sums);
      total += sums.cost;
    }
    return 0.5 * sum(total);
  }

  void put(std::int64_t batch, const V8 (&x)[3], const PointSums& sums) {
    for (int j = 0; j < 3; ++j) point[3 * batch + j] = x[j];
    for (int j = 0; j < 6; ++j) c[6 * batch + j] = sums.c[j];
    for (int j = 0; j < 3; ++j) gradient_p[3 * batch + j] = sums.g[j];
  }

  // Records of a slot, of its rows as staged: weighted, by observation.
  template <bool kDepth>
  [[gnu::always_inline]] void write(const V8* staged, std::int64_t slot) {
    constexpr int kRegisters = registers_with(kDepth);
    V8* at = &record[kLanes * slot * kRegisters];
    const auto put_register = [&](int reg, int count, const V8& weight) {
      V8 r[8];
#pragma GCC unroll 8
      for (int i = 0; i < 8; ++i) r[i] = i < count ? weight * staged[kLanes * reg + i] : V8{};
      transpose(r);
#pragma GCC unroll 8
      for (int l = 0; l < kLanes; ++l) at[l * kRegisters + reg] = r[l];
    };
    const V8 weight = root(staged[kLanes * kRegisters]);
    put_register(0, 8, weight);
    if constexpr (D == 9) put_register(1, 6, weight);
    if constexpr (kDepth) put_register(kRegisters - 1, 4, root(staged[kLanes * kRegisters + 1]));
  }

  // B and g of the observations of a list.
  template <bool kDepth>
  void sum_keyframe(std::int64_t list, Block<D>& block, Column<D>& gradient) {
    constexpr int kRows = kDepth ? 3 : 2;
    std::conditional_t<D == 6, Folded, V8> h[D * (D + 1) / 2] = {}, g[D] = {};
    for (std::int64_t first = l_.list_begin[list]; first < l_.list_begin[list + 1]; first += kLanes) {
      V8 j[3][D], r[3];
      fetch_ahead(first, l_.list_begin[list + 1]);
      load_rows<kDepth>(first, j, r);
      int t = 0;
#pragma GCC unroll 9
      for (int m = 0; m < D; ++m) {
#pragma GCC unroll 3
        for (int row = 0; row < kRows; ++row) add_product(g[m], j[row][m], r[row]);
#pragma GCC unroll 9
        for (int n = 0; n <= m; ++n, ++t)
#pragma GCC unroll 3
          for (int row = 0; row < kRows; ++row) add_product(h[t], j[row][m], j[row][n]);
      }
    }
    clear(&block, 1);
    clear(&gradient, 1);
    int t = 0;
    for (int m = 0; m < D; ++m) {
      set(gradient, m, sum(g[m]));
      for (int n = 0; n <= m; ++n, ++t) {
        const double value = sum(h[t]);
        set_entry(block, m, n, value);
        set_entry(block, n, m, value);
      }
    }
  }

  // Records of a keyframe lie far from each other: have the next but one eight brought into the nearest cache.
  [[gnu::always_inline]] void fetch_ahead(std::int64_t first, std::int64_t end) const {
    if (first += 2 * kLanes; first >= end) return;
#pragma GCC unroll 8
    for (int l = 0; l < kLanes; ++l) {
      const V8* next = &record[l_.listed[first + l] * static_cast<std::int64_t>(registers)];
      for (int reg = 0; reg < registers; ++reg) __builtin_prefetch(next + reg);
    }
  }

  // Rows of the Jacobian by the keyframe, and residuals, of eight observations of one keyframe.
  template <bool kDepth>
  [[gnu::always_inline]] void load_rows(std::int64_t first, V8 (&j)[3][D], V8 (&r)[3]) const {
    V8 x[3], t[8];
    const auto read = [&](int reg) {
#pragma GCC unroll 8
      for (int l = 0; l < kLanes; ++l) t[l] = record[l_.listed[first + l] * static_cast<std::int64_t>(registers) + reg];
      transpose(t);
    };
    const double* points = reinterpret_cast<const double*>(point.data());
    const std::int32_t* of_lane = &l_.listed_point[first];
    // Often they are the lanes of a batch.
    const bool is_batch =
        kWhole && l_.listed[first + kLanes - 1] - l_.listed[first] == kLanes - 1 && of_lane[0] % kLanes == 0;
    for (int i = 0; i < 3; ++i)
      x[i] = is_batch ? load(points + of_lane[0] + kLanes * i)
                      : each([=](int l) { return points[of_lane[l] + kLanes * i]; });
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
      read(registers - 1);
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
  std::vector<double> partial_;
  Buffer<Block<D>> partial_b_;  // by list, if a keyframe has several
  Buffer<Column<D>> partial_gradient_;
};

}  // namespace ba::BA_TARGET
