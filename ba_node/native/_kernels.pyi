# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The C++ kernels (src/bindings/module.cpp). Arguments named ``out`` are written to and have to be float64, contiguous.

Shapes: n_free keyframes that are not fixed, d = 6 or 9 unknowns each, n = n_free d; see core/problem.py for the rest.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

class State(Protocol):
    """As core.problem.State."""

    @property
    def rotation(self) -> Doubles: ...
    @property
    def translation(self) -> Doubles: ...
    @property
    def points(self) -> Doubles: ...
    @property
    def intrinsics(self) -> Doubles: ...

class Problem(Protocol):
    """As core.problem.Problem; of its factors only the pairs of keyframes matter here, which are an argument."""

    @property
    def start(self) -> State: ...
    @property
    def fixed(self) -> NDArray[np.bool_]: ...
    @property
    def cameras(self) -> object: ...
    @property
    def observations(self) -> object: ...

class PcgLimits(Protocol):
    """As core.linear.PcgLimits."""

    @property
    def t_eps(self) -> float: ...
    @property
    def max_iterations(self) -> int: ...
    @property
    def radius(self) -> float: ...
    @property
    def q_eps(self) -> float: ...

class Rays(Protocol):
    """As core.triangulation.Rays."""

    @property
    def point(self) -> Ints: ...
    @property
    def centre(self) -> Doubles: ...
    @property
    def direction(self) -> Doubles: ...
    @property
    def px_per_rad(self) -> Doubles: ...
    @property
    def distance_m(self) -> Doubles: ...
    @property
    def distance_sigma_m(self) -> Doubles: ...

class Kernel:
    """One problem; the arrays are copied. cost: loss, its scale, cheirality, the least promise of a point's step."""

    def __init__(
        self, problem: Problem, cost: tuple[str, float, str, float], factor_pairs: tuple[Ints, Ints], threads: int
    ) -> None: ...
    @property
    def n_free(self) -> int: ...
    @property
    def n_chunks(self) -> int: ...
    @property
    def gradient_norm(self) -> float: ...
    def pairs(self) -> tuple[int, int]:
        """Return the number of (point, free keyframe), and of pairs of them with the same point."""

    def linearise(self, state: State) -> float:
        """Return the objective."""

    def linearise_prepared(self) -> bool:
        """Linearise where the last inner iterations ended; return False if too little is known of it."""

    def add_factors(self, diagonal: Doubles, gradient: Doubles, pairs: Doubles) -> None:
        """Add (n_free, 6, 6) and (n_free, 6); set the blocks of the coupled pairs, (n_pairs, 6, 6)."""

    def objective(self, state: State) -> float: ...
    def inner_iterations(self, state: State, steps: int) -> tuple[float, float, Doubles]:
        """Return the objective before and after, and the points."""

    def gradient(self) -> Doubles:
        """Return the keyframes' part of the gradient, (n_free, d)."""

    def diagonals(self, of_points: bool) -> tuple[Doubles, Doubles]:
        """Return diag(B) (n_free, d) and diag(C) (n_points, 3), or (0, 3)."""

    def step(self, state: State, step_c: Doubles, steps: int, out: State) -> tuple[float, float, float, float]:
        """Return predicted reduction, 1/2 p'Dp, and the objective before and after the inner iterations."""

    def factor(self, damping_c: Doubles, damping_p: Doubles) -> None: ...
    def damp(self, diagonal: bool, mu: float) -> None: ...
    def length2(self, diagonal: bool, x: Doubles) -> float:
        """Return |D x|^2 (n,) with D^2 the diagonal of B, not damped, or the identity."""

    def rhs(self, out: Doubles) -> None: ...
    def dense(self, out: Doubles) -> None: ...
    def solve(self, out: Doubles) -> bool: ...
    def schur_pattern(self) -> tuple[NDArray[np.int32], Ints]:
        """Return columns and row starts of the upper triangle of S, by blocks."""

    def sparse(self, place: Ints, mirrored: Ints, out: Doubles) -> None:
        """Write block k of that to out[place[k]] (d, d), transposed to out[mirrored[k]] unless that is negative."""

    def analyse(self, max_blocks: int, max_products: float) -> tuple[bool, int, float]:
        """Return whether the sparse factor meets the limits, its blocks, and products of blocks to find it."""

    def solve_sparse(self) -> Doubles | None: ...
    def pcg(self, scale: Doubles, kind: str, limits: PcgLimits, formed: bool, out: Doubles) -> tuple[bool, int, bool]:
        """Return whether there is a solution, iterations, and whether it lies on the boundary of the region."""

    def product(self, x: Doubles) -> Doubles: ...
    def diagonal_blocks(self) -> Doubles: ...
    def back_substitute(self, step_c: Doubles) -> tuple[Doubles, float]: ...

