# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Start values of the experiments: the thesis prints neither the first damping nor the first radius.

They are chosen by what it does print. Time in all over time a solve is the number of solves that 50 steps took: 75 of
DINM, 109 of TNM, 89 of INM, 77 of LMA-CD. With a first mu of 10 nothing is ever rejected (50 solves): it ran at
smaller damping. Of the grid in the experiment ``starts``, mu = 1e-4 and a radius of 0.01 come nearest to the ratio of
TNM's solves to DINM's; objectives and gradients played no part.

Section 4.1 asks for something else: there C is better conditioned than B at first, and ADINM does as DINM. The worst
block of C has a condition of ``|C| / mu``: that is so for a mu of 1 and more alone. Hence MILD there, and wherever
ADINM is compared.

So do the spheres: cameras begin 26 to 76 units from where they belong. A radius of 0.01 doubles a dozen times before it
lets them go there, where the thesis made fewer than ten steps in all on the largest. Hence LARGE, the start values of
``local_dinm``.
"""

from __future__ import annotations

# First mu and radius of the experiments of chapter 3.
MU, RADIUS = "initial_damping=1e-4", "initial_radius=0.01"
START = (MU, RADIUS)
# Those of section 4.1, and of what is compared with ADINM.
MILD = ("initial_damping=10", "initial_radius=1")
# Those of the spheres.
LARGE = ("initial_damping=1", "initial_radius=1")
# Solves that the thesis needs for 50 steps: its time in all over its time a solve (Tables 3.2, 3.5, 3.6, 3.7).
SOLVES = {"DINM": 402.0 / 5.37, "TNM": 678.0 / 6.23, "INM": 388.0 / 4.37, "LMA-CD": 365.0 / 4.73}
