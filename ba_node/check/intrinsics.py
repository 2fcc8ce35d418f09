# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out whether the cameras' intrinsics are those of the images, by small adjustments with free poses.

Two images hardly tell a wrong focal length: rotation and direction follow it. A dozen keyframes do. So a few of them
are adjusted freely, once as given and once for every other camera model in question, and the sums of residuals (Cauchy)
are compared. Whoever is clearly lower wins.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.diagnosis import Diagnosis, Finding, Row
from ba_node.check.relations import AGREED, Relation, median_share, spread
from ba_node.check.tracks import Tracks
from ba_node.config import SolverOptions
from ba_node.core import cameras, geometry, methods, native_kernels, solver, triangulation
from ba_node.core.cameras import CX, CY, DISTORTION, FX, FY
from ba_node.core.problem import Observations, Problem, State

_KEYFRAMES = 10
_OBSERVATIONS = 1600
_MIN_POINTS = 30
_MIN_VIEWS = 3
_MAX_STRIDE = 3
_MIN_KEYFRAMES = 8
# A wide loss first, as the front-end's steps may be far off; the sum that counts is that of the narrow one.
_WIDE, _NARROW = (
    dataclasses.replace(
        methods.options("auto"),
        loss="cauchy",
        loss_scale_px=scale,
        max_iterations=iterations,
        function_tolerance=1e-3,
    )
    for scale, iterations in ((8.0, 10), (1.0, 12))
)
_PATIENT = dataclasses.replace(_NARROW, max_iterations=60, function_tolerance=1e-5)
# Distance of a point that has none, in diameters of the path.
_FAR = 20.0
# Residuals beyond this many of the usual ones with the given model are mismatches.
_MISMATCH = 5.0
# Residuals beyond this many sigmas, and points behind a camera, all count the same.
_CAP = 10.0
# Factors of the focal length that are tried first; where one is better, the others beyond it.
_BRACKET = 1.18
_SMALLER, _LARGER = (0.92, 0.7, 0.6, 0.5, 0.4), (1.08, 1.4, 1.65, 2.0, 2.5)
# Factors nearer to 1 than this are not named.
_LEAST_FACTOR = 0.12
# Two estimates of a factor agree to this.
_SAME_FACTOR = 1.15
# Usual residual, in sigmas, from which on it is more than noise, and factors far from 1 are tried too.
_LARGE = 1.5
# Barrel distortion that images have where none is given.
_BARREL = (-0.1, -0.2, -0.3, -0.4)
# Share of the tracks' extent by which a principal point is off their middle where other sizes of the image are tried.
_OFF_CENTRE = 0.2
# Pixels of cameras are square to better than this.
_SQUARE = 1.05
# Another model is better if its sum of residuals is lower by this share, and by so many times its mean.
_LOWER = 0.03
_SURE = 25.0
# Where fewer tracks than this agree with free relations, the sum has to fall to this share: moving objects pull too.
_MOST_AGREE, _LEFT = 0.85, 0.75
_TEST = "intrinsics"
_INFO = "camera_info in camera_rig"


@dataclass(frozen=True)
class Model:
    """A camera model in question."""

    cause: str  # what it would mean
    change: str  # what to change
    params: FloatArray  # (n_cam, 12)
    lens: cameras.Model | None = None  # the model of all cameras; None for those given

    def confirms(self, other: Model) -> bool:
        """Return True if it says the same, whatever the precise numbers."""
        ratio = float(self.params[0, FX] / other.params[0, FX])
        return self.change == other.change and 1.0 / _SAME_FACTOR < ratio < _SAME_FACTOR


