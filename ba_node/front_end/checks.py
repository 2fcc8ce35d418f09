# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Look at images before they are used, and say once what is wrong with them."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np

from ba_node.config.front_end import FrontEndOptions
from ba_node.front_end import features, stereo
from ba_node.front_end.frame import Frame
from ba_node.front_end.patches import Floats
from ba_node.front_end.records import Grey, Images
from ba_node.front_end.rectify import IdealRig
from ba_node.measurements import CameraRig

# Spread of grey values below which there is nothing in an image.
_DARK = 2.5
_BACK_NS = 1_000_000_000
# A gap of so many times the two before is a pause, where images come more seldom than max_gap_s says.
_USUAL = 3
# An optical axis farther from the middle than this share of the image is that of another image.
_OFF_CENTRE = 0.25
# Of so many rows two are looked at for a mosaic, whose greens differ from the others by this share.
_ROWS, _MOSAIC = 32, 0.03
# A pair of which so few features have a partner is looked at with left and right exchanged.
_FEW_PARTNERS = 0.25
# No depth camera sees so far, or so near, m.
_FAR_M, _NEAR_M = 200.0, 0.05
# Share of an image that is found in any other by chance.
_STRANGERS = 0.02
# Corners that are tried, their distance from the border and the side of their patches, px.
_TRIED, _RIM, _SIDE = 200, 12, 15


