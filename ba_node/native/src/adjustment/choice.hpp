// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What of a window takes part in its solve: rays of views, which of them determine anything, which points move. Not
// compiled for each target, so that all give the same.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "adjustment/types.hpp"
#include "adjustment/views.hpp"

namespace ba {

// Where rays are written: as RaysView.
struct RaysSpan {
  double *centre, *direction, *px_per_rad, *distance, *distance_sigma;
};

// As in core/triangulation.py: of the angle between a ray and its camera's axis, where a depth tells a distance.
constexpr double kLeastCosine = 0.01;

// out = a' b.
inline void turn_back(const double* a, const double* b, double* out) {
  for (int i = 0; i < 3; ++i) out[i] = a[i] * b[0] + a[3 + i] * b[1] + a[6 + i] * b[2];
}

// The ray of a pixel of a camera without distortion, in the camera: a unit vector.
inline void straight_ray(const double* params, const double* uv, double* ray) {
  const double x = (uv[0] - params[2]) / params[0], y = (uv[1] - params[3]) / params[1];
  const double length = std::sqrt(x * x + y * y + 1.0);
  ray[0] = x / length;
  ray[1] = y / length;
  ray[2] = 1.0 / length;
}

// Where the cameras of each keyframe are: (n_keyframes, n_cameras, 3) m.
inline std::vector<double> camera_centres(const ProblemView& p, const double* rotation, const double* translation) {
  std::vector<double> centres(3 * p.n_keyframes * p.n_cameras);
  for (std::int64_t c = 0; c < p.n_cameras; ++c) {
    double body[3];
    turn_back(p.camera_rotation + 9 * c, p.camera_translation + 3 * c, body);
    for (std::int64_t k = 0; k < p.n_keyframes; ++k) {
      double from[3];
      for (int i = 0; i < 3; ++i) from[i] = -body[i] - translation[3 * k + i];
      turn_back(rotation + 9 * k, from, centres.data() + 3 * (k * p.n_cameras + c));
    }
  }
  return centres;
}

// The rays of all observations at some poses; false if one of them has none. seen: (n_obs, 3) unit vectors in the
// cameras, null for cameras without distortion.
inline bool rays_of(const ProblemView& p, const StateView& s, const double* seen, const RaysSpan& out) {
  const std::vector<double> centres = camera_centres(p, s.rotation, s.translation);
  bool good = true;
  for (std::int64_t o = 0; o < p.n_obs; ++o) {
    const std::int64_t c = p.camera[o], k = p.keyframe[o];
    const double* f = p.params + kParams * c;
    double ray[3], body[3];
    if (seen != nullptr)
      std::copy_n(seen + 3 * o, 3, ray);
    else
      straight_ray(f, p.uv + 2 * o, ray);
    turn_back(p.camera_rotation + 9 * c, ray, body);
    turn_back(s.rotation + 9 * k, body, out.direction + 3 * o);
    std::copy_n(centres.data() + 3 * (k * p.n_cameras + c), 3, out.centre + 3 * o);
    out.px_per_rad[o] = std::sqrt(f[0] * f[1]) / p.sigma[o];
    // A depth is along the axis: of a ray that is across it, or points back, it tells no distance.
    const bool tells = p.depth != nullptr && ray[2] > kLeastCosine;
    const double along = tells ? 1.0 / ray[2] : std::numeric_limits<double>::quiet_NaN();
    out.distance[o] = tells ? p.depth[o] * along : along;
    out.distance_sigma[o] = tells ? p.depth_sigma[o] * along : along;
    good &= std::isfinite(out.direction[3 * o + 2]);
  }
  return good;
}

// Whether no camera has distortion, so that straight_ray has its rays.
inline bool all_straight(const ProblemView& p) {
  for (std::int64_t c = 0; c < p.n_cameras; ++c) {
    const double* f = p.params + kParams * c;
    if (p.model[c] != 0 || std::any_of(f + 4, f + kParams, [](double k) { return k != 0.0; })) return false;
  }
  return true;
}

// Observations of tracks: n of them, by track.
struct RowsOfTracks {
  std::int64_t n, n_tracks;
  const std::int64_t *row, *track;
};

// Observations sorted by point and keyframe. depth null if there is none.
struct UsableView {
  std::int64_t n;
  const std::int64_t *point, *keyframe;
  const bool* usable;
  const double* depth;
};

// Of a keyframe: whether it may take part, how many points that count it has to see, and how many observations of them.
struct LeastSeen {
  const bool* may;
  const std::int64_t* points;
  std::int64_t observations;
};

// Which keyframes and points are left once all is gone that determines nothing; see determined in window/problems.py.
class Determined {
 public:
  Determined(const UsableView& seen, const bool* counts, const LeastSeen& least)
      : seen_(seen), counts_(counts), least_(least) {}

