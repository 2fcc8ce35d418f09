# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Pure numerics: geometry, cameras, loss, problem, linear solvers, the solver loop, the named methods."""
