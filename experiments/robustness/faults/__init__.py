# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings as they go wrong in practice, with the truth: one function a fault, in one line, the same by seed."""

from experiments.robustness.faults.catalogue import FAULTS
from experiments.robustness.faults.fault import MONO, RGBD, RIGS, STEREO, Fault
from experiments.robustness.faults.recording import Recording, without_outliers
from experiments.robustness.faults.spoil import SOUND, spoiled

__all__ = ["FAULTS", "MONO", "RGBD", "RIGS", "SOUND", "STEREO", "Fault", "Recording", "spoiled", "without_outliers"]