class ImageWatch:
    """Tells a cause once, until it is over."""

    def __init__(self, rig: CameraRig, options: FrontEndOptions) -> None:
        self._rig, self._options = rig, options
        self._told: set[str] = set()
        self.counts: Counter[str] = Counter()  # images by cause
        self._came_ns: int | None = None  # the last stamp, believed or not
        self._before: tuple[Grey, Grey | Floats | None] | None = None  # the last first and second image
        self._gaps_ns = (0, 0)  # the last two between stamps that were believed

    def say(self, cause: str, text: str, notes: list[str]) -> None:
        """Add a note, once until the cause is cleared."""
        self.counts[cause] += 1
        if cause not in self._told:
            self._told.add(cause)
            notes.append(text)

    def clear(self, cause: str) -> None:
        """Take a cause for over."""
        self._told.discard(cause)

    def look(self, images: Images, last_ns: int | None, notes: list[str]) -> Images | None:
        """Return the images as they can be used, None if they cannot."""
        if last_ns is not None and last_ns - _BACK_NS < images.stamp_ns <= last_ns:
            self.say("stamp", f"stamp {images.stamp_ns} ns is not after the one before, {last_ns} ns: left out", notes)
            return None
        if not 1 <= len(images.grey) <= len(self._rig):
            self.say("count", f"{len(images.grey)} images for a rig of {len(self._rig)} cameras: left out", notes)
            return None
        for index, grey in enumerate(images.grey):
            expected = tuple(int(v) for v in self._rig.image_size[index])
            size = (grey.shape[1], grey.shape[0])
            if all(expected) and size != expected:
                self.say(
                    "size",
                    f"camera {index} ({self._rig.names[index]!r}): image of {size[0]} x {size[1]} px where the"
                    f" calibration is for {expected[0]} x {expected[1]}: left out; calibrate at this resolution,"
                    " or scale the calibration",
                    notes,
                )
                return None
            centre = self._rig.intrinsics[index, 2:] / size
            if (np.abs(centre - 0.5) > _OFF_CENTRE).any():
                at, name = self._rig.intrinsics[index, 2:], self._rig.names[index]
                self.say(
                    "centre",
                    f"camera {index} ({name!r}): its optical axis is at {at[0]:.0f}, {at[1]:.0f} px in images of"
                    f" {size[0]} x {size[1]} px: check that its calibration is of this resolution",
                    notes,
                )
        if self._before is None and any(_is_mosaic(grey) for grey in images.grey):
            self.say(
                "mosaic",
                f"images at {images.stamp_ns} ns look like a mosaic of colours taken for grey: give their encoding as"
                " bayer_rggb8, bayer_bggr8, bayer_gbrg8 or bayer_grbg8",
                notes,
            )
        if float(images.grey[0][::4, ::4].std()) < _DARK:
            self.say(
                "dark",
                f"image at {images.stamp_ns} ns shows nothing (black, or covered): the map stays as it is",
                notes,
            )
            return None
        self.clear("dark")
        return self._alone(self._pair(images, notes), notes)

    def believes(self, stamp_ns: int, last_ns: int | None, notes: list[str]) -> bool:
        """Return False for a stamp far ahead of the last believed one until another confirms it: it may be a pause.

        A clock that was set wrong for one image would end the session, and turn away all that comes after it.
        """
        before, self._came_ns = self._came_ns, stamp_ns
        gap_ns = 0 if last_ns is None else stamp_ns - last_ns
        limit_ns = max(self._options.max_gap_s * 1e9, _USUAL * min(self._gaps_ns))
        if last_ns is not None and before is not None and before - stamp_ns > self._options.max_gap_s * 1e9:
            ahead_s = (before - stamp_ns) / 1e9
            self.say("ahead", f"stamp {before} ns is {ahead_s:.1f} s ahead of the one after it: no keyframe", notes)
        if gap_ns > limit_ns and not (before is not None and last_ns is not None and last_ns < before < stamp_ns):
            return False
        self._gaps_ns = self._gaps_ns[1], gap_ns
        return True

    def pause(self, gap_s: float, stamp_ns: int, notes: list[str]) -> None:
        """Say of an image whose pose was found that none came for ``gap_s`` before it; 0 where it came as usual."""
        if gap_s:
            found = "what was seen before is found again, and the session goes on"
            self.say("pause", f"{gap_s:.1f} s without images before {stamp_ns} ns: {found}", notes)
        else:
            self.clear("pause")

    def _alone(self, images: Images, notes: list[str]) -> Images:
        """Return the images without a second one that shows nothing, or no other than before while the first does."""
        second = images.depth_m if len(images.grey) == 1 else images.grey[1]
        before, self._before = self._before, (images.grey[0], second)
        if second is None:
            return images
        what = f"the {'depth' if len(images.grey) == 1 else 'second'} image at {images.stamp_ns} ns"
        if len(images.grey) > 1 and float(second[::4, ::4].std()) < _DARK:
            self.say("second_dark", f"{what} shows nothing (black, or covered): the first is followed alone", notes)
        elif before and _same(second, before[1]) and not _same(images.grey[0], before[0]):
            text = f"{what} is the one before again, and the first is not: does its camera hang? Followed alone"
            self.say("frozen", text, notes)
        else:
            self.clear("second_dark")
            return images
        return dataclasses.replace(images, grey=images.grey[:1], depth_m=None)

    def _pair(self, images: Images, notes: list[str]) -> Images:
        """Return the images without a partner of another time or of another size."""
        limit = self._options.max_skew_s
        if abs(images.skew_ns) > limit * 1e9 and (len(images.grey) > 1 or images.depth_m is not None):
            self.say(
                "skew",
                f"the second image is {images.skew_ns / 1e6:+.1f} ms off the first, more than max_skew_s ="
                f" {1e3 * limit:g} ms: not taken for a pair; let the cameras be triggered together, or raise it"
                " where they are slow",
                notes,
            )
            return dataclasses.replace(images, grey=images.grey[:1], depth_m=None)
        if len(images.grey) > 1 and np.array_equal(images.grey[0], images.grey[1]):
            self.say(
                "same",
                f"both images at {images.stamp_ns} ns are the same picture: not taken for a pair; check the topics",
                notes,
            )
            return dataclasses.replace(images, grey=images.grey[:1])
        if len(images.grey) < len(self._rig) and images.depth_m is None:
            self.say("single", f"no second image at {images.stamp_ns} ns: followed in the first alone", notes)
        if images.depth_m is not None and images.depth_m.shape != images.grey[0].shape:
            found, expected = images.depth_m.shape[::-1], images.grey[0].shape[::-1]
            self.say(
                "depth_size",
                f"depth of {found[0]} x {found[1]} px with an image of {expected[0]} x {expected[1]}: left out; depths"
                " must be registered to the image (aligned_depth_to_color, depth_registered)",
                notes,
            )
            return dataclasses.replace(images, depth_m=None)
        if images.depth_m is not None:
            self._look_at_depth(images.depth_m, images.stamp_ns, notes)
        return images

    def _look_at_depth(self, depth_m: Floats, stamp_ns: int, notes: list[str]) -> None:
        """Say that a depth image is empty, or that its unit seems to be another."""
        some = depth_m[::4, ::4]
        known = some[np.isfinite(some) & (some > 0.0)]
        if not len(known):
            self.say("no_depth", f"depth image at {stamp_ns} ns has no depth (all 0 or NaN): check its topic", notes)
        elif np.median(known) > _FAR_M:
            text = f"depths of {np.median(known):.0f} m (median): 32FC1 is in m, 16UC1 in mm; are these millimetres?"
            self.say("depth_unit", text, notes)
        elif np.median(known) < _NEAR_M:
            text = f"depths of {np.median(known):.3g} m (median): 32FC1 is in m, 16UC1 in mm; are these metres?"
            self.say("depth_unit", text, notes)

    def partners(self, frame: Frame, rig: IdealRig, notes: list[str]) -> None:
        """Say so if left and right seem to be exchanged, or the second image has nothing to do with the first."""
        assert frame.right is not None
        ours = _share(frame, rig)
        if ours > 0.5:
            return  # no other way are more than twice as many
        theirs = _share(Frame(frame.right, frame.grey, None, frame.right_clear, frame.allowed), rig)
        if theirs > 2.0 * ours and theirs > _FEW_PARTNERS:
            self.say(
                "swapped",
                f"left and right images seem to be exchanged: {100 * theirs:.0f} % of them match the other way round,"
                f" {100 * ours:.0f} % as given; exchange the topics, or the cameras in the rig, or turn"
                " both if they are upside down",
                notes,
            )
        elif ours < _STRANGERS:
            self.say(
                "strangers",
                f"only {100 * ours:.0f} % of the first image are found in the second: check that both are of one time"
                " and that the rig is theirs",
                notes,
            )


def _is_mosaic(image: Grey) -> bool:
    """Return whether pixels differ, on average, as the black and the white squares of a chessboard do."""
    if min(image.shape) < 2:
        return False
    upper, lower = (rows.mean(axis=0, dtype=np.float32) for rows in (image[:-1:_ROWS], image[1::_ROWS]))
    differ = (upper - lower)[::2].mean() - (upper - lower)[1::2].mean()
    return bool(abs(differ) > 2.0 * max(_MOSAIC * float(upper.mean()), 1.0))


def _same(image: Grey | Floats, before: Grey | Floats | None) -> bool:
    return before is not None and np.array_equal(image, before)


def _share(frame: Frame, rig: IdealRig) -> float:
    """Return which share of an image's corners has a partner in the other, and is found from there again."""
    assert frame.right is not None
    uv = features.corners(frame.grey, frame.allowed, np.empty((0, 2)), _TRIED, _RIM)
    width = frame.grey.shape[1]
    begin = stereo.look_up(
        stereo.dense(frame.grey, frame.right, width // 5, rig.baseline < 0.0), uv, stereo.smaller(width)
    )
    found = stereo.measure(frame.soft, frame.right_soft, uv, begin, _SIDE, np.zeros(len(uv)))
    return float(found.found.mean()) if len(uv) else 0.0
