# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-end: images in; keyframes, feature tracks and first points out, for the back-end or any other."""

from ba_node.front_end.front_end import FrontEnd
from ba_node.front_end.images import grey_of
from ba_node.front_end.records import FrontEndError, Grey, Images, State, Tracked

__all__ = ["FrontEnd", "FrontEndError", "Grey", "Images", "State", "Tracked", "grey_of"]
