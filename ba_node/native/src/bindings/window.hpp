// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What windows are chosen and classified by. These calls are short: they keep the GIL, as to ask for it again may take
// longer than they do.
#pragma once

#include <pybind11/pybind11.h>

#include "targets/target.hpp"

namespace ba {

// Of the kernels that do the work.
const Target& active_target();

void bind_window(pybind11::module_& m);

}  // namespace ba
