// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Compiled once for each target: its table, and the kernels that keep nothing.
#include "adjustment/consensus.hpp"
#include "adjustment/norms.hpp"
#include "adjustment/relative_poses.hpp"
#include "adjustment/resection.hpp"
#include "adjustment/triangulate.hpp"
#include "front_end/patches.hpp"
#include "front_end/pose.hpp"
#include "targets/target.hpp"

#define BA_QUOTED(name) #name
#define BA_NAME(name) BA_QUOTED(name)

namespace ba::BA_TARGET {

namespace {

RelativePoseFactors* make_relative_poses(const RelativePosesView& view) { return new RelativePoses(view); }

void triangulate(const RaysView& rays, std::int64_t n_points, double* points, double* parallax, bool* measured) {
  Triangulator(rays, n_points).run(points, parallax, measured);
}

void agreeing(const RaysView& rays, std::int64_t n_points, double gate, bool* agrees) {
  Consensus(rays, n_points, gate).run(agrees);
}

}  // namespace

const Target kTarget{BA_NAME(BA_TARGET),  make_kernel6,   make_kernel9,  make_factor6,  make_factor9,
                     make_relative_poses, residual_norms, resect,        triangulate,   agreeing,
                     consensus,           cut_patches,    align_patches, pose_equations};

}  // namespace ba::BA_TARGET
