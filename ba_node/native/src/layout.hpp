// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// A problem sorted for the kernels: observations by point and keyframe, edges, images. Made once, then only read.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "project.hpp"
#include "simd.hpp"

namespace ba {

// Arrays of the caller; see core/problem.py for shapes. They outlive nothing: copied where kept.
struct ProblemView {
  std::int64_t n_keyframes, n_points, n_obs, n_cameras;
  const std::int64_t *keyframe, *camera, *point;
  const double *uv, *sigma, *depth, *depth_sigma;  // depth null if there is none
  const double *camera_rotation, *camera_translation, *params;
  const std::uint8_t* model;
  const bool* fixed;
};

struct StateView {
  const double *rotation, *translation, *points, *intrinsics;  // intrinsics null if the cameras' own are used
};

class Layout {
 public:
  explicit Layout(const ProblemView& p, bool own_intrinsics) : own_intrinsics(own_intrinsics) {
    sort_observations(p);
    copy_cameras(p);
    find_edges();
    index_edges_by_keyframe();
    find_images();
  }

  // Whether every keyframe has its own f, k1, k2.
  bool own_intrinsics;
  bool has_depth = false;
  Lens lens = Lens::kPinhole;
  std::int64_t n_keyframes = 0, n_points = 0, n_obs = 0, n_cameras = 0, n_free = 0;
  // Observations, padded to whole registers by repeating the last one. obs_edge is -1 where the keyframe is fixed.
  std::vector<std::int32_t> obs_keyframe, obs_camera, obs_point, obs_image, obs_edge;
  Buffer<double> u, v, inverse_sigma, depth, inverse_depth_sigma;
  // Edges: distinct (point, free keyframe), sorted; those of point p are point_edge[p] to point_edge[p + 1].
  std::vector<std::int32_t> edge_column;
  std::vector<std::int64_t> point_edge, edge_point_end;
  // The same by keyframe: edges_of_keyframe[keyframe_edge[k]] to [keyframe_edge[k + 1]].
  std::vector<std::int64_t> keyframe_edge, edges_of_keyframe;
  // Images: distinct keyframe * n_cameras + camera.
  std::vector<std::int64_t> images;
  std::vector<double> camera_rotation, camera_translation, params;
  std::vector<std::uint8_t> model;

 private:
  // Up to this many (keyframe, camera) pairs images are numbered by a table, beyond it by searching.
  static constexpr std::int64_t kTableLimit = std::int64_t{1} << 20;

  std::vector<std::int32_t> column_;  // of each keyframe among the free ones, -1 if fixed

  void sort_observations(const ProblemView& p) {
    n_keyframes = p.n_keyframes;
    n_points = p.n_points;
    n_obs = p.n_obs;
    n_cameras = p.n_cameras;
    has_depth = p.depth != nullptr;
    column_.assign(n_keyframes, -1);
    n_free = 0;
    for (std::int64_t k = 0; k < n_keyframes; ++k)
      if (!p.fixed[k]) column_[k] = static_cast<std::int32_t>(n_free++);
    // Order by (point, keyframe): rows of one edge stand together.
    std::vector<std::int64_t> order(n_obs);
    for (std::int64_t i = 0; i < n_obs; ++i) order[i] = i;
    const auto before = [&p](std::int64_t a, std::int64_t b) {
      return p.point[a] != p.point[b] ? p.point[a] < p.point[b] : p.keyframe[a] < p.keyframe[b];
    };
    // The back-end's windows come in this order already.
    if (!std::is_sorted(order.begin(), order.end(), before)) std::stable_sort(order.begin(), order.end(), before);
    const std::int64_t padded = (n_obs + kLanes - 1) / kLanes * kLanes;
    obs_keyframe.resize(padded);
    obs_camera.resize(padded);
    obs_point.resize(padded);
    u.resize(padded);
    v.resize(padded);
    inverse_sigma.resize(padded);
    if (has_depth) {
      depth.resize(padded);
      inverse_depth_sigma.resize(padded);
    }
    for (std::int64_t i = 0; i < padded; ++i) {
      const std::int64_t o = order[std::min(i, n_obs - 1)];
      obs_keyframe[i] = static_cast<std::int32_t>(p.keyframe[o]);
      obs_camera[i] = static_cast<std::int32_t>(p.camera[o]);
      obs_point[i] = static_cast<std::int32_t>(p.point[o]);
      u[i] = p.uv[2 * o];
      v[i] = p.uv[2 * o + 1];
      inverse_sigma[i] = 1.0 / p.sigma[o];
      if (has_depth) {
        const bool measured = !std::isnan(p.depth[o]);
        depth[i] = measured ? p.depth[o] : 0.0;
        inverse_depth_sigma[i] = measured ? 1.0 / p.depth_sigma[o] : 0.0;
      }
    }
  }

