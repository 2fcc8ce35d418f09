# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Learn how much more precise the front-end's steps are than stated, where nobody told their covariance.

Once for so many keyframes as a window holds it is solved again without the steps, to the end: the scale of one camera
hardly changes the objective, and a solve that stops early finds that of the steps. A step then differs from the
front-end's by e, of which images explain the covariance C (``core/covariance.py``) and the front-end the rest:
``e ~ N(0, C + s^2 sigma^2 I)``, with sigma as the parameters state it, for all steps of the window at once: images that
tell little of each may tell much of their sum. The likelihood of the share s is added up over windows, for rotation and
translation apart, with Student's distribution (5 degrees of freedom) of each component along the axes of C in stated
sigmas, so that single wild steps do not decide, and older windows fade.

Shares below 1 are held against 1 with odds of e^6 where images tell a step as well as stated sigmas do, or better.
Where their standard deviation is c times as large, their weight beside a step as stated is 1/c^2, so little is lost
by a share that is too small, and the exponent is divided by c^2. One camera tells lengths so badly (c = 2 to 5) that
what its few windows say decides. Taken is the mean of log s less its standard deviation: in doubt what came in
stands. So a front-end that is more precise than images holds the keyframes, in place of being spoilt by them; the
keyframes of before follow by a solve of everything (``adjustment.py``).

A front-end that sees the same images has steps whose errors are not its own: with the images they agree too well, or as
its tracks do not. So steps count as precise only where e is what C and the share say, ``z^2`` along these axes near 1,
and where images tell less than a fifth of a stated sigma at least: where they tell more, steps as stated
have no weight that could do harm, and none is to be had by mistake. Where the first windows tell nothing of the kind it
is not asked any more; larger shares are odometry.py's.

Only where images have a scale of their own (several cameras, or depths), or two older keyframes hold one.

A young map that ends, and whose windows did not tell, is asked as a whole: there all steps tell at once, also of a map
of no more than two windows. One camera has its scale there of steps that count next to nothing. Taken is the mean of
log s as it is: no later window would mend what was taken too small, and covariances would come out too small with it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray, IntArray, changed
from ba_node.config import Config, SolverOptions
from ba_node.core import covariance, methods, solver
from ba_node.core.factors import RelativePoses
from ba_node.core.problem import Problem, State
from ba_node.scene.scene import Scene
from ba_node.window import full, odometry
from ba_node.window.selection import Selection

_SHARES = 0.5 ** np.arange(7)
_FREEDOM = 5.0
# Logarithm of the odds of a share of 1 before anything is known; windows without another, after which that is that; and
# what a window counts once another has come.
_TELLING, _ENOUGH, _FADES = 6.0, 3, 0.8
# How many windows tell it at least; bounds of z^2; what C is of a stated sigma, at least; larger shares are 1.
_WINDOWS, _LOW, _HIGH, _COARSE, _LARGEST = 2, 0.4, 1.5, 0.2, 0.75
# Steps of a window, and of all of them, that tell it: of a dozen the likelihood is so flat that what came in counted
# ten times too much (0.006 -> 0.011 m).
_LEAST_STEPS, _STEPS = 5, 20
# Keyframes up to which a map is asked as a whole; there: what C is at least, observations that keyframes have at least,
# and how many times as large the standard deviations of steps are that hold the scale of one camera.
_YOUNG, _COARSE_OF_ALL, _SEEN, _NOTHING = 120, 0.08, 20, 30.0
# Errors along an axis that are larger, in standard deviations, count as so many.
_BOUND = 3.0
_TO_THE_END: dict[str, Any] = {"function_tolerance": 1e-12, "max_iterations": 60}


