// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Compiled once for each target.
#include "adjustment/kernel.hpp"

namespace ba::BA_TARGET {

Kernel* make_kernel9(KernelArguments&& arguments) { return new KernelOf<9>(std::move(arguments)); }
SparseFactor* make_factor9(const Rows32& upper) { return new SparseFactorOf<9>(upper); }

}  // namespace ba::BA_TARGET