  void copy_cameras(const ProblemView& p) {
    camera_rotation.assign(p.camera_rotation, p.camera_rotation + 9 * n_cameras);
    camera_translation.assign(p.camera_translation, p.camera_translation + 3 * n_cameras);
    params.assign(p.params, p.params + kParams * n_cameras);
    model.assign(p.model, p.model + n_cameras);
    choose_lens();
  }

  void choose_lens() {
    lens = own_intrinsics ? Lens::kRadial : Lens::kPinhole;
    for (std::int64_t c = 0; c < n_cameras; ++c) {
      const double* k = &params[kParams * c];
      Lens need = Lens::kPinhole;
      for (int i = 4; i < kParams; ++i)
        if (k[i] != 0.0) need = std::max(need, i < 6 ? Lens::kRadial : Lens::kRational);
      if (model[c] != 0) need = Lens::kMixed;
      lens = std::max(lens, need);
    }
  }

  void find_edges() {
    point_edge.assign(n_points + 1, 0);
    obs_edge.assign(obs_keyframe.size(), -1);
    std::int64_t i = 0;
    for (std::int64_t p = 0; p < n_points; ++p) {
      std::int32_t last = -1;
      for (; i < n_obs && obs_point[i] == p; ++i) {
        const std::int32_t column = column_[obs_keyframe[i]];
        if (column < 0) continue;
        if (column != last) edge_column.push_back(column);
        last = column;
        obs_edge[i] = static_cast<std::int32_t>(edge_column.size()) - 1;
      }
      point_edge[p + 1] = static_cast<std::int64_t>(edge_column.size());
    }
  }

  void index_edges_by_keyframe() {
    keyframe_edge.assign(n_free + 1, 0);
    for (std::int32_t k : edge_column) ++keyframe_edge[k + 1];
    for (std::int64_t k = 0; k < n_free; ++k) keyframe_edge[k + 1] += keyframe_edge[k];
    edges_of_keyframe.resize(edge_column.size());
    edge_point_end.resize(edge_column.size());
    std::vector<std::int64_t> next(keyframe_edge.begin(), keyframe_edge.end() - 1);
    for (std::int64_t p = 0; p < n_points; ++p) {
      for (std::int64_t e = point_edge[p]; e < point_edge[p + 1]; ++e) {
        edges_of_keyframe[next[edge_column[e]]++] = e;
        edge_point_end[e] = point_edge[p + 1];
      }
    }
  }

  void find_images() {
    const auto key = [this](std::size_t o) {
      return static_cast<std::int64_t>(obs_keyframe[o]) * n_cameras + obs_camera[o];
    };
    obs_image.resize(obs_keyframe.size());
    if (n_keyframes * n_cameras <= kTableLimit) {
      std::vector<std::int32_t> number(n_keyframes * n_cameras, -1);
      for (std::size_t o = 0; o < obs_keyframe.size(); ++o) number[key(o)] = 0;
      for (std::int64_t i = 0; i < n_keyframes * n_cameras; ++i) {
        if (number[i] < 0) continue;
        number[i] = static_cast<std::int32_t>(images.size());
        images.push_back(i);
      }
      for (std::size_t o = 0; o < obs_keyframe.size(); ++o) obs_image[o] = number[key(o)];
      return;
    }
    for (std::size_t o = 0; o < obs_keyframe.size(); ++o) images.push_back(key(o));
    std::sort(images.begin(), images.end());
    images.erase(std::unique(images.begin(), images.end()), images.end());
    for (std::size_t o = 0; o < obs_keyframe.size(); ++o)
      obs_image[o] =
          static_cast<std::int32_t>(std::lower_bound(images.begin(), images.end(), key(o)) - images.begin());
  }
};

}  // namespace ba
