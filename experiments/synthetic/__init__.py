# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make data with ground truth: what a front-end would publish in a known world."""

from experiments.synthetic.generate import SyntheticData, generate
from experiments.synthetic.options import SyntheticOptions

__all__ = ["SyntheticData", "SyntheticOptions", "generate"]
