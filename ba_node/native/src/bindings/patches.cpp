// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>

#include "bindings/arrays.hpp"
#include "bindings/window.hpp"
#include "targets/target.hpp"

namespace ba {

namespace {

using Floats = Array<float>;

ImageView view_of(const Floats& image) { return {image.data(), image.shape(0), image.shape(1)}; }

Floats cut(const Floats& image, const Doubles& uv, const Floats& offsets) {
  const py::ssize_t n = uv.shape(0), m = offsets.shape(0);
  Floats values({n, m});
  float* out = values.mutable_data();
  without_gil([&] { active_target().cut_patches(view_of(image), uv.data(), n, offsets.data(), m, out); });
  return values;
}

// patches: of patches.cut, prior, grid and window; bend may be empty; limits as AlignLimits.
py::tuple align(const Floats& image, const std::tuple<Floats, Doubles, Floats, Floats>& patches, const Doubles& uv,
                const Doubles& affine, const Doubles& bend,
                const std::tuple<int, double, double, float, double>& limits) {
  const auto& [values, prior, grid, window] = patches;
  const auto& [iterations, step_px, farthest_px, least_variance, least_hessian] = limits;
  const py::ssize_t n = uv.shape(0), k = prior.size(), two = 2;
  Doubles place({n, two}), shape({n, two, two}), correlation({n}), left({n}), inverse({n, k, k});
  std::copy_n(uv.data(), 2 * n, place.mutable_data());
  std::copy_n(affine.data(), 4 * n, shape.mutable_data());
  std::fill_n(correlation.mutable_data(), n, 0.0);
  std::fill_n(left.mutable_data(), n, std::numeric_limits<double>::infinity());
  const PatchesView view{n,           values.shape(1), values.shape(2), k,           window.size(), values.data(),
                         grid.data(), window.data(),   prior.data()};
  const PlacesSpan to{place.mutable_data(), shape.mutable_data(), correlation.mutable_data(), left.mutable_data(),
                      inverse.mutable_data()};
  const AlignLimits limit{iterations, step_px, farthest_px, least_variance, least_hessian};
  const double* bends = bend.size() ? bend.data() : nullptr;
  without_gil([&] { active_target().align_patches(view_of(image), view, limit, bends, to); });
  return py::make_tuple(place, shape, correlation, left, inverse);
}

// seen: points, along, uv, sigma and (focal, u, v) of the camera.
py::tuple equations(const std::tuple<Doubles, Doubles, Doubles, Doubles, Doubles>& seen, const Doubles& rotation,
                    const Doubles& translation, double cauchy) {
  const auto& [points, along, uv, sigma, camera] = seen;
  const py::ssize_t n = points.shape(0);
  Doubles matrix({py::ssize_t{6}, py::ssize_t{6}}), vector(py::ssize_t{6}), size(n);
  const SeenView view{n, points.data(), along.data(), uv.data(), sigma.data(), camera.data()};
  const PoseEquationsSpan to{matrix.mutable_data(), vector.mutable_data(), size.mutable_data()};
  without_gil([&] { active_target().pose_equations(view, rotation.data(), translation.data(), cauchy, to); });
  return py::make_tuple(matrix, vector, size);
}

}  // namespace

void bind_patches(py::module_& m) {
  m.def("cut_patches", &cut);
  m.def("align_patches", &align);
  m.def("pose_equations", &equations);
}

}  // namespace ba
