# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out whether the cameras' intrinsics are those of the images, by small adjustments with free poses.

Two images hardly tell a wrong focal length: rotation and direction follow it. A dozen keyframes do. So some of them are
adjusted freely: as given; with focal length and principal point free too, the same for all cameras (``bordered.py``);
and once for every lens in question. The sums of residuals (Cauchy) are compared: whoever is clearly lower wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check.adjusted import LARGE, Adjusted, Freed, Measure, problem_of
from ba_node.check.diagnosis import Diagnosis, Finding, Row
from ba_node.check.relations import AGREED, Relation, in_motion, median_share
from ba_node.check.tracks import Tracks
from ba_node.core import cameras
from ba_node.core.cameras import CX, CY, DISTORTION, FX, FY
from ba_node.core.problem import Problem

# Focal lengths that are tried too where the given ones are far off.
_FACTORS = (0.5, 0.7, 1.4, 2.0)
# Changes of the focal length, and of the principal point in focal lengths, that are not named; and the standard
# deviations that they have to be worth. What has a larger standard deviation than the last is not told.
_LEAST_FACTOR, _LEAST_SHIFT = 0.03, 0.02
_SIGMAS, _TOLD = (3.0, 4.0, 4.0), 0.01
# Two estimates of a factor, and of a shift in focal lengths, agree to this.
_SAME_FACTOR, _SAME_SHIFT = 1.06, 0.05
# Factors by which images are made smaller or larger, and how nearly focal length and principal point show one.
_BINNINGS, _NEARLY = (4.0, 2.0, 0.5), 1.12
# Barrel distortion that images have where none is given.
_BARREL = (-0.1, -0.2, -0.3, -0.4)
# Share of the tracks' extent by which a principal point is off their middle where other sizes of the image are tried.
_OFF_CENTRE = 0.2
# Pixels of cameras are square to better than this.
_SQUARE = 1.05
# Another model is better if its sum of residuals is lower by so many times its mean, and by this share: what lenses do
# that no model says leaves less. A focal length alone that is off by less than a factor needs no share, and less of a
# sum, but more standard deviations: both halves of the tracks have to find the same.
_SURE, _SURE_OF_FOCAL, _SLIGHTLY, _SIGMAS_SLIGHTLY = 16.0, 8.0, 1.15, 5.0
_LOWER = 0.05
# A lens is named rather than a focal length and a principal point that leave no less than this part of its sum.
_RATHER = 0.9
# Where fewer tracks than this agree with free relations, the sum has to fall to this share: moving objects pull too.
MOST_AGREE, LEFT = 0.85, 0.75
_TEST = "intrinsics"
_INFO = "camera_info in camera_rig"


@dataclass(frozen=True)
class Model:
    """Cameras in question."""

    cause: str  # what it would mean
    change: str  # what to change
    params: FloatArray  # (n_cam, 12)
    lens: cameras.Model | None = None  # the model of all cameras; None for those given
    focal_alone: bool = False  # it differs in the focal length, slightly but by many of its standard deviations

    def of(self, tracks: Tracks) -> Tracks:
        """Return tracks as these cameras see them."""
        return tracks.seen(params=self.params, lens=self.lens)

    def confirms(self, other: Model) -> bool:
        """Return True if it says the same, whatever the precise numbers."""
        ratio = float(self.params[0, FX] / other.params[0, FX])
        shift = np.abs(self.params[0, CX : CY + 1] - other.params[0, CX : CY + 1]).max() / other.params[0, FX]
        return self.change == other.change and abs(np.log(ratio)) < np.log(_SAME_FACTOR) and shift < _SAME_SHIFT


def check_intrinsics(tracks: Tracks, relations: list[Relation]) -> Diagnosis:
    """Compare cameras by how well they explain a dozen keyframes; other tracks have to confirm what is found."""
    outcome, model = _compare(tracks, relations, part=0)
    if model is None:
        return outcome
    _, other = _compare(tracks, relations, part=1)
    if other is not None and other.confirms(model):
        return outcome
    return Diagnosis(untold=["the intrinsics: tracks contradict each other"], rows=outcome.rows)


