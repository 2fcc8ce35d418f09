# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on keyframes: all terms of the objective that are not reprojections.

A factor has a whitened residual ``r = W e`` on one to n keyframes, and a robust loss of its own: it adds
``1/2 Psi(|r|)`` to the objective. With J_k its derivative by the step of keyframe k (weighted as in loss.py), it adds
``J_k' r`` to the gradient, ``J_k' J_k`` to the blocks of B, and ``J_k' J_l`` between two free keyframes. So B is no
longer block diagonal, and S = B - E C^-1 E' has blocks also where two keyframes share no point. Points do not enter:
eliminating them is as cheap as before.

The relative pose of keyframe j in keyframe i is ``T_ij = T_i T_j^-1`` (body i from body j), with T = R, t body from
world. Against a measured one, ``R_m, t_m``::

    e = (Log(R_m' R_ij), t_ij - t_m),    R_ij = R_i R_j',    t_ij = t_i - R_ij t_j

The local step ``R <- R Exp(dphi), t <- t + R dt`` multiplies T from the right, so that only the difference of both
steps enters::

    de = A (step_i - step_j),    A = [Jr^-1(e_phi) R_j     0  ]
                                     [R_i [R_j' t_j]x     R_i ]

The global one (3.26-3.28) is ``dphi_local = Jr(phi) dphi, dt_local = R' dt``: blocks are turned after they are summed.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import columns, geometry, loss
from ba_node.core.problem import KeyframeFactors, ProblemError, State
from ba_node.kept import kept_property

# A measured rotation may differ from an orthonormal one by this much.
_ORTHONORMAL = 1e-6
# Of so many keyframes it is remembered how factors couple them: there to find out takes longer than the sums.
_WINDOW = 100


@dataclass(frozen=True)
class RelativePoses:
    """Measured poses of one keyframe in another; one end may be fixed."""

    keyframes: IntArray  # (n, 2) i and j
    rotation: FloatArray  # (n, 3, 3) body i from body j
    translation: FloatArray  # (n, 3) body i from body j: where j is in i, m
    root_information: FloatArray  # (n, 6, 6) W, on rotation (rad), then translation (m) along the axes of body i
    loss: str = "squared"  # robust loss
    loss_scale: float = 1.0  # where it leaves the square

    def __len__(self) -> int:
        return len(self.keyframes)

    def take(self, rows: IntArray | BoolArray, number: IntArray) -> RelativePoses:
        """Return some of them; ``number`` (n_kf,) are the new indices of the keyframes."""
        return replace(
            self,
            keyframes=number[self.keyframes[rows]],
            rotation=self.rotation[rows],
            translation=self.translation[rows],
            root_information=self.root_information[rows],
        )

    def residuals(self, state: State, errors: FloatArray | None = None) -> FloatArray:
        """Return the whitened residuals, (n, 6); ``errors`` if they are known."""
        errors = self.errors(state) if errors is None else errors
        return np.asarray((self.root_information @ errors[:, :, None])[..., 0])

    def jacobians(
        self, state: State, errors: FloatArray | None = None, derivatives: FloatArray | None = None
    ) -> FloatArray:
        """Return the derivatives of the residuals by the local steps of both keyframes, (n, 2, 6, 6).

        ``errors`` and ``derivatives`` if they are known.
        """
        errors = self.errors(state) if errors is None else errors
        a = self.root_information @ (self.derivatives(state, errors) if derivatives is None else derivatives)
        return np.stack([a, -a], axis=1)

    def derivatives(self, state: State, errors: FloatArray) -> FloatArray:
        """Return A, (n, 6, 6)."""
        first, second = self.keyframes.T
        rotation_i, rotation_j = state.rotation[first], state.rotation[second]
        centre = (np.swapaxes(rotation_j, 1, 2) @ state.translation[second][:, :, None])[..., 0]
        a = np.zeros((len(self), 6, 6))
        a[:, :3, :3] = geometry.inverse_right_jacobian(errors[:, :3]) @ rotation_j
        a[:, 3:, :3] = rotation_i @ geometry.hat(centre)
        a[:, 3:, 3:] = rotation_i
        return a

    def check(self, n_keyframes: int) -> None:
        """Raise ProblemError if shapes, indices or numbers are wrong; name the first offender."""
        n = len(self)
        shapes = {"keyframes": (n, 2), "rotation": (n, 3, 3), "translation": (n, 3), "root_information": (n, 6, 6)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise ProblemError(f"{name} of the relative poses has shape {array.shape}, expected {shape}")
        if native.kernels is not None and native.kernels.are_sound(self, n_keyframes, _ORTHONORMAL):
            _check_loss(self)
            return
        for name in shapes:
            array = getattr(self, name)
            if not np.isfinite(array).all():
                bad = ~np.isfinite(array).reshape(n, -1).all(axis=1)
                raise ProblemError(f"{name} of relative pose {int(np.argmax(bad))} is not finite")
        turned = np.abs(self.rotation @ np.swapaxes(self.rotation, 1, 2) - np.eye(3))
        mirrored = np.linalg.det(self.rotation) < 0.0
        if turned.max(initial=0.0) > _ORTHONORMAL or mirrored.any():
            bad = mirrored | (turned.max(axis=(1, 2)) > _ORTHONORMAL)
            raise ProblemError(f"rotation of relative pose {int(np.argmax(bad))} is no rotation: expected R R' = I")
        same = self.keyframes[:, 0] == self.keyframes[:, 1]
        if same.any():
            row = int(np.argmax(same))
            raise ProblemError(f"relative pose {row} is of keyframe {self.keyframes[row, 0]} in itself")
        check_common(self, n_keyframes)

    def errors(self, state: State) -> FloatArray:
        """Return e, (n, 6), not whitened."""
        first, second = self.keyframes.T
        rotation = state.rotation[first] @ np.swapaxes(state.rotation[second], 1, 2)
        translation = state.translation[first] - (rotation @ state.translation[second][:, :, None])[..., 0]
        angle = geometry.so3_log(np.swapaxes(self.rotation, 1, 2) @ rotation)
        return np.concatenate([angle, translation - self.translation], axis=1)


@dataclass(frozen=True)
class Pairs:
    """Blocks of B between two free keyframes, by their numbers among the free ones; those below the diagonal follow."""

    rows: IntArray  # (n_pairs,) the lower number
    columns: IntArray  # (n_pairs,) the higher number; pairs are distinct and sorted
    blocks: FloatArray  # (n_pairs, 6, 6)

    def product(self, x: FloatArray) -> FloatArray:
        """Return the product with x, (n_free, d), d >= 6; the same."""
        out = np.zeros_like(x)
        np.add.at(out[:, :6], self.rows, (self.blocks @ x[self.columns, :6, None])[..., 0])
        np.add.at(out[:, :6], self.columns, (np.swapaxes(self.blocks, 1, 2) @ x[self.rows, :6, None])[..., 0])
        return out

    def matrix(self, n_free: int, size: int) -> scipy.sparse.bsr_matrix:
        """Return the blocks as a symmetric block-sparse matrix, (size n_free, size n_free)."""
        rows, columns = np.concatenate([self.rows, self.columns]), np.concatenate([self.columns, self.rows])
        order = np.lexsort((columns, rows))
        blocks = np.zeros((len(rows), size, size))
        blocks[:, :6, :6] = np.concatenate([self.blocks, np.swapaxes(self.blocks, 1, 2)])[order]
        bounds = np.searchsorted(rows[order], np.arange(n_free + 1))
        return scipy.sparse.bsr_matrix((blocks, columns[order], bounds), shape=(size * n_free, size * n_free))


@dataclass(frozen=True)
class FactorTerms:
    """What all factors add to the equations of the free keyframes."""

    value: float  # 1/2 sum Psi
    gradient: FloatArray  # (n_free, 6)
    diagonal: FloatArray  # (n_free, 6, 6) to the blocks of B
    pairs: Pairs  # between two free keyframes

    def curvature(self, step: FloatArray) -> float:
        """Return ``p'H p`` of the factors' part of H for a step (n_free, d), d >= 6."""
        own = (self.diagonal @ step[:, :6, None])[..., 0]
        return float(np.sum(step[:, :6] * (own + self.pairs.product(step)[:, :6])))


class FactorSum:
    """The sum of all factors of a problem.

    Attributes:
        rows: (n_pairs,) as of Pairs, of all that the factors couple.
        columns: (n_pairs,) the same.
    """

    def __init__(self, factors: Sequence[KeyframeFactors], fixed: BoolArray, parameterisation: str = "local") -> None:
        """Find which free keyframes they couple; ``fixed`` is (n_kf,)."""
        self._factors, self._parameterisation = tuple(factors), parameterisation
        # Rotation and translation of the same steps are two kinds.
        ends = {id(kind.keyframes): kind.keyframes for kind in self._factors}
        given = fixed.tobytes(), *((one.shape[1], one.astype(np.intp).tobytes()) for one in ends.values())
        # A window couples its keyframes as the one before does.
        found = _coupled(*given) if len(fixed) <= _WINDOW else _coupled.__wrapped__(*given)
        self._free, self._column, self.rows, self.columns, pairs = found
        # By kind: (n, n_places) the pair that each two places of a factor belong to, -1 if one of them is fixed.
        self._pair = [pairs[list(ends).index(id(kind.keyframes))] for kind in self._factors]

    def value(self, state: State) -> float:
        """Return 1/2 sum Psi."""
        known: Known = {}
        return sum(self._value(kind, state, known) for kind in self._factors)

    def linearise(self, state: State) -> FactorTerms:
        """Return what the factors add at a state."""
        n = len(self._free)
        gradient, diagonal = np.zeros((n, 6)), np.zeros((n, 6, 6))
        between = np.zeros((len(self.rows), 6, 6))
        terms = FactorTerms(0.0, gradient, diagonal, Pairs(self.rows, self.columns, between))
        known: Known = {}
        value = sum(self._add(kind, number, state, terms, known) for number, kind in enumerate(self._factors))
        return self._stepped(state, replace(terms, value=value))

    @kept_property
    def _targets(self) -> list[tuple[list[_Sum], list[tuple[int, int, _Sum]]]]:
        """Return where the terms of each kind go: by place, and by the places of the lower and the higher keyframe."""
        targets = []
        for kind, pair in zip(self._factors, self._pair, strict=True):
            column = self._column[kind.keyframes]
            of_pairs = []
            for place, (a, b) in enumerate(itertools.combinations(range(column.shape[1]), 2)):
                for low, high in ((a, b), (b, a)):
                    of_pairs.append((low, high, _Sum(np.where(column[:, low] < column[:, high], pair[:, place], -1))))
            targets.append(([_Sum(one) for one in column.T], of_pairs))
        return targets

    @staticmethod
    def _value(kind: KeyframeFactors, state: State, known: Known) -> float:
        residual = kind.residuals(state, *_errors(kind, state, known))
        return 0.5 * float(np.sum(_weigh(kind, residual)[0]))

    def _add(self, kind: KeyframeFactors, number: int, state: State, terms: FactorTerms, known: Known) -> float:
        """Add what the factors of a kind, by its number, have at a state to terms; return their share of the value."""
        errors = _errors(kind, state, known, derivatives=True)
        residual, jacobian = kind.residuals(state, *errors[:1]), kind.jacobians(state, *errors)
        cost, weight = _weigh(kind, residual)
        # All products at once: J'J of all places, beside it J'r.
        both = np.concatenate([*jacobian.swapaxes(0, 1), residual[:, :, None]], axis=2)
        products = np.swapaxes(both[:, :, :-1] * weight[:, None, None], 1, 2) @ both
        of_places, of_pairs = self._targets[number]
        for a, to in enumerate(of_places):
            mine = products[to.rows, 6 * a : 6 * a + 6]
            to.add(terms.gradient, mine[:, :, -1])
            to.add(terms.diagonal, mine[:, :, 6 * a : 6 * a + 6])
        for low, high, to in of_pairs:
            if len(to.rows):
                to.add(terms.pairs.blocks, products[to.rows, 6 * low : 6 * low + 6, 6 * high : 6 * high + 6])
        return 0.5 * float(np.sum(cost))

    def _stepped(self, state: State, terms: FactorTerms) -> FactorTerms:
        """Return terms by the steps of the parameterisation in place of local ones."""
        if self._parameterisation == "local":
            return terms
        rotation = state.rotation[self._free]
        turn = np.zeros((len(rotation), 6, 6))
        turn[:, :3, :3] = geometry.right_jacobian(geometry.so3_log(rotation))
        turn[:, 3:, 3:] = np.swapaxes(rotation, 1, 2)
        back = np.swapaxes(turn, 1, 2)
        return FactorTerms(
            terms.value,
            (back @ terms.gradient[:, :, None])[..., 0],
            back @ terms.diagonal @ turn,
            replace(terms.pairs, blocks=back[self.rows] @ terms.pairs.blocks @ turn[self.columns]),
        )


@functools.lru_cache(maxsize=4)
def _coupled(fixed: bytes, *ends: tuple[int, bytes]) -> tuple[IntArray, IntArray, IntArray, IntArray, list[IntArray]]:
    """Return the free keyframes, the number of each keyframe among them, and which pairs of them factors couple.

    ``fixed`` are booleans (n_kf,), ``ends`` the keyframes of factors, so many of each; both as bytes. Of each such kind
    the last list tells the pair that each two places of a factor belong to. Nobody may change what is returned.
    """
    is_fixed = np.frombuffer(fixed, bool)
    free = (~is_fixed).nonzero()[0]
    column, n = np.full(len(is_fixed), -1, np.intp), len(free)
    column[free] = np.arange(n)
    keys = [_keys(column[np.frombuffer(one, np.intp).reshape(-1, places)], n) for places, one in ends]
    distinct = np.concatenate([key.ravel() for key in keys]) if keys else np.empty(0, np.intp)
    distinct = distinct[distinct >= 0]
    if not (distinct[1:] > distinct[:-1]).all():  # those of consecutive keyframes rise
        distinct = np.unique(distinct)
    rows, others = np.divmod(distinct, max(n, 1))
    return free, column, rows, others, [np.where(key >= 0, np.searchsorted(distinct, key), -1) for key in keys]


def _keys(column: IntArray, n: int) -> IntArray:
    """Return a key of the pair of free keyframes at each two places of a factor, (n, n_places), -1 for none."""
    keys = []
    for a, b in itertools.combinations(range(column.shape[1]), 2):
        low, high = np.minimum(column[:, a], column[:, b]), np.maximum(column[:, a], column[:, b])
        keys.append(np.where(low >= 0, low * n + high, -1))
    return np.stack(keys, axis=1) if keys else np.empty((len(column), 0), np.intp)


class _Sum:
    """Rows that are added to those of a sum, (n,) -1 for none: several of them to one, or each to its own."""

    def __init__(self, index: IntArray) -> None:
        rows = np.flatnonzero(index >= 0)
        self.rows = rows[np.argsort(index[rows], kind="stable")]  # that are added, in the order of what they go to
        self._begins = columns.starts(index[self.rows])
        self._to = index[self.rows[self._begins]]

    def add(self, out: FloatArray, values: FloatArray) -> None:
        """Add the values of ``rows``."""
        if len(self._to) < len(self.rows):
            values = np.add.reduceat(values, self._begins, axis=0)
        out[self._to] += values


# Errors at a state by the arrays of what was measured, with their derivatives where these are wanted: rotation and
# translation of the same steps are two kinds.
Known = dict[tuple[int, ...], tuple[FloatArray, ...]]


def _errors(kind: KeyframeFactors, state: State, known: Known, *, derivatives: bool = False) -> tuple[FloatArray, ...]:
    """Return the errors of relative poses, found once for kinds that share their measurements; nothing of others."""
    if not isinstance(kind, RelativePoses):
        return ()
    key = id(kind.keyframes), id(kind.rotation), id(kind.translation)
    if key not in known:
        errors = kind.errors(state)
        known[key] = (errors, kind.derivatives(state, errors)) if derivatives else (errors,)
    return known[key]


def check_common(kind: KeyframeFactors, n_keyframes: int) -> None:
    """Raise ProblemError if factors of a kind name keyframes that do not exist, or a loss."""
    bad = (kind.keyframes < 0) | (kind.keyframes >= n_keyframes)
    if bad.any():
        row, place = np.argwhere(bad)[0]
        what = f"keyframe index {kind.keyframes[row, place]} is out of range [0, {n_keyframes})"
        raise ProblemError(f"factor {row} ({type(kind).__name__}): {what}")
    _check_loss(kind)


def _check_loss(kind: KeyframeFactors) -> None:
    if kind.loss not in loss.LOSSES or not (np.isfinite(kind.loss_scale) and kind.loss_scale > 0.0):
        known = ", ".join(loss.LOSSES)
        raise ProblemError(
            f"factors ({type(kind).__name__}) with loss {kind.loss!r} of scale {kind.loss_scale}: expected one of"
            f" {known} with a scale > 0"
        )


def _weigh(kind: KeyframeFactors, residual: FloatArray) -> loss.CostAndWeight:
    return loss.evaluate(kind.loss, np.sqrt(np.sum(residual * residual, axis=1)), kind.loss_scale)
