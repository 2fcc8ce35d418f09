# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Count what is turned away, by reason, and keep the last few cases in words."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

from ba_node.measurements import Measurement

# Reason -> what was turned away and why. The keys are published in ba_msgs/SolverReport.
REASONS: dict[str, str] = {
    "malformed": "A message whose arrays do not fit together.",
    "non_finite": "An observation with u, v or sigma not finite.",
    "out_of_range": "An observation with |u| or |v| above 1e6 px.",
    "bad_sigma": "An observation whose sigma is outside [1e-6, 1e6] px.",
    "bad_depth": "A depth outside [1e-3, 1e6] m or infinite; the pixel is used without it.",
    "bad_pose": "A keyframe whose position is not finite or beyond 1e9 m, or whose quaternion is not finite or zero.",
    "bad_guess": "A guess that is not finite or beyond 1e12 m.",
    "bad_rig": "A camera rig without cameras, with a k, region or binning that no camera has, or with poses that are"
    " not finite or quaternions that are zero.",
    "unknown_model": "A camera rig with a camera that cannot be used (distortion model, coefficients).",
    "rig_changed": "Another camera rig while a session has observations; it is used from the next session on.",
    "unknown_camera": "A tracks message whose camera_index is not in the rig.",
    "unknown_keyframe": "Tracks, a relative pose or gravity whose keyframe never came, or was turned away.",
    "duplicate_keyframe": "A keyframe whose id is known; the first one stays.",
    "bad_stamp": "A keyframe whose stamp lies far from those before it and those after it.",
    "frame_changed": "A keyframe in another frame than its session, which no second one confirmed.",
    "stray_session": "A keyframe of a higher session, which no second one confirmed.",
    "duplicate_observation": "A second observation of a track by one camera in one keyframe; the first one stays.",
    "still_image": "An observation of an image that is an earlier one once more, although the front-end has moved.",
    "stale_session": "A message of a session before the current one.",
    "bad_factor": "A relative pose, a prior, a fix or gravity with numbers that cannot be, or of a keyframe in itself.",
    "bad_covariance": "The same with a covariance that is not finite, symmetric and positive definite.",
    "bad_merge": "A merge of two tracks that one image sees both, or that are one already or unknown.",
    "other_world": "A prior in another frame than the one that came first, or in none.",
    "no_geo": "A fix of GNSS where pymap3d is missing: pip install ba_node[geo].",
    "pending_overflow": "A message that waited for the camera rig, or for the first keyframe of its session, longer"
    " than scene.max_pending messages or until the end.",
}

# Things that are worth counting although nothing was lost by them.
NOTICES: dict[str, str] = {
    "reordered": "A keyframe whose stamp lies before the newest one; it was sorted in.",
    "setup_unchecked": "A session whose set-up was not checked, as OpenCV (rosdep key python3-opencv) is missing.",
    "no_shared_track": "A camera that shares no track with camera 0, though both see the same: it counts as one alone.",
    "repeated_guess": "A second guess for a track; the first one stays.",
    "ids_reused": "A track whose views went over to another point; the older views keep theirs under another id.",
    "repeated_factor": "A second relative pose of the same keyframes, or gravity at the same; the first one stays.",
    "no_fix": "A message of a receiver that has no fix.",
    "unpaired": "A pose prior or fix without keyframes on both sides of its time; a place of a track that never came.",
    "adjusted_camera": "A camera whose k was taken from the whole sensor to the image (region of interest, binning).",
    "empty_tracks": "A tracks message without rows.",
    "frame_name": "A keyframe whose frame_id is empty or begins with a slash.",
    "not_refined": "A solve of everything, as the map has grown, that was not taken: what windows found stays.",
    "lengths_kept": "A map made as long as the front-end has it, where cameras or depths tell a little more or less.",
    "redundant": "A keyframe that was taken out of the map as others see its points (scene.redundant_share).",
    "apart": "A session before that no tracks connect with the last one, where scene.join_sessions asks for one map.",
}

