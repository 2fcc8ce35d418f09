// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
#include "targets/target.hpp"

namespace ba {

// Here, so that no target has the only copy of what they share.
Kernel::~Kernel() = default;
SparseFactor::~SparseFactor() = default;
RelativePoseFactors::~RelativePoseFactors() = default;

}  // namespace ba