def _compare(tracks: Tracks, relations: list[Relation], part: int) -> tuple[Diagnosis, Model | None]:
    """Return what half of the tracks tell, and which cameras are better than the given ones."""
    problem = problem_of(tracks, relations, part)
    if problem is None:
        return Diagnosis(untold=["too few long tracks with parallax to judge the intrinsics"]), None
    given = Adjusted(problem, tracks.cameras.params)
    measure = Measure(given.norms)
    now, n = measure(given), len(measure)
    free = _freed(problem, given, measure, tracks)
    rows = [Row(_TEST, "as given", _explained(now)), Row(_TEST, "free", _explained(measure(free)))]
    lenses = [(model, Adjusted(problem, model.params, model.lens)) for model in other_lenses(tracks)]
    rows += _lens_rows([(model.cause, measure(one)) for model, one in lenses])
    found: list[tuple[Model, Adjusted | Freed]] = []
    if lenses:
        found = [min(lenses, key=lambda one: measure(one[1]))]
    clear = bool(found) and _is_lower(measure(found[0][1]), now, n)
    if not clear or measure(free) < _RATHER * measure(found[0][1]):
        off = _named(tracks, free)
        found = [] if off is None else [(off, free)]
    for model, best in found:
        lowest, alone = measure(best), model.focal_alone
        # Then the given model gets every chance: many iterations, and to begin where the other one ended.
        if _is_lower(lowest, now, n, alone) and _is_lower(lowest, given.thorough(best.state, measure), n, alone):
            if lowest > _left(relations) * now and lowest > _left(in_motion(model.of(tracks))) * now:
                return Diagnosis(untold=["too many outliers to judge the intrinsics"], rows=rows), None
            evidence = f"a free adjustment leaves {lowest / now:.0%} of the loss that it leaves as given"
            return Diagnosis([Finding((model.cause,), evidence, (model.change,))], rows=rows), model
    if free.sigma.max() > _TOLD:
        what = "the focal length" if free.sigma[0] > _TOLD else "the principal point"
        return Diagnosis(untold=[f"the motion so far does not tell {what}"], rows=rows), None
    return Diagnosis(sound=["focal length and principal point fit"], rows=rows), None


def _lens_rows(costs: list[tuple[str, float]]) -> list[Row]:
    """Return one row a cause, of the lens that leaves the lowest mean loss."""
    rows = []
    for cause in dict.fromkeys(cause for cause, _ in costs):
        of_cause = [cost for name, cost in costs if name == cause]
        name = cause if len(of_cause) == 1 else f"{cause} (best of {len(of_cause)} lenses)"
        rows.append(Row(_TEST, name, _explained(min(of_cause))))
    return rows


def _left(relations: list[Relation]) -> float:
    """Return the most that another model may leave of the loss, by how many tracks agree with free relations."""
    share = median_share([one for one in relations if one.has_direction])
    if share < AGREED:
        return 0.0
    return LEFT if share < MOST_AGREE else 1.0


def freed_from(tracks: Tracks, relations: list[Relation], params: FloatArray) -> Model | None:
    """Return cameras whose focal length and principal point are adjusted from some on; None where they are as given."""
    problem = problem_of(tracks, relations, part=0)
    if problem is None:
        return None
    return _named(tracks, Freed(Adjusted(problem, params)))


def loss_of(tracks: Tracks, relations: list[Relation]) -> float:
    """Return the mean loss of a free adjustment of a dozen keyframes; infinite if there is none."""
    problem = problem_of(tracks, relations, part=0)
    if problem is None:
        return np.inf
    adjusted = Adjusted(problem, tracks.cameras.params)
    return Measure(adjusted.norms, noise=1.0)(adjusted)


def _is_lower(cost: float, other: float, observations: int, focal_alone: bool = False) -> bool:
    """Return True if a mean loss is clearly lower than another."""
    share, sure = (0.0, _SURE_OF_FOCAL) if focal_alone else (_LOWER, _SURE)
    return other > (1.0 + share) * cost and observations * (other / cost - 1.0) > sure


def _explained(cost: float) -> float:
    """Return the mean weight of a residual with a mean loss."""
    return float(1.0 / (1.0 + cost))


def _freed(problem: Problem, given: Adjusted, measure: Measure, tracks: Tracks) -> Freed:
    """Return the adjustment whose cameras are free; where those given are far off, from several others on too."""
    found = [Freed(given)]
    if measure.noise > LARGE:
        scaled = [_scaled(tracks.cameras.params, factor) for factor in _FACTORS]
        for params in (*scaled, *(size.params for size in other_sizes(tracks))):
            if np.median(found[-1].norms) < LARGE:
                break  # these explain the tracks: no others do so much better
            found.append(Freed(Adjusted(problem, params)))
    return min(found, key=measure)


