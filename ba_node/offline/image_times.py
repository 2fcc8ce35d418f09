# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say in words what is odd about the stamps of images: among each other, beside another camera's and an odometry's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ba_node.front_end.streams import NEAR

_NS = 1e-9
# Stamps of at most this share of images are those of a wrong clock if they are so many s, and so many times what the
# others span, away from these.
_FEW, _FAR_S, _TIMES = 0.25, 1000.0, 10.0


def far_off(stamps_ns: Sequence[int]) -> str:
    """Return that few of the images have stamps far ahead of the others, or far behind; empty if none have."""
    stamps = np.unique(stamps_ns)
    if len(stamps) < 3:
        return ""
    gaps = np.diff(stamps)
    at = int(np.argmax(gaps)) + 1
    behind = at < len(stamps) - at
    few, others = (stamps[:at], stamps[at:]) if behind else (stamps[at:], stamps[:at])
    gap_s, span_s = _NS * float(gaps[at - 1]), _NS * float(others[-1] - others[0])
    if len(few) > _FEW * len(stamps) or gap_s < max(_FAR_S, _TIMES * span_s):
        return ""
    which = f"{len(few)} of {len(stamps)} images {'has a stamp' if len(few) == 1 else 'have stamps'}"
    where = f"{gap_s:.0f} s {'behind' if behind else 'ahead of'} the others, from {few[0]} ns on"
    return f"{which} {where}: a wrong clock or name; images are tracked by their stamps"


def of_another(first_ns: Sequence[int], other_ns: Sequence[int]) -> str:
    """Return by how much a camera begins later or ends earlier than the first one; empty if it does neither."""
    if len(first_ns) < 2 or not len(other_ns):
        return ""
    near_s = NEAR * _NS * float(np.median(np.abs(np.diff(first_ns))))
    late_s, early_s = _NS * (min(other_ns) - min(first_ns)), _NS * (max(first_ns) - max(other_ns))
    words = [f"it begins {late_s:.1f} s later"] if late_s > near_s else []
    words += [f"it ends {early_s:.1f} s earlier"] if early_s > near_s else []
    return ", ".join(words)


def of_odometry(images_ns: Sequence[int], span_ns: tuple[int, int] | None) -> str:
    """Return how far an odometry of this first and last stamp misses images; empty if it has them between."""
    if span_ns is None:
        return "it has no poses"
    first, last, begin, end = (_NS * (one - min(images_ns)) for one in (min(images_ns), max(images_ns), *span_ns))
    if begin > last:
        return f"it begins {begin - last:.1f} s after the last image: other clocks, or another drive?"
    if end < first:
        return f"it ends {first - end:.1f} s before the first image: other clocks, or another drive?"
    words = [f"it begins {begin - first:.1f} s after the first image"] if begin > first else []
    words += [f"it ends {last - end:.1f} s before the last image"] if end < last else []
    return ", ".join(words)