def check_intrinsics(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare camera models by how well they explain a dozen keyframes; other tracks have to confirm what is found."""
    outcome, model = _compare(tracks, relations, part=0)
    if model is None:
        return outcome
    _, other = _compare(tracks, relations, part=1)
    if other is not None and other.confirms(model):
        return outcome
    return Diagnosis(untold=["the intrinsics: tracks contradict each other"], rows=outcome.rows)


def _compare(tracks: Tracks, relations: list[Relation], part: int) -> tuple[Diagnosis, Model | None]:
    """Return what half of the tracks tell, and which camera model is better than the given one."""
    problem = _problem(tracks, relations, part)
    if problem is None:
        return Diagnosis(untold=["too few long tracks with parallax to judge the intrinsics"]), None
    given = tracks.cameras.params
    adjusted = {1.0: _Adjusted(problem, given)}
    measure = _Measure(adjusted[1.0].norms)
    now = measure(adjusted[1.0])
    for factor in (1.0 / _BRACKET, _BRACKET):
        adjusted[factor] = _Adjusted(problem, _scaled(given, factor))
    n = len(measure)
    least = min(measure(adjusted[1.0 / _BRACKET]), measure(adjusted[_BRACKET]))
    flat = n * (least / now - 1.0) < _SURE
    tried = [(model, _Adjusted(problem, model.params, model.lens)) for model in other_models(tracks)]
    if least < now or measure.noise > _LARGE:
        for factor in (*_SMALLER, *_LARGER):
            adjusted[factor] = _Adjusted(problem, _scaled(given, factor))
        cost = {factor: measure(one) for factor, one in adjusted.items()}
        factor = _lowest(cost)
        if abs(factor - 1.0) > _LEAST_FACTOR and _is_sharp(cost):
            tried.append((_focal(given, factor), adjusted[min(cost, key=lambda one: cost[one])]))
    rows = [Row(_TEST, "as given", _explained(now))]
    for cause in dict.fromkeys(model.cause for model, _ in tried):
        least_loss = min(measure(one) for model, one in tried if model.cause == cause)
        rows.append(Row(_TEST, cause, _explained(least_loss)))
    if tried:
        model, best = min(tried, key=lambda one: measure(one[1]))
        lowest = measure(best)
        # Then the given model gets every chance: many iterations, and to begin where the other one ended.
        if _is_lower(lowest, now, n) and _is_lower(lowest, adjusted[1.0].thorough(best.state, measure), n):
            if lowest > _left(relations) * now:
                return Diagnosis(untold=["too many outliers to judge the intrinsics"], rows=rows), None
            evidence = f"a free adjustment leaves {lowest / now:.0%} of the loss that it leaves as given"
            return Diagnosis([Finding((model.cause,), evidence, (model.change,))], rows=rows), model
    if flat:
        return Diagnosis(untold=["the motion so far does not tell the focal length"], rows=rows), None
    return Diagnosis(sound=["the focal length fits"], rows=rows), None


def _left(relations: list[Relation]) -> float:
    """Return the most that another model may leave of the loss, by how many tracks agree with free relations."""
    share = median_share([one for one in relations if one.has_direction])
    if share < AGREED:
        return 0.0
    return _LEFT if share < _MOST_AGREE else 1.0


def loss_of(tracks: Tracks, relations: list[Relation]) -> float:
    """Return the mean loss of a free adjustment of a dozen keyframes; infinite if there is none."""
    problem = _problem(tracks, relations, part=0)
    if problem is None:
        return np.inf
    norms = np.minimum(_Adjusted(problem, tracks.cameras.params).norms, _CAP)
    return float(np.log1p(norms * norms).mean())


def _is_lower(cost: float, other: float, observations: int) -> bool:
    """Return True if a mean loss is clearly lower than another."""
    return other > (1.0 + _LOWER) * cost and observations * (other / cost - 1.0) > _SURE


def _explained(cost: float) -> float:
    """Return the mean weight of a residual with a mean loss."""
    return float(1.0 / (1.0 + cost))


def _scaled(params: FloatArray, factor: float) -> FloatArray:
    scaled = params.copy()
    scaled[:, FX : FY + 1] *= factor
    return scaled


def _focal(params: FloatArray, factor: float) -> Model:
    focal = params[0, FX]
    return Model(
        f"focal length off by a factor of about {1.0 / factor:.2f}:"
        f" the tracks fit {factor * focal:.0f} px, not {focal:.0f}",
        f"k of {_INFO}",
        _scaled(params, factor),
    )


def _is_sharp(cost: dict[float, float]) -> bool:
    """Return True if the sum rises on both sides of its least."""
    costs = [cost[factor] for factor in sorted(cost)]
    at = int(np.argmin(costs))
    return min(max(costs[: at + 1]), max(costs[at:])) > (1.0 + _LOWER) * costs[at]


def _lowest(cost: dict[float, float]) -> float:
    """Return the factor of the least cost, between the factors that were tried (parabola over their logarithms)."""
    factors = np.array(sorted(cost))
    costs = np.array([cost[factor] for factor in factors])
    at = int(np.argmin(costs))
    if at in (0, len(costs) - 1):
        return float(factors[at])
    three = slice(at - 1, at + 2)
    a, b, _ = np.polyfit(np.log(factors[three]), costs[three], 2)
    return float(np.exp(-b / (2.0 * a)))


def other_models(tracks: Tracks) -> list[Model]:
    """Return the camera models that are usual mistakes: of the other kind of image, of another size of it."""
    given = tracks.cameras.params
    models = [*other_sizes(tracks), *_square(given)]
    plain = given.copy()
    plain[:, DISTORTION] = 0.0
    rational = (tracks.cameras.model == cameras.Model.RATIONAL).all()
    if given[:, DISTORTION].any() and rational:
        cause = "images rectified though a distortion is given"
        models.append(Model(cause, f"d of {_INFO} to zeros (and k to that of the rectified image)", plain))
    elif rational:
        cause = "images not rectified though no distortion is given"
        change = f"distortion_model and d of {_INFO}, or track in rectified images"
        models.append(Model(cause, change, plain, cameras.Model.EQUIDISTANT))
        for k1 in _BARREL:
            barrel = plain.copy()
            barrel[:, DISTORTION.start] = k1
            models.append(Model(cause, change, barrel))
    elif (tracks.cameras.model == cameras.Model.EQUIDISTANT).all():
        cause = "images rectified though the model of a fisheye lens is given"
        change = f"distortion_model of {_INFO} to plumb_bob and d to zeros (and k to that of the rectified image)"
        models.append(Model(cause, change, plain, cameras.Model.RATIONAL))
    return models


def _square(given: FloatArray) -> list[Model]:
    """Return the cameras with square pixels, if those given are far from that."""
    focal = given[0, FX : FY + 1]
    if max(focal) < _SQUARE * min(focal):
        return []
    models = []
    for name, other in ((FX, FY), (FY, FX)):
        square = given.copy()
        square[:, name] = square[:, other]
        cause = f"fx and fy differ by a factor of {max(focal) / min(focal):.2f}, the tracks fit square pixels"
        models.append(Model(cause, f"k of {_INFO}", square))
    return models


def other_sizes(tracks: Tracks) -> list[Model]:
    """Return the camera models of a region of the image and of a binned one, if the tracks lie far off the centre."""
    given, models = tracks.cameras.params, []
    low, high = np.percentile(tracks.uv, [0.2, 99.8], axis=0)
    middle, centre = 0.5 * (low + high), np.median(given[:, CX : CY + 1], axis=0)
    if not (np.abs(centre - middle) > _OFF_CENTRE * (high - low)).any():
        return []
    where = (
        f"the tracks lie about ({middle[0]:.0f}, {middle[1]:.0f}) px,"
        f" the principal point is at ({centre[0]:.0f}, {centre[1]:.0f})"
    )
    region = given.copy()
    region[:, CX : CY + 1] += middle - centre
    cause = f"region of interest not applied: {where}"
    models.append(Model(cause, f"roi in {_INFO}, or subtract its offset from the principal point in k", region))
    factor = float(np.median(centre / middle))
    for binning in (4.0, 2.0, 0.5):
        if 0.75 < factor / binning < 1.33:
            binned = given.copy()
            binned[:, FX : CY + 1] /= binning
            cause = f"binning not applied: k is that of an image {binning:g} times as large"
            change = f"binning_x and binning_y in {_INFO}, or divide k by {binning:g}"
            if binning < 1.0:
                cause = f"k is that of a smaller image: the tracks are in one {1.0 / binning:g} times as large"
                change = f"binning_x and binning_y in {_INFO} to 1, or multiply k by {1.0 / binning:g}"
            models.append(Model(cause, change, binned))
    return models


def _problem(tracks: Tracks, relations: list[Relation], part: int) -> Problem | None:
    """Return the adjustment of a dozen keyframes that turn most, every other of their tracks, the first pose fixed.

    The second part has the other tracks, and keyframes of the other end of the recording.
    """
    usable = [one for one in relations if one.has_direction]
    if len(usable) < 3:
        return None
    stride = int(np.clip(np.median([one.b[0] - one.a[0] for one in usable]) // 2, 1, _MAX_STRIDE))
    turning = max(usable, key=lambda one: float(np.trace(np.eye(3) - one.pose.rotation)))
    reach = stride * (_KEYFRAMES - 1)
    first = max(0, min(turning.a[0] - reach // 2, len(tracks) - 1 - reach))
    first = max(0, len(tracks) - 1 - reach - first) if part else first
    keyframes = np.arange(first, len(tracks))[::stride][:_KEYFRAMES]
    if len(keyframes) < _MIN_KEYFRAMES:
        return None
    place = np.full(len(tracks), -1)
    place[keyframes] = np.arange(len(keyframes))
    rows = np.flatnonzero((place[tracks.keyframe] >= 0) & np.isfinite(tracks.ray[:, 0]))
    image = np.unique(tracks.track[rows] * len(tracks) + tracks.keyframe[rows])
    views = np.bincount(image // len(tracks))
    # Tracks are numbered as they begin: so some of each keyframe.
    longest = np.flatnonzero(views >= _MIN_VIEWS)[part::2]
    count = np.bincount(tracks.track[rows])[longest].sum()
    longest = longest[spread(len(longest), int(len(longest) * _OBSERVATIONS / max(count, 1)))]
    if len(longest) < _MIN_POINTS:
        return None
    number = np.full(len(views), -1)
    number[longest] = np.arange(len(longest))
    rows = rows[number[tracks.track[rows]] >= 0]
    rows = rows[np.lexsort((tracks.camera[rows], tracks.keyframe[rows], tracks.track[rows]))]
    empty = np.empty(0)
    observations = Observations(
        place[tracks.keyframe[rows]],
        tracks.camera[rows],
        number[tracks.track[rows]],
        tracks.uv[rows],
        tracks.sigma_px[rows],
        empty,
        empty,
    )
    poses = geometry.inverse(tracks.rotation[keyframes], tracks.position[keyframes] - tracks.position[first])
    start = State(*poses, np.zeros((len(longest), 3)), np.empty((0, 3)))
    fixed = np.arange(len(keyframes)) == 0
    return Problem(start, fixed, tracks.cameras, observations)


class _Measure:
    """How well an adjustment explains the observations that are no mismatches, as the given model has them.

    The loss is in units of the usual residual: that of real images is seldom what sigma_px says.
    """

    def __init__(self, norms: FloatArray) -> None:
        usual = float(np.median(norms))
        # Where most residuals are large, the given model is in doubt, and they are not for it to judge.
        self._rows = (norms < _MISMATCH * max(usual, 1.0)) | (usual > _LARGE)
        self.noise = max(float(np.median(norms[self._rows])), 1e-3)  # usual residual with the given model, sigmas

    def __len__(self) -> int:
        return int(np.count_nonzero(self._rows))

    def __call__(self, adjusted: _Adjusted) -> float:
        """Return the mean Cauchy loss of a residual; beyond a limit, and behind a camera, all count the same."""
        norms = np.minimum(adjusted.norms[self._rows], _CAP) / self.noise
        return float(np.log1p(norms * norms).mean())


class _Adjusted:
    """An adjustment with given intrinsics.

    Attributes:
        state: where it ended.
        norms: sizes of the residuals there, sigmas.
    """

    def __init__(self, problem: Problem, params: FloatArray, lens: cameras.Model | None = None) -> None:
        model = problem.cameras.model if lens is None else np.full_like(problem.cameras.model, lens)
        rig = dataclasses.replace(problem.cameras, params=params, model=model)
        self._problem = dataclasses.replace(problem, cameras=rig)
        self.state = solver.solve(_placed(self._problem), _WIDE).state
        self._finish(_NARROW)

    def thorough(self, state: State, measure: _Measure) -> float:
        """Return the mean loss after as many iterations as it takes, from here or from other poses: the lower one."""
        self._finish(_PATIENT)
        costs = [measure(self)]
        for wide in (False, True):
            self.state = state
            if wide:
                self.state = solver.solve(_placed(dataclasses.replace(self._problem, start=state)), _WIDE).state
            self._finish(_PATIENT)
            costs.append(measure(self))
        return min(costs)

    def _finish(self, options: SolverOptions) -> None:
        self.state = solver.solve(_placed(dataclasses.replace(self._problem, start=self.state)), options).state
        self.norms = native_kernels.residual_norms(self._problem, self.state)


def _placed(problem: Problem) -> Problem:
    """Return a problem with its points where the rays of its poses meet; far away where they meet behind a camera."""
    rays, n = triangulation.rays_of(problem), problem.n_points
    if not len(rays.point):
        return problem
    points = triangulation.triangulate(rays, n).points
    ahead = ((points[rays.point] - rays.centre) * rays.direction).sum(axis=1)
    behind = np.bincount(rays.point, ~(ahead > 0.0), n) > 0
    reach = _FAR * float(np.linalg.norm(np.ptp(rays.centre, axis=0)))
    # The last row of a point wins; any of its rays will do.
    points[rays.point[behind[rays.point]]] = (rays.centre + reach * rays.direction)[behind[rays.point]]
    points[~np.isfinite(points).all(axis=1)] = 0.0
    return dataclasses.replace(problem, start=dataclasses.replace(problem.start, points=points))