@dataclass
class Precision:
    """What was learned in a map."""

    # (2, n_shares) of rotation and translation, logarithms
    likelihood: FloatArray = field(default_factory=lambda: np.zeros((2, len(_SHARES))))
    # (2, n_shares) sum over windows of the mean of z^2
    fit: FloatArray = field(default_factory=lambda: np.zeros((2, len(_SHARES))))
    # (2,) likewise of the standard deviation by images, in stated ones
    coarse: FloatArray = field(default_factory=lambda: np.zeros(2))
    windows: int = 0
    steps: int = 0  # steps of all of them
    seen: int = 0  # keyframes of the map at the last of them
    whole: bool = False  # the last of them, which alone counts, was of all of the map

    def shares(self) -> tuple[float, float]:
        """Return what the standard deviations of rotation and translation are to be multiplied by."""
        if self.steps < _STEPS or self.windows < (1 if self.whole else _WINDOWS):
            return 1.0, 1.0
        each, coarse = np.arange(2), self.coarse / self.windows
        odds = self.likelihood.copy()
        odds[:, 0] += _TELLING / np.maximum(coarse, 1.0) ** 2
        if self.whole:
            # What is more than a share says may be the images': a larger share says it too.
            odds[:, 1:][self.fit[:, 1:] > _HIGH * self.windows] = -np.inf
        fit = self.fit[each, np.argmax(odds, axis=1)] / self.windows
        odds = np.exp(odds - odds.max(axis=1, keepdims=True))
        odds /= odds.sum(axis=1, keepdims=True)
        logs = np.log(_SHARES)
        mean = odds @ logs
        spread = np.sqrt(np.maximum(odds @ logs**2 - mean**2, 0.0))
        precise = (np.exp(mean) < _LARGEST) & (fit.min() > _LOW) & (fit < _HIGH)
        precise &= coarse > (_COARSE_OF_ALL if self.whole else _COARSE)
        # Of a whole map no later window mends what was taken too small.
        rotation, translation = np.where(precise, np.exp(mean if self.whole else mean - spread), 1.0).tolist()
        return rotation, translation

    def study(self, scene: Scene, config: Config, selection: Selection, state: State) -> Study | None:
        """Return what is to be asked of a window that was taken, with its solution; None if nothing is."""
        n, whole = len(scene.keyframes), selection.problem
        told_little = self.windows >= _ENOUGH and scene.step_shares == (1.0, 1.0)
        held = whole.has_scale or np.count_nonzero(whole.fixed) > 1
        due = n - self.seen >= config.window.max_keyframes and config.window.old_keyframes == "fix"
        if told_little or not (due and held and config.odometry.enabled) or selection.much_moves:
            return None
        steps = odometry.stated(scene, config.odometry, selection.keyframes)
        many = np.bincount(whole.observations.keyframe, minlength=whole.n_keyframes) >= odometry.MANY_OBSERVATIONS
        sure = many & ~whole.fixed
        kept = np.flatnonzero(sure[steps.first] & sure[steps.first + 1])
        if len(kept) < _LEAST_STEPS:
            return None
        problem = Problem(state, whole.fixed, whole.cameras, whole.observations, selection.beside)
        return Study(scene, n, problem, methods.from_config(config.solver), steps, kept)

    def ask_all(self, scene: Scene, config: Config) -> bool:
        """Ask a young map that ends, at once; return True if it is to follow steps, more precise than stated."""
        study = self._study_all(scene, config) if scene.step_shares == (1.0, 1.0) else None
        if study is not None:
            study.run()
            self.learn(study, config)
        scene.constraints.steps_precise = scene.step_shares != (1.0, 1.0)
        return scene.constraints.steps_precise

    def _study_all(self, scene: Scene, config: Config) -> Study | None:
        """Return what is to be asked of a whole map that ends; None if nothing is."""
        known, n = scene.constraints, len(scene.keyframes)
        placed = known.absolute or known.landmarks or known.relative
        if placed or n > _YOUNG or not config.odometry.enabled or not scene.keyframes.refined.any():
            return None
        begun = full.take_snapshot(scene, config)
        if isinstance(begun, str) or begun.selection.much_moves:
            return None
        selection, whole = begun.selection, begun.selection.problem
        steps = odometry.stated(scene, config.odometry, selection.keyframes)
        sure = np.bincount(whole.observations.keyframe, minlength=whole.n_keyframes) >= _SEEN
        kept = np.flatnonzero(sure[steps.first] & sure[steps.first + 1])
        if len(kept) < _LEAST_STEPS:
            return None
        beside = selection.beside
        if not whole.has_scale:
            loose = changed(steps, sigma_rad=_NOTHING * steps.sigma_rad, sigma_m=_NOTHING * steps.sigma_m)
            beside = (*beside, *loose.factors(np.ones(len(steps.first), bool), _NOTHING))
        problem = Problem(whole.start, whole.fixed, whole.cameras, whole.observations, beside)
        return Study(scene, n, problem, methods.from_config(config.solver), steps, kept, whole=True)

    def learn(self, done: Study, config: Config) -> None:
        """Take in what a window, or a map, has told; the steps of its scene count accordingly from now on."""
        self.seen = done.seen
        if done.found is None:
            return
        scene = done.scene
        if done.whole:
            vars(self).update(vars(Precision(seen=done.seen)))
        self.whole = done.whole
        likelihood, fit = (np.stack(values) for values in zip(*(_told(*part) for part in done.found), strict=True))
        self.likelihood, self.fit = _FADES * self.likelihood + likelihood, self.fit + fit
        self.coarse = self.coarse + done.coarse
        self.windows, self.steps = self.windows + 1, self.steps + len(done.kept)
        before, scene.step_shares = scene.step_shares, self.shares()
        newly = any(then == 1.0 and now < 1.0 for then, now in zip(before, scene.step_shares, strict=True))
        scene.constraints.steps_precise |= newly and done.seen > config.window.max_keyframes