  void run() {
    while (keyframes(), points()) {
    }
  }

  // The observations of what is left.
  std::vector<std::int64_t> rows() const {
    std::vector<std::int64_t> out;
    for (std::int64_t o = 0; o < seen_.n; ++o)
      if (keep_points[seen_.point[o]] && keep_keyframes[seen_.keyframe[o]]) out.push_back(o);
    return out;
  }

  std::vector<char> keep_points, keep_keyframes;

 private:
  bool used(std::int64_t o) const { return seen_.usable[o] && keep_points[seen_.point[o]]; }

  void keyframes() {
    std::vector<std::int64_t> observations(keep_keyframes.size()), points(keep_keyframes.size());
    for (std::int64_t o = 0; o < seen_.n; ++o) {
      if (!used(o) || !counts_[seen_.point[o]]) continue;
      const std::int64_t k = seen_.keyframe[o];
      ++observations[k];
      // Views of a point by several cameras of a keyframe are neighbours, and count once.
      points[k] += o == 0 || seen_.point[o] != seen_.point[o - 1] || k != seen_.keyframe[o - 1];
    }
    for (std::size_t k = 0; k < keep_keyframes.size(); ++k)
      keep_keyframes[k] = least_.may[k] && observations[k] >= least_.observations && points[k] >= least_.points[k];
  }

  // Whether one was left out.
  bool points() {
    std::vector<std::int64_t> views(keep_points.size());
    for (std::int64_t o = 0; o < seen_.n; ++o) {
      if (!used(o) || !keep_keyframes[seen_.keyframe[o]]) continue;
      // A measured depth is as good as another view.
      views[seen_.point[o]] += seen_.depth != nullptr && std::isfinite(seen_.depth[o]) ? 2 : 1;
    }
    bool changed = false;
    for (std::size_t p = 0; p < keep_points.size(); ++p) {
      if (!keep_points[p] || views[p] >= 2) continue;
      keep_points[p] = 0;
      changed = true;
    }
    return changed;
  }