class SparseFactor:
    """The sparse Cholesky factor of a symmetric matrix by d x d blocks, d = 6 or 9, given by its upper triangle."""

    def __init__(self, d: int, columns: Ints, starts: Ints) -> None:
        """Find its structure from the columns of each row, the diagonal first, and where rows start."""

    def solve(self, blocks: Doubles, x: Doubles) -> bool:
        """Turn the right-hand side x (n d,) into the solution; False if the matrix is not positive definite."""

class RelativePoses:
    """Factors on relative poses, as core.factors.RelativePoses; the arrays are copied.

    The first keyframe is -1 where it is the world; ``lever_arm`` (n, 3), if there is one, is the point of the second
    body whose place is meant.
    """

    def __init__(self, factors: object, column: Ints, pair: Ints) -> None: ...
    def value(self, state: State) -> float: ...
    def linearise(self, state: State, gradient: Doubles, diagonal: Doubles, pairs: Doubles) -> float:
        """Return the value; add to the other arguments."""

def targets() -> tuple[str, ...]:
    """Return what is compiled in and this processor runs, the widest first."""

def target() -> str:
    """Return which of them new kernels are made of."""

def use_target(name: str) -> None:
    """Choose one of them for kernels made from now on."""

def allocations() -> int:
    """Return how often the kernels have asked for memory."""

def resect(
    problem: Problem, keyframe: int, cost: tuple[str, float], limits: tuple[int, int, float, float]
) -> tuple[Doubles, Doubles, NDArray[np.bool_]] | None:
    """Return what core.resection._pose does; cost: loss and its scale; limits: as its module has them."""

def residual_norms(problem: Problem, state: State) -> Doubles: ...
def residual_norms_of(problem: Problem, state: State, rows: Ints) -> Doubles:
    """Return the same of some observations."""

def triangulate(rays: Rays, n_points: int) -> tuple[Doubles, Doubles, NDArray[np.bool_]]: ...
def agreeing(rays: Rays, n_points: int, gate: float) -> NDArray[np.bool_]: ...
def consensus(
    rays: Rays, n_points: int, gate: float
) -> tuple[Doubles, Doubles, NDArray[np.bool_], NDArray[np.bool_]]: ...
def views_of(last: Ints, previous: Ints, landmarks: Ints, newest: int) -> Ints:
    """Return the rows of all views of landmarks (-1), or of the newest of each, by landmark, in order of arrival."""

def distinct_landmarks(table: object, begin: Ints, end: Ints, scratch: Ints) -> Ints:
    """Return the different landmarks in the rows from each begin to its end of an ObservationTable, in no order.

    Here and below scratch holds -1 for each row of keyframes or landmarks, and does again afterwards.
    """

def inliers_by_keyframe(table: object, rows: Ints, scratch: Ints) -> tuple[Ints, Ints]:
    """Return the keyframes of those of some rows that are no outliers, in no order, and how many each has."""

def gather(
    table: object, rows: Ints, listed: tuple[Ints, Ints], scratch: tuple[Ints, Ints]
) -> tuple[Ints, Ints, Ints, Ints, Doubles, Doubles, Doubles]:
    """Return views of listed landmarks by listed keyframes; see scene.views.Views.gather."""

def take(
    observations: object, rows: Ints, of_point: Ints, of_keyframe: Ints
) -> tuple[Ints, Ints, Ints, Doubles, Doubles, Doubles, Doubles]:
    """Return the columns of core.problem.Observations at some rows, renumbered by what is not empty."""