@dataclass
class Study:
    """A window that was taken, to be solved once more without the front-end's steps; that may run on any thread."""

    scene: Scene  # that it is of; only :meth:`Precision.learn` looks at it
    seen: int  # keyframes of the map
    problem: Problem  # without the steps, at the solution of the window
    options: SolverOptions
    steps: odometry.Steps  # as stated
    kept: IntArray  # those between keyframes that see much
    whole: bool = False  # of all of the map, to which no more comes
    # errors (n, 3), their covariance by images (n, 3, n, 3), stated sigmas (n,), of rotation and translation; None
    # before :meth:`run`, and where images do not tell
    found: list[tuple[FloatArray, FloatArray, FloatArray]] | None = None
    coarse: list[float] = field(default_factory=list)  # standard deviation by images, in stated ones, of both

    def run(self) -> None:
        """Solve, and compare."""
        problem, options, steps, kept = self.problem, self.options, self.steps, self.kept
        result = solver.solve(problem, dataclasses.replace(options, **_TO_THE_END))
        if not result.status.usable or not result.state.is_finite():
            return
        free = np.flatnonzero(~problem.fixed)
        uncertainty = covariance.uncertainty_of(problem, result.state, options, np.empty((len(free), 6, 0)))
        if uncertainty is None:
            return
        column = np.full(problem.n_keyframes, -1)
        column[free] = np.arange(len(free))
        pairs = np.stack([steps.first, steps.first + 1], axis=1)[kept]
        unit = np.tile(np.eye(6), (len(kept), 1, 1))
        factors = RelativePoses(pairs, steps.rotation[kept], steps.translation[kept], unit)
        error, by_pose = factors.residuals(result.state), factors.jacobians(result.state)
        by_free, at = np.zeros((len(kept), 6, len(free), 6)), np.arange(len(kept))
        for end in (0, 1):
            by_free[at, :, column[pairs[:, end]]] = by_pose[:, end]
        J = by_free.reshape(6 * len(kept), -1)
        covariances = (J @ uncertainty.of(np.arange(6 * len(free))) @ J.T).reshape(2 * (len(kept), 6))
        if not np.isfinite(covariances).all():
            return
        parts = ((slice(0, 3), steps.sigma_rad), (slice(3, 6), steps.sigma_m))
        self.found = [(error[:, of], covariances[:, of, :, of], sigma[kept]) for of, sigma in parts]
        self.coarse = [float(np.median(_spread(part[1]) / part[2])) for part in self.found]
        if self.whole and not problem.has_scale:
            # No image tells it.
            moves = steps.translation[kept]
            self.found[1][1][:] += np.multiply.outer(moves, moves)


def _own(covariances: FloatArray) -> FloatArray:
    """Return the covariance of each step, (n, 3, 3), out of that of all, (n, 3, n, 3)."""
    at = np.arange(len(covariances))
    return covariances[at, :, at]


def _spread(covariances: FloatArray) -> FloatArray:
    """Return the standard deviation of an axis of each step, (n,)."""
    return np.asarray(np.sqrt(np.trace(_own(covariances), axis1=1, axis2=2) / 3.0))


def _told(error: FloatArray, covariances: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return of each share the logarithm of its likelihood, but for what is the same of all, and the mean of z^2."""
    scale = np.repeat(sigma, 3)
    whitened = covariances.reshape(len(scale), -1) / np.outer(scale, scale)
    variance, axes = np.linalg.eigh(0.5 * (whitened + whitened.T))
    along = axes.T @ (error.ravel() / scale)
    total = np.maximum(variance, 0.0) + _SHARES[:, None] ** 2
    odd = (_FREEDOM + 1.0) * np.log1p(along**2 / (_FREEDOM * total))
    # One axis whose variance by images came out as next to nothing is not to decide alone.
    fit = np.mean(np.minimum(along**2 / total, _BOUND**2), axis=1)
    return -0.5 * np.sum(np.log(total) + odd, axis=1), fit
