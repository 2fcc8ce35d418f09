# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the back-end as a ROS 2 node; the only place that imports rclpy and message packages."""

import os

# OpenBLAS, numpy's and scipy's, shares a Cholesky of 120 unknowns or more among its threads and waits for all of them:
# with 180 that takes 0.2 ms, and half a second where the cores are busy. It looks when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
