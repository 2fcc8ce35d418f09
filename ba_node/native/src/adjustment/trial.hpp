// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// How well two sets of poses explain some tracks: what window/trial.py describes, without its numpy.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "adjustment/choice.hpp"
#include "targets/target.hpp"

namespace ba {

// As in window/trial.py.
struct TrialLimits {
  double least_parallax, bound, behind;  // sigmas
  std::int64_t least_views, least_residuals;
};

// Two sets of poses, body from world: (n_kf, 3, 3) and (n_kf, 3) m.
struct TwoPoses {
  std::array<const double*, 2> rotation, translation;
};

struct Explained {
  std::array<double, 2> held_out{};
  std::array<std::vector<double>, 2> mean;  // 1 + n_cam
  double parallax = 0.0;                    // rad
  std::vector<double> points;               // (n_groups, 3), those that took no part first
};

// The upper one of two in the middle.
inline double upper_median(std::vector<double>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

class Trial {
 public:
  // rows: the views of n_tried tracks, by track; group: which track each is of; seen: as in rays_of, of each of them.
  Trial(const Target& target, const ProblemView& problem, const RowsOfTracks& rows, const double* seen)
      : target_(target), problem_(problem), n_tried_(rows.n_tracks) {
    for (std::int64_t i = 0; i < rows.n; ++i) take(rows.row[i], rows.track[i], seen ? seen + 3 * i : nullptr);
    const auto n = static_cast<std::int64_t>(views_.size());
    n_groups_ = n_tried_;
    if (problem.n_cameras > 1) {
      // All views of each track, and then those of each camera.
      n_groups_ *= 1 + problem.n_cameras;
      views_.insert(views_.end(), views_.begin(), views_.begin() + n);
      for (std::int64_t i = n; i < 2 * n; ++i)
        views_[i].group = n_tried_ + views_[i].group * problem.n_cameras + problem.camera[views_[i].row];
      std::stable_sort(views_.begin() + n, views_.end(),
                       [](const View& a, const View& b) { return a.group < b.group; });
    }
    for (const View& v : views_) {
      keyframe_.push_back(problem.keyframe[v.row]);
      camera_.push_back(problem.camera[v.row]);
      group_.push_back(v.group);
      uv_.insert(uv_.end(), problem.uv + 2 * v.row, problem.uv + 2 * v.row + 2);
      sigma_.push_back(problem.sigma[v.row]);
      px_per_rad_.push_back(v.px_per_rad);
    }
  }

  Explained explained(const TwoPoses& poses, std::int64_t n_out, const TrialLimits& at) {
    std::array<Seen, 2> seen{of(poses.rotation[0], poses.translation[0]), of(poses.rotation[1], poses.translation[1])};
    const std::vector<char> counts = counted(seen, at);
    Explained out;
    const std::int64_t n_means = 1 + problem_.n_cameras;
    for (int s = 0; s < 2; ++s) {
      std::vector<double> sum(n_means), aside;
      std::vector<std::int64_t> number(n_means);
      for (std::size_t i = 0; i < views_.size(); ++i) {
        const std::int64_t group = group_[i];
        if (!counts[group]) continue;
        // 0 for all cameras together, then each alone; one camera is both.
        const std::int64_t which = group < n_tried_ ? 0 : 1 + camera_[i];
        sum[which] += std::min(seen[s].norms[i], at.bound);
        ++number[which];
        if (group < n_out) aside.push_back(seen[s].norms[i]);
      }
      out.held_out[s] = aside.empty() ? 0.0 : std::min(upper_median(aside), at.behind);
      for (std::int64_t k = 0; k < n_means; ++k)
        out.mean[s].push_back(number[k] >= at.least_residuals ? sum[k] / static_cast<double>(number[k])
                                                              : std::numeric_limits<double>::quiet_NaN());
    }
    std::vector<double> angles(seen[1].parallax.begin(), seen[1].parallax.begin() + n_tried_);
    out.parallax = angles.empty() ? 0.0 : upper_median(angles);
    out.points = std::move(seen[1].points);
    return out;
  }

 private:
  struct View {
    std::int64_t row, group;
    double direction[3], px_per_rad;  // in the body
  };

  struct Seen {
    std::vector<double> points, parallax, norms;  // of groups, and of views
  };

  void take(std::int64_t row, std::int64_t track, const double* seen) {
    const std::int64_t c = problem_.camera[row];
    const double* f = problem_.params + kParams * c;
    double ray[3];
    if (seen != nullptr)
      std::copy_n(seen, 3, ray);
    else
      straight_ray(f, problem_.uv + 2 * row, ray);
    if (!std::isfinite(ray[2])) return;
    View v{row, track, {}, std::sqrt(f[0] * f[1]) / problem_.sigma[row]};
    turn_back(problem_.camera_rotation + 9 * c, ray, v.direction);
    views_.push_back(v);
  }

  // The points, their parallax and the residuals under some poses.
  Seen of(const double* rotation, const double* translation) const {
    const std::vector<double> centres = camera_centres(problem_, rotation, translation);
    const std::vector<double> none(views_.size(), std::numeric_limits<double>::quiet_NaN());
    std::vector<double> centre, direction(3 * views_.size());
    for (std::size_t i = 0; i < views_.size(); ++i) {
      const double* from = centres.data() + 3 * (keyframe_[i] * problem_.n_cameras + camera_[i]);
      centre.insert(centre.end(), from, from + 3);
      turn_back(rotation + 9 * keyframe_[i], views_[i].direction, direction.data() + 3 * i);
    }
    Seen out{std::vector<double>(3 * n_groups_), std::vector<double>(n_groups_), std::vector<double>(views_.size())};
    // std::vector<bool> has no array.
    const std::unique_ptr<bool[]> measured(new bool[std::max<std::int64_t>(n_groups_, 1)]);
    const auto n = static_cast<std::int64_t>(views_.size());
    target_.triangulate(
        {n, group_.data(), centre.data(), direction.data(), px_per_rad_.data(), none.data(), none.data()}, n_groups_,
        out.points.data(), out.parallax.data(), measured.get());
    std::vector<double> at = out.points;
    for (double& x : at)
      if (std::isnan(x)) x = 0.0;
    ProblemView views = problem_;
    views.n_points = n_groups_;
    views.n_obs = n;
    views.keyframe = keyframe_.data();
    views.camera = camera_.data();
    views.point = group_.data();
    views.uv = uv_.data();
    views.sigma = sigma_.data();
    views.depth = views.depth_sigma = nullptr;
    target_.residual_norms(views, {rotation, translation, at.data(), nullptr}, out.norms.data());
    return out;
  }

  // Which groups count: seen by enough keyframes, as any poses explain fewer, by rays that are not parallel by either
  // set, as these meet anywhere.
  std::vector<char> counted(const std::array<Seen, 2>& seen, const TrialLimits& at) const {
    std::vector<char> out(n_groups_);
    if (views_.empty()) return out;
    std::vector<double> sharpness = px_per_rad_;
    const double least = at.least_parallax / upper_median(sharpness);
    std::vector<std::int64_t> keyframes(n_groups_);
    for (std::size_t i = 0; i < views_.size(); ++i)
      keyframes[group_[i]] += i == 0 || group_[i] != group_[i - 1] || keyframe_[i] != keyframe_[i - 1];
    for (std::int64_t g = 0; g < n_groups_; ++g)
      out[g] = keyframes[g] >= at.least_views && seen[0].parallax[g] > least && seen[1].parallax[g] > least;
    return out;
  }

  const Target& target_;
  ProblemView problem_;
  std::int64_t n_tried_, n_groups_ = 0;
  std::vector<View> views_;
  std::vector<std::int64_t> keyframe_, camera_, group_;
  std::vector<double> uv_, sigma_, px_per_rad_;
};

}  // namespace ba
