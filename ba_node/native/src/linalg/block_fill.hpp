// Copyright 2026 The ba_node Authors
// SPDX-License-Identifier: Apache-2.0
//
// Which blocks of S, and of its Cholesky factor, are not zero: found once a solve from who observes what.
//
// Two orders of elimination are tried, the caller's (keyframes of a trajectory in turn: a band) and that of least
// degree (George and Liu 1989), and the one whose factor takes fewer operations is taken. Elimination of a block joins
// all its neighbours; what is left of them is the column of the factor. Where the first joins none that were not
// joined, as in most windows, no order takes fewer: columns of length m take sum m (m + 1) / 2 + m operations, which is
// the triangles and twice the edges of the graph of the factor, and no factor has fewer of either than S itself.
#pragma once

#include "linalg/types.hpp"

namespace ba {

// The better of the two orders. upper: pattern of S, rows of the upper triangle with the diagonal first.
Fill find_fill(const Rows32& upper, const FillLimits& limits);

}  // namespace ba
