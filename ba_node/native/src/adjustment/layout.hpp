// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// A problem sorted for the kernels. Made once, then only read.
//
// The words of these files:
//
// - lane:    one of the eight numbers that are worked on at once. Lane l of a batch is its point l.
// - batch:   eight points. Points are numbered anew by their number of observations, most first, so that those of a
//            batch have about as many.
// - slot:    slot j of a batch holds observation j of each of its points; lanes that have fewer are padded. So sums
// over
//            the observations of a point need no gathering, and neither do the points.
// - edge:    a point and a free keyframe that observes it, in however many images.
// - record:  what is kept of an observation where the problem is linearised: its rows of the Jacobian, by registers.
// - section: a quarter of the batches of a problem that is not small. Sections take about as long as one another.
// - chunk:   neighbouring batches of a section that one thread works on, the unit of every loop over points.
// - run:     neighbouring batches all of whose points are seen by the same free keyframes.
// - strip:   neighbouring batches whose blocks Z stay in the nearer caches while S is summed.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "adjustment/types.hpp"
#include "parallel/memory.hpp"
#include "simd/target.hpp"

namespace ba {

// What a whole problem needs; a lane with less distortion has zeros in the rest.
enum class Lens : std::uint8_t { kPinhole, kRadial, kRational, kMixed };

class Layout {
 public:
  Layout(const ProblemView& p, bool own_intrinsics);

  // Whether every keyframe has its own f, k1, k2.
  bool own_intrinsics;
  bool has_depth = false;
  // Whether a keyframe observes a point in more than one image.
  bool has_rigs = false;
  Lens lens = Lens::kPinhole;
  std::int64_t n_keyframes = 0, n_points = 0, n_obs = 0, n_cameras = 0, n_free = 0, n_batches = 0;
  // The caller's number of each point of ours; the last is repeated to fill the last batch.
  Buffer<std::int32_t> point;
  // Slots of batch b: slot_begin[b] to slot_begin[b + 1]. By slot and lane: image, edge that ends here (or -1), whether
  // the edge is that of the slot before (if that happens or depth is measured), what was measured. inverse_sigma is 0
  // where there is nothing.
  Buffer<std::int64_t> slot_begin;
  Buffer<std::int32_t> slot_image, slot_edge;
  Buffer<double> same_edge, u, v, inverse_sigma, depth, inverse_depth_sigma;
  // Edges: distinct (point, free keyframe), sorted; those of our point p are point_edge[p] to point_edge[p + 1].
  Buffer<std::int32_t> edge_column, point_edge, edge_end;  // edge_end: of the edges of the same point
  // The same by keyframe: edges_of_keyframe[keyframe_edge[k]] to [keyframe_edge[k + 1]].
  Buffer<std::int64_t> keyframe_edge;
  Buffer<std::int32_t> edges_of_keyframe;
  // Observations (8 slot + lane) by free keyframe, those of keyframe k in section q (or all, if there are few) from
  // list_begin[q n_free + k] on, filled up to whole registers by one after the last; and where the x of their points
  // stand in registers by batch (three each).
  Buffer<std::int64_t> list_begin;
  Buffer<std::int32_t> listed, listed_point;
  // The caller's number of each free keyframe.
  Buffer<std::int64_t> free_keyframe;
  // Images: distinct keyframe * n_cameras + camera.
  Buffer<std::int64_t> images;
  // First batch of each section and of each chunk, and the number of batches. The problem alone decides them, never the
  // number of threads. A small problem has one section.
  Buffer<std::int64_t> sections, chunks;
  Buffer<double> camera_rotation, camera_translation, params;
  Buffer<std::uint8_t> model;

  std::int64_t n_slots() const { return slot_begin.back(); }
  std::int64_t n_edges() const { return static_cast<std::int64_t>(edge_column.size()); }
  // Pairs of edges of a point, each edge with itself too: what S is summed from.
  std::int64_t n_pairs() const {
    std::int64_t total = 0;
    for (std::int64_t e = 0; e < n_edges(); ++e) total += edge_end[e] - e;
    return total;
  }
  std::int64_t n_chunks() const { return static_cast<std::int64_t>(chunks.size()) - 1; }
  std::int64_t n_sections() const { return static_cast<std::int64_t>(sections.size()) - 1; }
  // How many lists the observations of each keyframe are in.
  std::int64_t n_lists() const { return n_obs >= kMinListedApart * n_free ? n_sections() : 1; }
  // Whether all lanes of a slot have the same image.
  bool has_one_image(std::int64_t slot) const {
    std::uint64_t pairs[kLanes / 2];
    std::memcpy(pairs, &slot_image[kLanes * slot], sizeof(pairs));
    std::uint64_t differ = pairs[0] ^ (pairs[0] << 32 | pairs[0] >> 32);
    for (int i = 1; i < kLanes / 2; ++i) differ |= pairs[0] ^ pairs[i];
    return differ == 0;
  }
  // Lanes of a batch that are points, not padding.
  int lanes(std::int64_t batch) const {
    return static_cast<int>(std::min<std::int64_t>(kLanes, n_points - kLanes * batch));
  }

 private:
  // Observations a keyframe up to which it has one list: each is filled up to a whole register.
  static constexpr std::int64_t kMinListedApart = 128;

  Buffer<std::int32_t> column_;  // of each keyframe among the free ones, -1 if fixed
  Buffer<std::int32_t> table_;   // image of each (keyframe, camera), if there are few

  void copy_cameras(const ProblemView& p);
  void number_keyframes(const ProblemView& p);
  Buffer<std::int64_t> sorted(const ProblemView& p) const;
  Buffer<std::int32_t> points_by_keyframe(const ProblemView& p) const;
  Buffer<std::int64_t> number_points(const ProblemView& p);
  void deal_batches();
  void number_images(const ProblemView& p);
  std::int32_t image_of(std::int64_t key) const;
  void fill_slots(const ProblemView& p, const Buffer<std::int64_t>& order, const Buffer<std::int64_t>& first);
  void find_edges(const ProblemView& p, const Buffer<std::int64_t>& order, const Buffer<std::int64_t>& first);
  void index_by_keyframe();
  void list_observations();
  void cut_chunks();
};

}  // namespace ba
