# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the images of one keyframe in a recording that has images, so that residuals can be drawn on them."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ba_node.front_end.images import grey_of
from ba_node.front_end.records import FrontEndError
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.messages.topics import IMAGE_TYPES

# Images are looked for in no more than this of a recording.
_MAX_BYTES = 2**31


def images_of(reader: BagReader, stamp_ns: int, frames: Sequence[str]) -> dict[int, NDArray[np.uint8]]:
    """Return the images (h, w) in grey with a stamp, by the number of the camera whose frame they name.

    A lone camera takes the image of any frame.
    """
    topics = [topic for topic, kind in reader.topics.items() if kind in IMAGE_TYPES]
    found: dict[int, NDArray[np.uint8]] = {}
    read = 0
    for topic, _, _, data in reader.messages(topics) if topics else ():
        read += len(data)
        if read > _MAX_BYTES or len(found) == len(frames):
            break
        # A header begins every message: seconds and nanoseconds, after four bytes that tell the order of bytes.
        order = "<" if data[1:2] == b"\x01" else ">"
        seconds, rest = struct.unpack_from(f"{order}iI", data, 4) if len(data) >= 12 else (-1, 0)
        if seconds * 10**9 + rest == stamp_ns:
            _add(found, reader, topic, data, frames)
    return found


def _add(
    found: dict[int, NDArray[np.uint8]], reader: BagReader, topic: str, data: bytes, frames: Sequence[str]
) -> None:
    try:
        message = reader.decode(topic, data)
        frame = message.header.frame_id
        if frame in frames or len(frames) == 1:
            found[frames.index(frame) if frame in frames else 0] = grey_of(message)
    except (BagError, FrontEndError):
        return  # residuals are drawn without it
