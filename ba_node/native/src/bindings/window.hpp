// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What windows are chosen and classified by.
#pragma once

#include <pybind11/pybind11.h>

#include <cstdint>

#include "targets/target.hpp"

namespace ba {

// Of the kernels that do the work.
const Target& active_target();

template <class F>
auto without_gil(F f) {
  pybind11::gil_scoped_release release;
  return f();
}

// The same for many observations. A window's take less time than other threads may take to give the GIL back.
template <class F>
auto unless_short(std::int64_t n_obs, F f) {
  constexpr std::int64_t kShort = 1 << 16;
  return n_obs <= kShort ? f() : without_gil(f);
}

void bind_window(pybind11::module_& m);
void bind_views(pybind11::module_& m);
void bind_steps(pybind11::module_& m);
void bind_patches(pybind11::module_& m);
void bind_bal(pybind11::module_& m);

}  // namespace ba
