// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "adjustment/layout.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace ba {

namespace {

// Up to this many (keyframe, camera) pairs images are numbered by a table, beyond it by searching.
constexpr std::int64_t kTableLimit = std::int64_t{1} << 20;
constexpr std::int64_t kSections = 4, kMaxChunks = 32, kMinChunkSlots = 32;
// Batches are dealt to sections in so many deals of neighbours at most, which meet the same keyframes.
constexpr std::int64_t kMaxDeals = 256;

std::int64_t image_key(const ProblemView& p, std::int64_t o) { return p.keyframe[o] * p.n_cameras + p.camera[o]; }

}  // namespace

Layout::Layout(const ProblemView& p, bool own_intrinsics) : own_intrinsics(own_intrinsics) {
  n_keyframes = p.n_keyframes;
  n_points = p.n_points;
  n_obs = p.n_obs;
  n_cameras = p.n_cameras;
  has_depth = p.depth != nullptr;
  copy_cameras(p);
  number_keyframes(p);
  const Buffer<std::int64_t> order = sorted(p), first = number_points(p);
  number_images(p);
  fill_slots(p, order, first);
  find_edges(p, order, first);
  index_by_keyframe();
  cut_chunks();
}

void Layout::copy_cameras(const ProblemView& p) {
  camera_rotation.assign(p.camera_rotation, p.camera_rotation + 9 * n_cameras);
  camera_translation.assign(p.camera_translation, p.camera_translation + 3 * n_cameras);
  params.assign(p.params, p.params + kParams * n_cameras);
  model.assign(p.model, p.model + n_cameras);
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

void Layout::number_keyframes(const ProblemView& p) {
  column_.assign(n_keyframes, -1);
  for (std::int64_t k = 0; k < n_keyframes; ++k) {
    if (p.fixed[k]) continue;
    column_[k] = static_cast<std::int32_t>(n_free++);
    free_keyframe.push_back(k);
  }
}

// Order of the observations by (point, keyframe); empty if that is theirs already, as in the back-end's windows.
Buffer<std::int64_t> Layout::sorted(const ProblemView& p) const {
  const auto before = [&p](std::int64_t a, std::int64_t b) {
    return p.point[a] != p.point[b] ? p.point[a] < p.point[b] : p.keyframe[a] < p.keyframe[b];
  };
  std::int64_t i = 1;
  while (i < n_obs && !before(i, i - 1)) ++i;
  if (i >= n_obs) return {};
  Buffer<std::int64_t> order(n_obs);
  std::iota(order.begin(), order.end(), std::int64_t{0});
  std::stable_sort(order.begin(), order.end(), before);
  return order;
}

// Points by the first keyframe that observes them: neighbours in memory then meet the same keyframes.
Buffer<std::int32_t> Layout::points_by_keyframe(const ProblemView& p) const {
  Buffer<std::int32_t> lowest(n_points, static_cast<std::int32_t>(n_keyframes));
  for (std::int64_t o = 0; o < n_obs; ++o)
    lowest[p.point[o]] = std::min(lowest[p.point[o]], static_cast<std::int32_t>(p.keyframe[o]));
  Buffer<std::int64_t> place(n_keyframes + 2, 0);
  for (std::int32_t k : lowest) ++place[k + 1];
  std::partial_sum(place.begin(), place.end(), place.begin());
  Buffer<std::int32_t> out(n_points);
  for (std::int64_t i = 0; i < n_points; ++i) out[place[lowest[i]]++] = static_cast<std::int32_t>(i);
  return out;
}

// Number points and give batches their slots; returns where each of our points' observations begin, and how many.
Buffer<std::int64_t> Layout::number_points(const ProblemView& p) {
  Buffer<std::int64_t> begin(n_points + 1, 0);
  for (std::int64_t o = 0; o < n_obs; ++o) ++begin[p.point[o] + 1];
  const std::int64_t most = *std::max_element(begin.begin(), begin.end());
  n_batches = (n_points + kLanes - 1) / kLanes;
  point.resize(kLanes * n_batches);
  const Buffer<std::int32_t> by_keyframe = points_by_keyframe(p);
  Buffer<std::int64_t> place(most + 2, 0);  // of the points with so many observations, most first
  for (std::int64_t i = 0; i < n_points; ++i) ++place[most - begin[i + 1] + 1];
  std::partial_sum(place.begin(), place.end(), place.begin());
  for (std::int32_t i : by_keyframe) point[place[most - begin[i + 1]]++] = i;
  deal_batches();
  for (std::int64_t i = n_points; i < kLanes * n_batches; ++i) point[i] = point[n_points - 1];
  slot_begin.assign(n_batches + 1, 0);
  for (std::int64_t b = 0; b < n_batches; ++b) slot_begin[b + 1] = slot_begin[b] + begin[point[kLanes * b] + 1];
  std::partial_sum(begin.begin(), begin.end(), begin.begin());
  Buffer<std::int64_t> first(2 * point.size(), 0);
  for (std::int64_t i = 0; i < n_points; ++i) {
    first[2 * i] = begin[point[i]];
    first[2 * i + 1] = begin[point[i] + 1] - begin[point[i]];
  }
  return first;
}

// Cut the batches into sections that have as many points of many observations as one another. The last batch, which may
// be incomplete, stays the last.
void Layout::deal_batches() {
  sections.push_back(0);
  const std::int64_t whole = n_points / kLanes, deal = std::max<std::int64_t>(1, whole / kMaxDeals);
  if (n_obs >= kSections * kMinChunkSlots * kLanes) {
    Buffer<std::int32_t> dealt;
    dealt.reserve(point.size());
    for (std::int64_t section = 0; section < kSections; ++section) {
      for (std::int64_t first = section * deal; first < whole; first += kSections * deal)
        dealt.insert(dealt.end(), point.begin() + kLanes * first,
                     point.begin() + kLanes * std::min(whole, first + deal));
      if (section + 1 < kSections) sections.push_back(static_cast<std::int64_t>(dealt.size()) / kLanes);
    }
    std::copy(dealt.begin(), dealt.end(), point.begin());
  }
  sections.push_back(n_batches);
}

void Layout::number_images(const ProblemView& p) {
  const std::int64_t pairs = n_keyframes * n_cameras;
  if (pairs > kTableLimit) {
    images.resize(n_obs);
    for (std::int64_t o = 0; o < n_obs; ++o) images[o] = image_key(p, o);
    std::sort(images.begin(), images.end());
    images.erase(std::unique(images.begin(), images.end()), images.end());
    return;
  }
  table_.assign(pairs, -1);
  for (std::int64_t o = 0; o < n_obs; ++o) table_[image_key(p, o)] = 0;
  for (std::int64_t i = 0; i < pairs; ++i) {
    if (table_[i] < 0) continue;
    table_[i] = static_cast<std::int32_t>(images.size());
    images.push_back(i);
  }
}

std::int32_t Layout::image_of(std::int64_t key) const {
  if (!table_.empty()) return table_[key];
  return static_cast<std::int32_t>(std::lower_bound(images.begin(), images.end(), key) - images.begin());
}

void Layout::fill_slots(const ProblemView& p, const Buffer<std::int64_t>& order, const Buffer<std::int64_t>& first) {
  const std::int64_t size = kLanes * n_slots();
  slot_image.assign(size, 0);
  u.assign(size, 0.0);
  v.assign(size, 0.0);
  inverse_sigma.assign(size, 0.0);
  depth.assign(has_depth ? size : 0, 0.0);
  inverse_depth_sigma.assign(depth.size(), 0.0);
  for (std::int64_t i = 0; i < n_points; ++i) {
    for (std::int64_t j = 0; j < first[2 * i + 1]; ++j) {
      const std::int64_t o = order.empty() ? first[2 * i] + j : order[first[2 * i] + j];
      const std::int64_t at = kLanes * (slot_begin[i / kLanes] + j) + i % kLanes;
      slot_image[at] = image_of(image_key(p, o));
      u[at] = p.uv[2 * o];
      v[at] = p.uv[2 * o + 1];
      inverse_sigma[at] = 1.0 / p.sigma[o];
      if (has_depth && !std::isnan(p.depth[o])) {
        depth[at] = p.depth[o];
        inverse_depth_sigma[at] = 1.0 / p.depth_sigma[o];
      }
    }
  }
}

void Layout::find_edges(const ProblemView& p, const Buffer<std::int64_t>& order, const Buffer<std::int64_t>& first) {
  slot_edge.assign(slot_image.size(), -1);
  if (has_depth) same_edge.assign(slot_image.size(), 0.0);
  point_edge.assign(point.size() + 1, 0);
  edge_column.reserve(n_obs);
  for (std::int64_t i = 0; i < n_points; ++i) {
    std::int32_t last = -1;
    for (std::int64_t j = 0; j < first[2 * i + 1]; ++j) {
      const std::int64_t o = order.empty() ? first[2 * i] + j : order[first[2 * i] + j];
      const std::int64_t at = kLanes * (slot_begin[i / kLanes] + j) + i % kLanes;
      const std::int32_t column = column_[p.keyframe[o]];
      if (column < 0) continue;
      if (column == last) {
        has_rigs = true;
        same_edge.resize(slot_image.size(), 0.0);
        same_edge[at] = 1.0;
        slot_edge[at - kLanes] = -1;
      } else {
        edge_column.push_back(column);
      }
      slot_edge[at] = static_cast<std::int32_t>(edge_column.size()) - 1;
      last = column;
    }
    point_edge[i + 1] = static_cast<std::int32_t>(edge_column.size());
  }
  for (std::size_t i = n_points; i < point.size(); ++i) point_edge[i + 1] = point_edge[i];
}

void Layout::index_by_keyframe() {
  keyframe_edge.assign(n_free + 1, 0);
  for (std::int32_t k : edge_column) ++keyframe_edge[k + 1];
  std::partial_sum(keyframe_edge.begin(), keyframe_edge.end(), keyframe_edge.begin());
  edges_of_keyframe.resize(edge_column.size());
  edge_end.resize(edge_column.size());
  Buffer<std::int64_t> next(keyframe_edge.begin(), keyframe_edge.end() - 1);
  for (std::int64_t p = 0; p < n_points; ++p) {
    for (std::int32_t e = point_edge[p]; e < point_edge[p + 1]; ++e) {
      edges_of_keyframe[next[edge_column[e]]++] = e;
      edge_end[e] = point_edge[p + 1];
    }
  }
  list_observations();
}

void Layout::list_observations() {
  const std::int64_t partials = n_lists(), size = kLanes * n_slots();
  const auto lists = static_cast<std::int32_t>(partials * n_free);
  // Where nothing is listed, as beside a batch's shorter points and in fixed keyframes, the list is one more, which is
  // cut off in the end: what is listed follows no pattern that a processor could foresee.
  Buffer<std::int32_t> list_of_image(images.size()), list(size), next(lists + 1, 0);
  for (std::int64_t partial = 0; partial < partials; ++partial) {
    for (std::size_t m = 0; m < images.size(); ++m) {
      const std::int32_t column = column_[images[m] / n_cameras];
      list_of_image[m] = column < 0 ? lists : static_cast<std::int32_t>(partial * n_free) + column;
    }
    const std::int64_t end = partials > 1 ? sections[partial + 1] : n_batches;
    for (std::int64_t at = kLanes * slot_begin[sections[partial]]; at < kLanes * slot_begin[end]; ++at) {
      list[at] = inverse_sigma[at] == 0.0 ? lists : list_of_image[slot_image[at]];
      ++next[list[at]];
    }
  }
  list_begin.assign(lists + 1, 0);
  for (std::int32_t i = 0; i < lists; ++i) list_begin[i + 1] = list_begin[i] + (next[i] + kLanes - 1) / kLanes * kLanes;
  listed.assign(list_begin[lists] + next[lists], static_cast<std::int32_t>(size));
  listed_point.assign(listed.size(), 0);
  std::copy(list_begin.begin(), list_begin.end(), next.begin());
  for (std::int64_t b = 0; b < n_batches; ++b) {
    for (std::int64_t at = kLanes * slot_begin[b]; at < kLanes * slot_begin[b + 1]; ++at) {
      const std::int32_t place = next[list[at]]++;
      listed[place] = static_cast<std::int32_t>(at);
      listed_point[place] = static_cast<std::int32_t>(3 * kLanes * b + at % kLanes);
    }
  }
  listed.resize(list_begin[lists]);
  listed_point.resize(list_begin[lists]);
}

void Layout::cut_chunks() {
  const std::int64_t most = kMaxChunks / n_sections(), least = n_sections() * kMinChunkSlots;
  const std::int64_t count = n_sections() == 1 ? 1 : std::clamp<std::int64_t>(n_slots() / least, 1, most);
  chunks.push_back(0);
  for (std::int64_t section = 0; section < n_sections(); ++section) {
    const std::int64_t first = slot_begin[sections[section]], slots = slot_begin[sections[section + 1]] - first;
    for (std::int64_t i = 1; i <= count; ++i) {
      const auto end = std::lower_bound(slot_begin.begin(), slot_begin.end(), first + slots * i / count);
      chunks.push_back(std::max<std::int64_t>(chunks.back(), end - slot_begin.begin()));
    }
    chunks.back() = sections[section + 1];
  }
}

}  // namespace ba
