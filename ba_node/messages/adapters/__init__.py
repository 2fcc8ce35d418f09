# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Front-ends that exist: what they publish becomes keyframes, tracks, guesses and a rig."""

from ba_node.messages.adapters.adapter import Adapter, AdapterOptions
from ba_node.messages.adapters.rtabmap import Rtabmap, RtabmapMap
from ba_node.messages.adapters.sources import Input, Source
from ba_node.messages.adapters.vins import OpenVins, VinsFusion, VinsMono

__all__ = ["SOURCES", "Adapter", "AdapterOptions", "Input", "Source"]

SOURCES: dict[str, type[Source]] = {
    "openvins": OpenVins,
    "vins_fusion": VinsFusion,
    "vins_mono": VinsMono,
    "rtabmap": Rtabmap,
    "rtabmap_map": RtabmapMap,
}
