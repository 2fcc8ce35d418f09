# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Experiments on ba_node, which a checkout of the repository has and an installed package has not.

``thesis`` repeats the experiments of the thesis behind the methods (``ba thesis``), ``benchmarks`` compares with other
solvers (``make bench``), ``robustness`` replays recordings gone wrong (``ba robustness``), ``synthetic`` makes
recordings with ground truth (``ba synth``), ``demo`` shows the node at work (``ba demo``).
"""
