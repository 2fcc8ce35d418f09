// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// What is compiled for several processors lies in a namespace of its own for each, ba::BA_TARGET: baseline (whatever
// the compiler takes for granted), avx2 (with FMA) or avx512. Everything else is compiled once and lies in ba.
//
// The flags stand in targets/*.flags. They have no -ffast-math, which would remove the tests for numbers that are not
// finite; they are tuned for a processor that has all sets of instructions, as compilers then fuse fewer additions into
// chains of multiply-add than in general.
//
// Inline functions of the standard library have no such namespace, and the linker keeps one copy of each. It keeps the
// first, and objects are linked from baseline to avx512: no copy needs more than whoever calls it.
#pragma once

#if !defined(BA_TARGET)
#define BA_TARGET baseline
#endif

namespace ba {

// Numbers that are worked on at once, whatever registers there are.
constexpr int kLanes = 8;

}  // namespace ba
