# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Decide whether a solution is taken: it must be determined, plausible, and better than what came in.

- **Determined**: most observations agree with it within the nominal gate. Keyframes that see too few points were left
  out of the solve by the selection.
- **Plausible**: its steps from keyframe to keyframe are near the front-end's, by what those are worth (``guard.*``).
  A step further off is taken where it is what the solve began with (an earlier solve found it, or the tracks did, see
  ``arrival.py``), or where several solves agree on it and the tracks that span it bear it out: so a loop may close.
  Where half the steps are off, or all are too long or turn too far by one factor, no track helps: the cameras or the
  depths are not what they are said to be, and fit each other all the same. Where much of what is seen moves, half as
  much is too far, and steps that are all off to one side are what the moving objects make of them.
- **Better**: it explains some tracks, most of which took no part, no worse than the front-end's poses do, for all
  cameras together and for each alone (``trial.py``).

Nothing here sees the scene. What is held leaves it as it was but for the count of solves; keyframes that were never
taken follow the front-end by the correction of the last one that was (``Scene.propagate_corrections``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import Config
from ba_node.core.problem import Problem, State
from ba_node.kept import kept_property
from ba_node.window import depths, steps
from ba_node.window.merging import Merged
from ba_node.window.selection import Selection
from ba_node.window.trial import MIN_PARALLAX, Explained, median
from ba_node.window.trust import Odd, Trust, agree

# A common factor, or half the steps being off, is not told from fewer steps.
_MIN_STEPS = 4
# Measured depths, and sigmas, that are looked at.
_LOOKED_AT = 256
# Cameras of a rig up to which each has to agree.
_FEW_CAMERAS = 6
# A step is borne out by so many points that are seen on both sides of it, and this share of them at least.
_MIN_SPANNING = 10
_SPANNING_SHARE = 0.5
# A point that so many keyframes agree on ties them together.
_TIED = 3
# Tracks strain at a keyframe where the mean square of their residuals is so many standard errors above that of others,
# by so many at least. What a residual counts at most, and the least mean square that is compared with, sigmas.
_STRAINED, _MIN_STRAINED, _BOUND, _LEAST_SQUARE = 3.0, 30, 4.0, 0.1
_CHANGED = "as where images change on the way: zoomed, or another region of interest"
# By how much bounds narrow where much of what is seen moves, or seems to; and how surely steps may be off to one side
# there, see ``steps.bias``.
_NARROW, _MAX_BIAS = 0.5, 24.0
# If more of the keyframes would have to be held one by one, it is the solution that is wrong.
_MAX_HELD_SHARE = 0.25


@dataclass(frozen=True)
class Verdict:
    """What is to become of a solution."""

    reason: str = ""  # why it is held, in words; empty if it may be taken
    health: dict[str, float] = field(default_factory=dict)  # what ``ba_msgs/SolverReport`` tells of it, by name
    # rows in the scene of keyframes that alone are wrong: without them it may be worth another solve
    keyframes: tuple[int, ...] = ()
    odd: Odd | None = None  # steps that need another solve to agree
    systematic: bool = False  # a window that is wrong as a whole, not a part of it
    waits: bool = False  # nothing is wrong but that there is no parallax yet


def decide(config: Config, selection: Selection, found: Merged, trust: Trust | None = None) -> Verdict:
    """Return whether a solution may be taken; ``trust`` is what the solves before are worth."""
    assert found.state is not None and found.explained is not None
    trust = trust or Trust()
    config = trust.bounds(config)
    if selection.much_moves:
        config = _narrowed(config)
    agreeing = _agreeing(selection, found.norms, config)
    sigma = median(selection.observations.sigma_px[:: 1 + len(found.norms) // _LOOKED_AT])
    held_out = found.explained.held_out * sigma
    health = {
        "inlier_share": agreeing.share,
        "parallax_deg": math.degrees(found.explained.parallax_rad),
        "held_out_px_before": float(held_out[0]),
        "held_out_px_after": float(held_out[1]),
    }
    if not config.guard.enabled:
        return Verdict(health=health)
    reason = _without_parallax(selection.problem, found.explained, sigma, config)
    if reason:
        return Verdict(reason, health, systematic=True, waits=True)
    compared = _Compared.of(config, selection, found.state, found.norms)
    reason = _misfit(selection, found.state, agreeing, config) or compared.systematic()
    reason = reason or _unexplained(found.explained, config)
    if reason:
        return Verdict(reason, health, systematic=True)
    return compared.verdict(health, trust.confirmed(config.frames.gate_confirmations))


def _narrowed(config: Config) -> Config:
    """Return parameters by which the steps as a whole have to be nearer to the front-end's."""
    typical, scale = config.guard.max_typical_sigmas, config.guard.max_scale_error
    return replace(
        config, guard=replace(config.guard, max_typical_sigmas=_NARROW * typical, max_scale_error=_NARROW * scale)
    )


def inlier_share(selection: Selection, norms: FloatArray, config: Config) -> float:
    """Return which share of the observations agree with a solution, by the sizes of its residuals (n_all,), sigmas."""
    return _agreeing(selection, norms, config).share


class _Agreeing(NamedTuple):
    """Observations that agree with a solution."""

    agree: list[int]  # by camera
    of: list[int]  # so many by each camera

    @property
    def share(self) -> float:
        """Return the share of all."""
        return sum(self.agree) / max(sum(self.of), 1)


def _agreeing(selection: Selection, norms: FloatArray, config: Config) -> _Agreeing:
    camera, n = selection.observations.camera, len(selection.problem.cameras.model)
    gate = config.tracks.outlier_px or np.inf
    if native.kernels is not None:
        found = native.kernels.agreeing_by_camera(camera, norms, gate, n)
    else:
        found = np.bincount(camera[norms <= gate], minlength=n), np.bincount(camera, minlength=n)
    return _Agreeing(*(counts.tolist() for counts in found))


def _misfit(selection: Selection, state: State, agreeing: _Agreeing, config: Config) -> str:
    """Return in words whether fewer observations agree with a solution, or fewer measured depths, than have to."""
    least, gate = config.guard.min_inlier_share, config.tracks.outlier_px or np.inf
    share = agreeing.share
    if share < least:
        # One camera that turns on the spot places mismatches alone.
        turning = "" if selection.problem.has_scale else "; or the camera hardly moves, and these are mismatches"
        return (
            f"only {100 * share:.0f} % of the observations agree with it within {gate:g} sigmas: cameras, their places"
            f" on the body, or track ids are not what they are said to be{turning}"
        )
    n_cam, count = len(agreeing.of), sum(agreeing.of)
    for camera in range(n_cam if 1 < n_cam <= _FEW_CAMERAS else 0):
        share = agreeing.agree[camera] / max(agreeing.of[camera], 1)
        if share < least and agreeing.of[camera] > count // (2 * n_cam):
            return (
                f"only {100 * share:.0f} % of the observations of camera {camera} agree with it within {gate:g} sigmas:"
                " it does not sit on the body as the rig says, or its calibration is wrong"
            )
    off = _depth_errors(selection.whole, state)
    share = float(np.count_nonzero(off <= gate)) / max(len(off), 1)
    if len(off) and share < least:
        return (
            f"only {100 * share:.0f} % of the measured depths agree with it within {gate:g} sigmas: they are not in"
            " metres, not along the optical axis, or not as precise as tracks.depth_sigma_ratio says"
        )
    return ""


def _depth_errors(problem: Problem, state: State) -> FloatArray:
    """Return how far some of the measured depths are off a solution, sigmas."""
    obs = problem.observations
    if not len(obs.depth_m):
        return np.empty(0)
    rows = np.flatnonzero(np.isfinite(obs.depth_m))
    rows = rows[:: 1 + len(rows) // _LOOKED_AT]
    return np.asarray(np.abs(depths.expected(problem, state, rows) - obs.depth_m[rows]) / obs.depth_sigma_m[rows])


def _without_parallax(problem: Problem, found: Explained, sigma_px: float, config: Config) -> str:
    """Return in words whether rays tell no distances; empty where they do, or depths are measured."""
    fx, fy = problem.cameras.params[0, :2].tolist()
    noise = sigma_px / (0.5 * (fx + fy))
    if not config.guard.held_out_tracks or len(problem.observations.depth_m):
        return ""
    if found.parallax_rad >= MIN_PARALLAX * noise:
        return ""
    return (
        f"the rays to its points meet at {np.degrees(found.parallax_rad):.3f} deg, with a noise of"
        f" {np.degrees(noise):.3f} deg: that does not tell how far away they are, nor how far keyframes are apart"
    )


def _unexplained(found: Explained, config: Config) -> str:
    """Return in words whether tracks are explained worse than by the front-end's poses."""
    if not config.guard.held_out_tracks:
        return ""
    bad = found.worse(config.guard.max_worse_share)
    if not bad:
        return ""
    k = bad[0]
    figures = f"mean residual {found.mean[0, k]:.2f} -> {found.mean[1, k]:.2f} sigmas"
    if k == 0:
        return f"it explains the tracks that it was tried on worse than the poses that came in ({figures})"
    text = f"camera {k - 1} alone is explained worse than by the poses that came in ({figures}): the cameras do not sit"
    return f"{text} on the body as the rig says, or their calibration is wrong"


@dataclass(frozen=True)
class _Compared:
    """The steps of a solution and those of the front-end."""

    selection: Selection
    norms: FloatArray
    config: Config
    first: IntArray
    second: IntArray
    found: steps.Against

    @property
    def off(self) -> steps.Comparison:
        """Return how far its steps are off the front-end's."""
        return self.found.off

    @classmethod
    def of(cls, config: Config, selection: Selection, state: State, norms: FloatArray) -> _Compared:
        fixed = selection.problem.fixed
        # Keyframes of the problem are oldest first; those between which others are left out make one step too.
        adjacent = selection.place[1:] - selection.place[:-1] <= 1 + len(selection.window)
        first = (adjacent & ~(fixed[1:] & fixed[:-1])).nonzero()[0]
        second = first + 1
        poses = (state.rotation, state.translation), selection.measured
        return cls(selection, norms, config, first, second, steps.against(*poses, first, second, config.guard))

    def systematic(self) -> str:
        """Return what is wrong with the steps as a whole, in words."""
        if len(self.first) < _MIN_STEPS:
            return ""
        guard, limit = self.config.guard, math.log1p(self.config.guard.max_scale_error)
        solved, measured, scale, turn = self.found.solved, self.found.measured, self.found.scale, self.found.turn
        if abs(math.log(scale)) > limit:
            text = f"its steps are {scale:.3g} times as long as the front-end's"
            problem = self.selection.problem
            if len(problem.cameras.model) == 1 and not len(problem.observations.depth_m):
                return f"{text}: one camera does not see the scale, and here it has drifted away"
            return f"{text}: the scale of depths, baseline or focal length is not that of the front-end"
        if abs(math.log(turn)) > limit:
            return f"it turns {turn:.3g} times as far as the front-end: the focal length is not the true one"
        # The lower of two in the middle: of four steps two may lead to one keyframe that is far off.
        typical = float(np.sort(self.off.sigmas)[(len(self.first) - 1) // 2])
        if self.selection.much_moves and steps.bias(solved, measured) > _MAX_BIAS:
            aside = float(np.linalg.norm(np.mean(solved.move - measured.move, axis=0)))
            turned = float(np.degrees(np.median(self.off.turn_rad)))
            return (
                f"its steps are off the front-end's to one side, by {aside:.2g} m and"
                f" {turned:.2g} deg each, and much of what is seen moves: that may have carried it along"
            )
        if typical > guard.max_typical_sigmas:
            move, angle = float(np.median(self.off.move_m)), float(np.degrees(np.median(self.off.turn_rad)))
            return (
                f"half its steps are more than {move:.2g} m or {angle:.2g} deg ({typical:.1f} sigmas) off the"
                " front-end's: cameras, their places on the body, or the poses are not what they are said to be"
            )
        return ""

    def verdict(self, health: dict[str, float], confirmed: Odd | None) -> Verdict:
        """Return what is to become of a solution that is right as a whole."""
        limit = self.config.guard.max_sigmas
        odd = self.off.sigmas > limit
        if not odd.any():
            return Verdict(health=health)
        start = self.selection.problem.start
        began = steps.between(start.rotation, start.translation, self.first, self.second)
        known = steps.compare(self.found.solved, began, self.config.guard).sigmas <= limit
        strained = np.zeros(len(odd), bool)
        strained[odd & ~known] = [self._strained(int(k)) for k in np.flatnonzero(odd & ~known)]
        if confirmed is not None:
            known |= agree(self._odd(odd), confirmed, self.config, self._keys(np.arange(len(odd))))
        spanned = np.zeros(len(odd), bool)
        spanned[odd] = [self._borne_out(int(k)) for k in np.flatnonzero(odd)]
        spanned &= ~strained
        odd &= ~(known & spanned)
        if not odd.any():
            return Verdict(health=health)
        worst = int(np.argmax(np.where(odd, self.off.sigmas, 0.0)))
        text = (
            f"its step to keyframe {self.selection.keyframe_id[self.second[worst]]} is {self.off.move_m[worst]:.3g} m"
            f" and {np.degrees(self.off.turn_rad[worst]):.3g} deg ({self.off.sigmas[worst]:.0f} sigmas) off the"
            " front-end's"
        )
        if spanned[odd].all():
            return Verdict(f"{text}; it waits for more solves that agree", health, odd=self._odd(odd))
        rows = self._to_blame(odd & ~spanned)
        why = f"the tracks that span it fit worse behind it, {_CHANGED}" if strained.any() else "no tracks bear it out"
        return Verdict(f"{text}, and {why}", health, rows, systematic=not rows)

    def _keys(self, which: IntArray) -> list[tuple[int, int]]:
        rows = self.selection.keyframes
        return [(int(rows[self.first[k]]), int(rows[self.second[k]])) for k in which]

    def _odd(self, odd: BoolArray) -> Odd:
        solved = self.found.solved
        return Odd(tuple(self._keys(np.flatnonzero(odd))), steps.Steps(solved.turn[odd], solved.move[odd]))

    def _borne_out(self, k: int) -> bool:
        """Return True if at both ends of a step most points that are seen across it agree, and there are enough."""
        point, keyframe, agrees = self._views
        n = self.selection.problem.n_points
        before = keyframe <= self.first[k]
        across = _both(point[before], point[~before], n) & (np.bincount(point, minlength=n) >= _TIED)
        good = _both(point[before & agrees], point[~before & agrees], n)
        good &= np.bincount(point[agrees], minlength=n) >= _TIED
        for end in (self.first[k], self.second[k]):
            own = keyframe == end
            agreeing = np.count_nonzero(good[point[own & agrees]])
            if agreeing < max(_MIN_SPANNING, _SPANNING_SHARE * np.count_nonzero(across[point[own]])):
                return False
        return True

    def _strained(self, k: int) -> bool:
        """Return True if points that are seen across a step fit its end clearly worse than others fit theirs.

        They do where images changed, not the pose: no pose explains a zoom of points at many depths. Others are the
        views from before, and those of points that one side alone sees. With one camera that shows no lengths.
        """
        if self.selection.problem.has_scale:
            return False
        point, keyframe = self.selection.observations.point, self.selection.observations.keyframe
        before = keyframe <= self.first[k]
        across = _both(point[before], point[~before], self.selection.problem.n_points)[point]
        square = np.minimum(self.norms, _BOUND) ** 2
        own, others = across & (keyframe == self.second[k]), ~across | (keyframe < self.first[k])
        count = np.count_nonzero(own)
        if count < _MIN_STRAINED or not others.any():
            return False
        ratio = float(square[own].mean()) / max(float(square[others].mean()), _LEAST_SQUARE)
        return ratio > 1.0 + _STRAINED * ratio / math.sqrt(count)

    def _to_blame(self, odd: BoolArray) -> tuple[int, ...]:
        """Return the keyframes (rows in the scene) without which no step is odd; none if they are too many."""
        n, free = self.selection.problem.n_keyframes, ~self.selection.problem.fixed
        steps_at, odd_at = np.zeros(n, int), np.zeros(n, int)
        for end in (self.first, self.second):
            np.add.at(steps_at, end, 1)
            np.add.at(odd_at, end, odd)
        # Both steps are odd, or the only one of the last keyframe is; else the end that fewer views tie to the others.
        blamed = (odd_at > 0) & (odd_at == steps_at) & free
        ties = np.where(free, self._ties(), np.iinfo(int).max)
        for k in np.flatnonzero(odd & ~blamed[self.first] & ~blamed[self.second]):
            first, second = int(self.first[k]), int(self.second[k])
            blamed[first if ties[first] < ties[second] else second] = True
        if np.count_nonzero(blamed) > max(1, _MAX_HELD_SHARE * n):
            return ()
        return tuple(int(row) for row in self.selection.keyframes[blamed])

    def _ties(self) -> IntArray:
        """Return for each keyframe the views that agree, of points on which three keyframes agree."""
        point, keyframe = (column[self._views[2]] for column in self._views[:2])
        tied = np.bincount(point, minlength=self.selection.problem.n_points)[point] >= _TIED
        return np.bincount(keyframe[tied], minlength=self.selection.problem.n_keyframes)

    @kept_property
    def _views(self) -> tuple[IntArray, IntArray, BoolArray]:
        """Return point, keyframe, and whether all cameras agree, of each pair of point and keyframe."""
        obs, n = self.selection.observations, self.selection.problem.n_keyframes
        pairs, of = np.unique(obs.point * n + obs.keyframe, return_inverse=True)
        wrong = np.bincount(of, self.norms > (self.config.tracks.outlier_px or np.inf), len(pairs))
        return *np.divmod(pairs, n), wrong == 0


def _both(some: IntArray, others: IntArray, n: int) -> BoolArray:
    """Return which of n numbers are in both lists."""
    return np.asarray((np.bincount(some, minlength=n) > 0) & (np.bincount(others, minlength=n) > 0))