# What somebody has to know or mend: kind -> what it is about. Said on the terminal, in report.json, on /diagnostics and
# in ba_msgs/SolverReport; a replay that has any ends with another exit code than 0.
WARNINGS: dict[str, str] = {
    "check_failed": "A test of the set-up ended by a fault of its own, and tells nothing.",
    "held": "Solutions that were found and not taken; the front-end's poses stand.",
    "stray": "Keyframes whose front-end's pose contradicts their tracks; they are placed by these, or left out.",
    "parted": "The front-end jumps to a keyframe and no track leads there: the map is in two parts.",
    "moving": "Tracks that move against the rest, as on objects that move; they are left out.",
    "depths": "Keyframes most of whose depths contradict images and steps, as in another unit; they are left out.",
    "far_from_origin": "Keyframes so far from the origin that the float32 of ~/points loses millimetres.",
    "still_image": "Images that come again while the front-end moves, as of a camera that is stuck; they are left out.",
    "unbounded": "Mismatches draw the map as far as they are off, as solver.loss and tracks.outlier_px were set.",
    "ids_reused": "Track ids that were used again for other points.",
    "distortion_folds": "A camera whose distortion folds over inside its image.",
    "clock_jump": "The stamps went far back, or a recording plays again: a new session began.",
    "clock_step": "The stamps jump while keyframes go on coming: the clock was set.",
    "silent_camera": "A camera that delivered tracks at first and does no more, while others go on.",
    "lower_session": "Keyframes came of a lower session only: it began anew.",
    "frame_changed": "The frame of the keyframes changed: a new session began.",
    "bad_stamp": "A keyframe was turned away for its stamp.",
    "stray_session": "A keyframe of a higher session was turned away, since no second one followed.",
    "frame_name": "The fixed frame of the keyframes has no name, or one that tf2 refuses.",
    "equal_stamps": "Two keyframes have one stamp.",
    "reused_id": "An id was used for a second keyframe of the session.",
    "no_geo": "Fixes of GNSS are left out, as pymap3d is missing.",
    "contradicted": "Many priors or fixes lie beside the map: they contradict each other, the images or the odometry.",
    "outvoted": "Most relative poses, steps with a covariance, or directions of gravity contradict the map.",
    "scattered": "Priors or fixes that scatter by much more than their covariance states; they count by so much less.",
    "unconfirmed": "Priors or fixes far beside the map of which no two agree; it stays where it is.",
    "drifted": "Priors or fixes and steps, as of wheels, drift apart by more than their covariances leave.",
    "unaligned": "Priors or fixes that were not used, as the path is too short to tell where the map lies in them.",
    "not_adjusted": "A loop or priors that the map would have to be bent too far for, or that images contradict.",
    "not_joined": "Sessions that tracks connect and that can be no one map: ids in both, stamps, cameras.",
    "setup": "A set-up that the tracks contradict: the likely mistake, and what to change. All solves are held.",
}

NOTES_KEPT = 50
# What follows from something else that was turned away.
_FOLLOWS = ("unknown_keyframe", "pending_overflow")


@dataclass(frozen=True)
class Refusal:
    """A measurement that is turned away: reason from ``REASONS``, and why in words."""

    measurement: Measurement
    reason: str
    text: str


class RejectionLog:
    """Counts by reason, and notes that name ids and values."""

    def __init__(self) -> None:
        # what was turned away; keys from REASONS. Whole messages count as one, observations one by one.
        self.rejected: Counter[str] = Counter()
        self.notices: Counter[str] = Counter()  # what was unusual but used; keys from NOTICES
        self.notes: deque[str] = deque(maxlen=NOTES_KEPT)  # the last cases in words, oldest first
        self.firsts: dict[str, str] = {}  # the first case of each reason in words
        self.warnings: dict[str, str] = {}  # the newest case of each kind in words; keys from WARNINGS

    def reject(self, reason: str, what: str, count: int = 1) -> None:
        """Count a rejection; ``what`` names the first case: thing, id, value, what was expected."""
        assert reason in REASONS, reason
        self.rejected[reason] += count
        more = f" and {count - 1} more" if count > 1 else ""
        self.notes.append(f"{what}{more}; dropped ({reason} = {self.rejected[reason]})")
        self.firsts.setdefault(reason, self.notes[-1])

    def cause(self) -> str:
        """Return the first case of what was turned away by itself, not as its keyframe was; empty if nothing was."""
        reasons = sorted(self.firsts, key=lambda reason: reason in _FOLLOWS)
        return self.firsts[reasons[0]] if reasons else ""

    def notice(self, kind: str, count: int = 1) -> None:
        """Count something that was unusual but used."""
        assert kind in NOTICES, kind
        if count:
            self.notices[kind] += count

    def warn(self, kind: str, text: str) -> None:
        """Keep a warning: what is wrong, which value, and what to do; it replaces an earlier one of its kind."""
        assert kind in WARNINGS, kind
        self.warnings[kind] = text

    def warn_again(self, kind: str, text: str, name: str) -> None:
        """Keep the first warning of a kind that is a reason too, with how many followed and the name of the last."""
        first, _, _ = self.warnings.get(kind, text).partition("; likewise ")
        more = self.rejected[kind] - 1
        self.warn(kind, first + (f"; likewise {more} more, the last of them {name}" if more > 0 else ""))