  UsableView seen_;
  const bool* counts_;
  LeastSeen least_;
};

// Residuals, sigmas, each to be divided by what its keyframe is off.
struct ResidualsView {
  std::int64_t n;
  const std::int64_t *point, *keyframe;
  const double *norms, *off;
};

// As in window/moving.py.
struct MotionLimits {
  double large, mismatch, bound, least_large, large_share;
};

// Which points leave more than noise in most of their views: (n_points,).
inline void leave_more_than_noise(const ResidualsView& seen, std::int64_t n_points, const MotionLimits& at,
                                  bool* found) {
  struct Sums {
    double total = 0.0;
    std::int64_t count = 0, large = 0;
  };
  std::vector<Sums> sums(n_points);
  for (std::int64_t o = 0; o < seen.n; ++o) {
    const double norm = seen.norms[o] / seen.off[seen.keyframe[o]];
    if (!(norm < at.mismatch)) continue;
    Sums& of = sums[seen.point[o]];
    const double counts = std::min(norm, at.bound);
    of.total += counts * counts;
    ++of.count;
    of.large += norm > at.large;
  }
  for (std::int64_t p = 0; p < n_points; ++p) {
    const auto count = static_cast<double>(sums[p].count), large = static_cast<double>(sums[p].large);
    found[p] =
        large >= at.least_large && sums[p].total > at.large * at.large * count && large >= at.large_share * count;
  }
}

// As in window/moving.py: what noise has at a rank, a share of all, and of how many at least.
struct NoiseLimits {
  double at_rank, rank;
  std::int64_t known;
};

// How many times as large as noise the better ones of some residuals are, 1 or more; they change their order.
inline double times_noise(std::vector<double>& norms, const NoiseLimits& at) {
  const auto n = std::count_if(norms.begin(), norms.end(), [](double norm) { return std::isfinite(norm); });
  const auto rank = static_cast<std::ptrdiff_t>(at.rank * static_cast<double>(n));
  const auto noise = [&at](double norm) { return norm <= at.at_rank; };
  if (n < at.known || std::count_if(norms.begin(), norms.end(), noise) > rank) return 1.0;
  std::nth_element(norms.begin(), norms.begin() + rank, norms.end());
  return std::max(1.0, norms[static_cast<std::size_t>(rank)] / at.at_rank);
}

// How many times as large as noise the residuals of each keyframe are where it begins, (n_keyframes,): as those of all
// are, or its own, if no solve has refined its pose yet.
inline std::vector<double> off_noise(const ResidualsView& seen, const bool* unrefined, std::int64_t n_keyframes,
                                     const NoiseLimits& at) {
  std::vector<double> norms(seen.norms, seen.norms + seen.n);
  std::vector<double> off(n_keyframes, times_noise(norms, at));
  for (std::int64_t k = 0; k < n_keyframes; ++k) {
    if (!unrefined[k]) continue;
    norms.clear();
    for (std::int64_t o = 0; o < seen.n; ++o)
      if (seen.keyframe[o] == k) norms.push_back(seen.norms[o]);
    off[k] = std::max(off[k], times_noise(norms, at));
  }
  return off;
}

// As in window/trial.py: how many points are wanted, of more views than so many, and the multiplier of ids.
struct TriedLimits {
  std::int64_t wanted, least_views;
  std::uint64_t hash;
};

// The points to try poses on, in the order of their keys: those with the lowest, whatever else there is.
inline std::vector<std::int64_t> to_try(const std::uint64_t* track_id, std::int64_t n_points, const RowsView& points,
                                        const TriedLimits& at) {
  std::vector<std::int64_t> views(n_points), found;
  for (std::int64_t i = 0; i < points.n; ++i) ++views[points.row[i]];
  const auto list = [&](std::int64_t more_than) {
    found.clear();
    for (std::int64_t p = 0; p < n_points; ++p)
      if (views[p] > more_than) found.push_back(p);
  };
  list(at.least_views);
  if (static_cast<std::int64_t>(found.size()) < at.wanted) list(1);
  const auto before = [&](std::int64_t a, std::int64_t b) { return track_id[a] * at.hash < track_id[b] * at.hash; };
  const std::int64_t most = std::min<std::int64_t>(std::max<std::int64_t>(at.wanted, 0), found.size());
  std::partial_sort(found.begin(), found.begin() + most, found.end(), before);
  found.resize(most);
  return found;
}

// Views sorted by point; norms in sigmas.
struct NormsByPoint {
  std::int64_t n, n_points;
  const std::int64_t* point;
  const double* norms;
};

// As in window/merging.py: of norms, m, and a share.
struct ReturnLimits {
  double gate, far, leap;
};

// Of points (n, 3) that began at others: which are far away from a centre, which began there, which have leapt.
struct AwaySpan {
  bool *away, *began, *leapt, *doubted;
  std::int64_t* agreeing;  // views within the gate
};

// Which points may have run away: those that are far away, have leapt, or have few views that agree. measured: null, or
// points whose distance was, which are nowhere far away.
inline void may_have_run_away(const NormsByPoint& seen, const double* points, const double* start, const double* centre,
                              const bool* measured, const ReturnLimits& at, const AwaySpan& out) {
  std::vector<std::int64_t> views(seen.n_points);
  std::fill_n(out.agreeing, seen.n_points, 0);
  for (std::int64_t o = 0; o < seen.n; ++o) {
    ++views[seen.point[o]];
    out.agreeing[seen.point[o]] += seen.norms[o] <= at.gate;
  }
  const auto apart = [](const double* a, const double* b) {
    return std::max({std::abs(a[0] - b[0]), std::abs(a[1] - b[1]), std::abs(a[2] - b[2])});
  };
  for (std::int64_t p = 0; p < seen.n_points; ++p) {
    const double *now = points + 3 * p, *before = start + 3 * p, from = apart(before, centre);
    const bool may = measured == nullptr || !measured[p];
    out.away[p] = may && apart(now, centre) > at.far;
    out.began[p] = may && from > at.far;
    out.leapt[p] = apart(now, before) > at.leap * from;
    out.doubted[p] = out.away[p] || out.leapt[p] || 2 * out.agreeing[p] < views[p];
  }
}

// Which views are off by more than a norm `far` from those before and after them of the same point, and from those of
// the same camera; an end counts as far from its one neighbour alone, and views of a camera that has one as far from
// all. As _mismatches in window/moving.py, for views sorted by point.
inline void stand_out(const NormsByPoint& seen, const std::int64_t* camera, std::int64_t n_cameras, double far,
                      bool* found) {
  std::vector<std::int64_t> last(n_cameras, -1);
  const auto rises = [&](std::int64_t from, std::int64_t to) { return seen.norms[to] - seen.norms[from] > far; };
  std::vector<char> before(seen.n, 1), after(seen.n, 1);
  for (std::int64_t o = 0; o < seen.n; ++o) {
    const bool goes_on = o > 0 && seen.point[o] == seen.point[o - 1];
    if (!goes_on) std::fill(last.begin(), last.end(), -1);
    found[o] = goes_on && rises(o - 1, o);
    if (o + 1 < seen.n && seen.point[o + 1] == seen.point[o])
      found[o] = found[o] && rises(o + 1, o);
    else
      found[o] = false;
    const std::int64_t own = last[camera[o]];
    if (own >= 0) {
      before[o] = rises(own, o);
      after[own] = rises(o, own);
    }
    last[camera[o]] = o;
  }
  for (std::int64_t o = 0; o < seen.n; ++o) found[o] = found[o] && before[o] && after[o];
}

// As in window/initial_points.py; rad, and standard deviations.
struct AgreementLimits {
  double gate, min_parallax, least_parallax, two_views, least_support;
};

// Of which points the rays that agree tell the place: (n_points,). parallax, measured and agrees are of consensus.
inline void tells_place(const RaysView& rays, std::int64_t n_points, const double* points, const double* parallax,
                        const bool* measured, const bool* agrees, const AgreementLimits& at, bool* good) {
  struct Views {
    std::int64_t all = 0, agreeing = 0;
    double sharpness = 0.0, worst = 0.0;
  };
  std::vector<Views> views(n_points);
  for (std::int64_t o = 0; o < rays.n_rays; ++o) {
    Views& of = views[rays.point[o]];
    ++of.all;
    if (!agrees[o]) continue;
    ++of.agreeing;
    of.sharpness = std::max(of.sharpness, rays.px_per_rad[o]);
    const double *d = rays.direction + 3 * o, *c = rays.centre + 3 * o, *x = points + 3 * rays.point[o];
    const double away[3] = {x[0] - c[0], x[1] - c[1], x[2] - c[2]};
    const double cross[3] = {d[1] * away[2] - d[2] * away[1], d[2] * away[0] - d[0] * away[2],
                             d[0] * away[1] - d[1] * away[0]};
    const double length = std::sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2]);
    const double across = std::sqrt(cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);
    const bool before = d[0] * away[0] + d[1] * away[1] + d[2] * away[2] > 0.0;
    const double error = rays.px_per_rad[o] * (across / std::max(length, 1e-300));
    of.worst = std::max(of.worst, before ? error : std::numeric_limits<double>::infinity());
  }
  for (std::int64_t p = 0; p < n_points; ++p) {
    const Views& of = views[p];
    const bool wide = parallax[p] >= at.min_parallax && parallax[p] * of.sharpness >= at.least_parallax;
    const bool fits = of.worst <= at.gate * (of.agreeing > 2 ? 1.0 : at.two_views);
    const bool many = static_cast<double>(of.agreeing) > at.least_support * static_cast<double>(of.all);
    good[p] = ((wide && of.agreeing >= 2) || measured[p]) && fits && many;
  }
}

}  // namespace ba
