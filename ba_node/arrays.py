# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the types of arrays; shape and unit stand beside each use."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
IdArray = NDArray[np.uint64]
