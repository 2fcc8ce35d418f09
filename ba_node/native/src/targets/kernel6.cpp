// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Compiled once for each target.
#include "adjustment/kernel.hpp"

namespace ba::BA_TARGET {

Kernel* make_kernel6(KernelArguments&& arguments) { return new KernelOf<6>(std::move(arguments)); }
SparseFactor* make_factor6(const Rows32& upper) { return new SparseFactorOf<6>(upper); }

}  // namespace ba::BA_TARGET
