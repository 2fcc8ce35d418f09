# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All claims of the thesis, in its order."""

from __future__ import annotations

from experiments.thesis.claims_chapter3 import CHAPTER_3
from experiments.thesis.claims_chapter45 import CHAPTER_4, CHAPTER_5
from experiments.thesis.verdicts import Claim

CLAIMS: tuple[Claim, ...] = (*CHAPTER_3, *CHAPTER_4, *CHAPTER_5)