def _named(tracks: Tracks, free: Freed) -> Model | None:
    """Return in words how the cameras that fit differ from the given ones; None if they do not."""
    given, fits, sigma = tracks.cameras.params[0], free.params[0], np.array(_SIGMAS) * free.sigma
    factor, shift = float(fits[FX] / given[FX]), (fits[CX : CY + 1] - given[CX : CY + 1]) / given[FX]
    scaled = [
        b
        for b in _BINNINGS
        if _near(1.0 / factor, b) and _near(float(np.mean(given[CX : CY + 1] / fits[CX : CY + 1])), b)
    ]
    if scaled:
        return _size(tracks, scaled[0], free.params)
    causes = []
    slightly = abs(np.log(factor)) < np.log(_SLIGHTLY)
    if abs(np.log(factor)) > max(np.log1p(_LEAST_FACTOR), _SIGMAS_SLIGHTLY * free.sigma[0] if slightly else sigma[0]):
        causes.append(
            f"focal length off by a factor of about {1.0 / factor:.2f}:"
            f" the tracks fit {fits[FX]:.0f} px, not {given[FX]:.0f}"
        )
    if (np.abs(shift) > np.maximum(_LEAST_SHIFT, sigma[1:])).any():
        causes.append(_region(given[CX : CY + 1], f"the tracks fit {_at(fits[CX : CY + 1])}"))
    if not causes:
        return None
    if len(causes) == 1 and "focal" in causes[0]:
        return Model(causes[0], f"k of {_INFO}", free.params, focal_alone=slightly)
    return Model(", and ".join(causes), _ROI, free.params)


def _near(value: float, other: float) -> bool:
    return abs(np.log(value / other)) < np.log(_NEARLY) if value > 0.0 else False


_ROI = f"roi in {_INFO}, or subtract its offset from the principal point in k"


def _region(given: FloatArray, instead: str) -> str:
    return f"region of interest not applied, or principal point wrong: {instead}, k says {_at(given)}"


def _at(uv: FloatArray) -> str:
    return f"({uv[0]:.0f}, {uv[1]:.0f})"


def _size(tracks: Tracks, binning: float, params: FloatArray | None = None) -> Model:
    """Return the cameras of an image that is smaller by a factor than the one that k is of."""
    cause = f"binning not applied: k is that of an image {binning:g} times as large"
    change = f"binning_x and binning_y in {_INFO}, or divide k by {binning:g}"
    if binning < 1.0:
        cause = f"k is that of a smaller image: the tracks are in one {1.0 / binning:g} times as large"
        change = f"binning_x and binning_y in {_INFO} to 1, or multiply k by {1.0 / binning:g}"
    if params is None:
        params = tracks.cameras.params.copy()
        params[:, FX : CY + 1] /= binning
    return Model(cause, change, params)


def _scaled(params: FloatArray, factor: float) -> FloatArray:
    scaled = params.copy()
    scaled[:, FX : FY + 1] *= factor
    return scaled


def other_lenses(tracks: Tracks) -> list[Model]:
    """Return the cameras that are usual mistakes: of the other kind of image, and with square pixels."""
    given = tracks.cameras.params
    models = _square(given)
    plain = given.copy()
    plain[:, DISTORTION] = 0.0
    rational = (tracks.cameras.model == cameras.Model.RATIONAL).all()
    if given[:, DISTORTION].any() and rational:
        cause = "images rectified though a distortion is given"
        models.append(Model(cause, f"d of {_INFO} to zeros (and k to that of the rectified image)", plain))
        models.append(_of_model("equidistant (a fisheye lens)", given, cameras.Model.EQUIDISTANT))
        signs = given.copy()
        signs[:, DISTORTION] *= -1.0
        models.append(
            Model("coefficients of the distortion with other signs, as those that undo it", f"d of {_INFO}", signs)
        )
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
        if given[:, DISTORTION].any():
            models.append(_of_model("plumb_bob", given, cameras.Model.RATIONAL))
    return models


def _of_model(name: str, given: FloatArray, lens: cameras.Model) -> Model:
    """Return the cameras whose coefficients are those of another model than they are given as."""
    cause = f"distortion_model is not that of the coefficients: they fit the tracks as those of {name}"
    return Model(cause, f"distortion_model of {_INFO}", given, lens)


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
    """Return the cameras of a region of the image and of a binned one, if the tracks lie far off the centre."""
    given = tracks.cameras.params
    low, high = np.percentile(tracks.uv, [0.2, 99.8], axis=0)
    middle, centre = 0.5 * (low + high), np.median(given[:, CX : CY + 1], axis=0)
    if not (np.abs(centre - middle) > _OFF_CENTRE * (high - low)).any():
        return []
    region = given.copy()
    region[:, CX : CY + 1] += middle - centre
    models = [Model(_region(centre, f"the tracks lie about {_at(middle)}"), _ROI, region)]
    factor = float(np.median(centre / middle))
    return models + [_size(tracks, binning) for binning in _BINNINGS if 0.75 < factor / binning < 1.33]
