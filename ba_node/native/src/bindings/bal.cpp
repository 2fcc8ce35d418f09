// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Problems of BAL: the numbers of their text, and what they hold in the terms of core/problem.py.
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstddef>
#include <string_view>
#include <system_error>
#include <utility>

#include "adjustment/retract.hpp"
#include "bindings/arrays.hpp"
#include "bindings/window.hpp"

namespace ba {

namespace {

bool is_space(char c) { return c == ' ' || (c >= '\t' && c <= '\r'); }

// The numbers of a text between white space; None where something in it is no finite number as C++ reads them.
py::object numbers(const py::bytes& bytes) {
#if defined(__cpp_lib_to_chars)
  const std::string_view text(bytes);
  std::size_t n = 0;
  bool between = true;
  for (const char c : text) {
    const bool space = is_space(c);
    n += between && !space;
    between = space;
  }
  Doubles out = empty({static_cast<py::ssize_t>(n)});
  double* value = out.mutable_data();
  const bool sound = without_gil([&] {
    const char *at = text.data(), *end = at + text.size();
    for (; at != end; ++at) {
      if (is_space(*at)) continue;
      const auto [next, error] = std::from_chars(at, end, *value);
      if (error != std::errc() || !std::isfinite(*value) || (next != end && !is_space(*next))) return false;
      ++value;
      if (next == end) break;
      at = next;
    }
    return true;
  });
  if (sound) return std::move(out);
#endif
  return py::none();
}

// cameras: (n, 9), uv: (n_obs, 2), as io/bal.py has them. None unless observations are sorted by point.
py::object from_bal(const Doubles& cameras, const Ints& point, const Doubles& uv) {
  const std::int64_t* of = point.data();
  if (cameras.ndim() != 2 || cameras.shape(1) != 9 || uv.ndim() != 2 || uv.shape(1) != 2 || point.size() != uv.shape(0))
    throw py::value_error("expected cameras (n, 9), point (n_obs,) and uv (n_obs, 2)");
  if (!std::is_sorted(of, of + point.size())) return py::none();
  const py::ssize_t n = cameras.shape(0), n_obs = uv.shape(0);
  Doubles rotation = empty({n, 3, 3}), translation = empty({n, 3}), intrinsics = empty({n, 3});
  Doubles image = empty({n_obs, 2}), sigma = empty({n_obs});
  Ints camera({n_obs});
  double *turn = rotation.mutable_data(), *move = translation.mutable_data(), *lens = intrinsics.mutable_data();
  for (const double* own = cameras.data(); own != cameras.data() + 9 * n; own += 9, turn += 9, move += 3, lens += 3) {
    BA_TARGET::so3_exp(own, turn);
    std::copy_n(own + 3, 3, move);
    std::copy_n(own + 6, 3, lens);
  }
  const double* from = uv.data();
  double* to = image.mutable_data();
  for (py::ssize_t o = 0; o < n_obs; ++o) {
    to[2 * o] = from[2 * o];
    to[2 * o + 1] = -from[2 * o + 1];
  }
  std::fill_n(sigma.mutable_data(), n_obs, 1.0);
  std::fill_n(camera.mutable_data(), n_obs, 0);
  return py::make_tuple(rotation, translation, intrinsics, image, camera, sigma);
}

}  // namespace

void bind_bal(py::module_& m) {
  m.def("numbers", &numbers);
  m.def("from_bal", &from_bal);
}

}  // namespace ba
