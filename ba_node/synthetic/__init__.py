# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make data with ground truth: what a front-end would publish in a known world, and points on a sphere as a problem."""

from ba_node.synthetic.generate import SyntheticData, generate
from ba_node.synthetic.options import SyntheticOptions, declarations
from ba_node.synthetic.sphere import SphereData, generate_sphere
from ba_node.synthetic.sphere_options import PRESETS, SphereOptions, preset, sphere_declarations

__all__ = [
    "PRESETS",
    "SphereData",
    "SphereOptions",
    "SyntheticData",
    "SyntheticOptions",
    "declarations",
    "generate",
    "generate_sphere",
    "preset",
    "sphere_declarations",
]