def rays(problem: Problem, seen: Doubles) -> tuple[tuple[Doubles, Doubles, Doubles, Doubles, Doubles], bool] | None:
    """Return the columns of core.triangulation.Rays but the first, and whether all observations have a ray.

    seen: (n_obs, 3) unit vectors in the cameras, or (0,) for cameras without distortion; None if one has some.
    """

def agreed(
    rays: Rays, n_points: int, gate: float, limits: tuple[float, float, float, float]
) -> tuple[Doubles, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the fields of window.initial_points.Agreed; limits: least parallax (rad), and constants there."""

def determined(
    observations: object,
    usable: NDArray[np.bool_],
    least: tuple[NDArray[np.bool_], Ints, int],
    points: tuple[NDArray[np.bool_], NDArray[np.bool_]],
) -> tuple[Ints, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return rows, keyframes and points that are left; see window.problems.determined.

    least: whether a keyframe may take part, points that it has to see, observations likewise. points: that may take
    part, and that count.
    """

def move_more_than_noise(
    observations: object, norms: Doubles, off: Doubles, n_points: int, limits: tuple[float, float, float, int, float]
) -> NDArray[np.bool_]:
    """Return which points move, see window.moving; limits are the first five constants there."""

def may_have_run_away(
    point: Ints,
    norms: Doubles,
    points: tuple[Doubles, Doubles],
    of: tuple[Doubles, NDArray[np.bool_]],
    limits: tuple[float, float, float],
) -> tuple[NDArray[np.bool_], Ints, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which points may have run away, views that agree, and which are far away, began there, have leapt.

    See window.merging. ``points`` are where they are and began, ``of`` the centre and what is far away in no case, (0,)
    for none; limits are the gate, how far that is, m, and the share of a leap.
    """

def stand_out(observations: object, norms: Doubles, n_cameras: int, far: float) -> NDArray[np.bool_]:
    """Return which views are off by more than those before and after them, see window.moving."""

def seen_by_keyframe(
    observations: object, used: NDArray[np.bool_], marked: NDArray[np.bool_], n_keyframes: int
) -> tuple[Ints, Ints]:
    """Return how many of some observations each keyframe has, and how many of them are of marked points."""

def explained(
    problem: Problem,
    views: tuple[Ints, Ints, Doubles],
    tracks: tuple[int, int],
    poses: tuple[Doubles, Doubles, Doubles, Doubles],
    limits: tuple[float, float, float, int, int],
) -> tuple[Doubles, Doubles, float, Doubles] | None:
    """Return the fields of window.trial.Explained; None as of rays.

    views: rows, the track of each, and seen, as of rays. tracks: how many, and how many took no part. poses: two sets.
    limits: constants of window.trial.
    """

def is_sound(problem: Problem) -> bool:
    """Return whether indices are in range, observations sorted, numbers finite, sigmas positive."""

def are_sound(steps: object, n_keyframes: int, most: float) -> bool:
    """Return True if relative poses are finite, of different keyframes that exist, and rotations to within ``most``."""

def are_sane_tracks(
    ids: NDArray[np.uint64],
    uv: Doubles,
    sigma: Doubles,
    depth: Doubles,
    bounds: tuple[float, float, float, float, float],
) -> bool:
    """Return what scene.ingest._nothing_to_check does; bounds of |uv|, sigma from and to, depth from and to."""

def tracks_to_try(track_id: NDArray[np.uint64], point: Ints, wanted: int, least_views: int, multiplier: int) -> Ints:
    """Return the first of what window.trial.choose does; point of each usable observation."""

def quaternions(rotation: Doubles) -> Doubles:
    """Return core.geometry.quaternion_from_matrix of (n, 3, 3)."""

def rotations(quaternion: Doubles) -> Doubles:
    """Return core.geometry.matrix_from_quaternion of (n, 4)."""

def seem_to_move(
    observations: object,
    norms: Doubles,
    unplaced: NDArray[np.bool_],
    unrefined: NDArray[np.bool_],
    of_noise: tuple[float, float, int],
    limits: tuple[float, float, float, float, float],
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return what window.moving._off and _leaves_more_than_noise do, where points without a place do not count."""

def steps_between(rotation: Doubles, position: Doubles, first: Ints, second: Ints) -> tuple[Doubles, Doubles]:
    """Return turns (n, 3, 3) and moves (n, 3) between poses that are world from body."""

def inverse_steps_between(
    rotation: Doubles, translation: Doubles, first: Ints, second: Ints
) -> tuple[Doubles, Doubles]:
    """Return the same between poses that are body from world."""

def compare_steps(
    steps: tuple[Doubles, Doubles], measured: tuple[Doubles, Doubles], worth: tuple[float, float, float, float, float]
) -> tuple[Doubles, Doubles, Doubles, Doubles, Doubles, Doubles]:
    """Return the fields of window.steps.Comparison.

    worth: the guard's sigma of a move and its share, the same of turns, and that of turns for each metre.
    """

def steps_against(
    poses: tuple[Doubles, Doubles, Doubles, Doubles],
    pairs: tuple[Ints, Ints],
    worth: tuple[float, float, float, float, float],
    limits: tuple[float, float, float, int],
) -> tuple[tuple[Doubles, Doubles], tuple[Doubles, Doubles], tuple[Doubles, ...], float, float]:
    """Return what window.steps.against does: two sets of poses that are body from world; worth as of compare_steps.

    limits are constants of window.steps.
    """

def rows_of_points(point: Ints, wanted: Ints) -> tuple[Ints, Ints]:
    """Return where points stand in a column that ascends, one after the other, and which of them each place is of."""

def shared_pixels(
    ids: tuple[NDArray[np.uint64], NDArray[np.uint64]], uv: tuple[Doubles, Doubles]
) -> tuple[int, int] | None:
    """Return what scene.still_images._shared does; None unless the ids of both images rise."""

def agreeing_by_camera(camera: Ints, norms: Doubles, gate: float, n_cameras: int) -> tuple[Ints, Ints]:
    """Return how many observations of each camera have residuals up to a gate, and how many it has."""

def medians_off(
    steps: tuple[Doubles, Doubles], others: tuple[Doubles, Doubles], sigma_rad: Doubles, sigma_m: Doubles
) -> tuple[float, float]:
    """Return the medians of how far steps are off others, in standard deviations: of turns and of moves."""

def loosest(blocks: Doubles, positions: Doubles, most: float) -> tuple[float, float]:
    """Return what core.covariance.weakest does, of blocks (n, 6, 6) of S and positions (n, 3)."""

def numbers(text: bytes) -> Doubles | None:
    """Return the numbers between white space, None where something is no finite number as C++ reads them."""

def from_bal(
    cameras: Doubles, point: Ints, uv: Doubles
) -> tuple[Doubles, Doubles, Doubles, Doubles, Ints, Doubles] | None:
    """Return what cameras (n, 9) and images (n_obs, 2) of BAL are in core/problem.py.

    Rotation, translation, intrinsics; uv, camera and sigma. None unless ``point`` ascends.
    """

def cut_patches(image: Floats, uv: Doubles, offsets: Floats) -> Floats:
    """Return what front_end.patches.sample does at uv (n, 2) by offsets (m, 2): (n, m)."""

def align_patches(
    image: Floats,
    patches: tuple[Floats, Doubles, Floats, Floats],
    uv: Doubles,
    affine: Doubles,
    bend: Doubles,
    limits: tuple[int, float, float, float, float],
) -> tuple[Doubles, Doubles, Doubles, Doubles, Doubles]:
    """Return what front_end.patches._align does: place, A, correlation, the variance left unexplained, inverse Hessian.

    patches: as cut, prior (2 or 3 movements), grid and window; bend may be empty; limits: iterations, the step that
    ends them and the longest one, px, the least variance of a template and what is added to each diagonal of a Hessian.
    """

def pose_equations(
    seen: tuple[Doubles, Doubles, Doubles, Doubles, Doubles], rotation: Doubles, translation: Doubles, cauchy: float
) -> tuple[Doubles, Doubles, Doubles]:
    """Return what front_end.pose._equations does; seen: points, along, uv, sigma, and the camera (focal, u, v)."""
