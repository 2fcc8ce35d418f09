# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Camera models of ``sensor_msgs/CameraInfo``: projection, derivatives, and the way back.

With ``a = X/Z``, ``b = Y/Z``, ``s = a^2 + b^2``:

- rational (``rational_polynomial``; ``plumb_bob`` is the case k4 = k5 = k6 = 0, OpenCV's model)::

      g  = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)
      a' = g a + 2 p1 a b + p2 (s + 2 a^2)
      b' = g b + p1 (s + 2 b^2) + 2 p2 a b

- equidistant (Kannala-Brandt, as in OpenCV's fisheye module), ``r = sqrt(X^2 + Y^2)``, ``th = atan2(r, Z)``::

      g  = th (1 + k1 th^2 + k2 th^4 + k3 th^6 + k4 th^8) / r;   a' = g X;  b' = g Y

  so that points behind the image plane are seen as well, up to :data:`MAX_ANGLE` from the axis;

then ``u = fx a' + cx`` and ``v = fy b' + cy``. The Snavely camera of the BAL data sets (2.17-2.21) is plumb_bob
with fx = fy = f and k1, k2 alone, after ``diag(1, -1, -1)``.
"""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.core import columns

ModelArray = NDArray[np.uint8]

# Columns of a row of camera parameters.
FX, FY, CX, CY = range(4)
DISTORTION = slice(4, 12)
N_PARAMS = 12

# A point nearer to the camera plane than this (m) counts as on it.
MIN_DEPTH = 1e-6
# How far from the axis an equidistant camera sees: more than any lens, and away from the pole behind it.
MAX_ANGLE = np.deg2rad(150.0)
LEAST_COSINE = float(np.cos(MAX_ANGLE))
_NEWTON_STEPS = 20
# For th below this the ratios of the equidistant model are taken from their series.
_SMALL_RADIUS2 = 1e-12
# Angles at which a lens is looked at for where its distortion folds over.
_FOLD_STEPS = 2000


class CameraError(ValueError):
    """A camera that cannot be used: unknown model, wrong number of coefficients, numbers out of range."""


class Model(enum.IntEnum):
    """The two families of distortion."""

    RATIONAL = 0
    EQUIDISTANT = 1


# Names in CameraInfo.distortion_model -> family and the numbers of coefficients it may come with.
_NAMES: dict[str, tuple[Model, tuple[int, ...]]] = {
    "plumb_bob": (Model.RATIONAL, (0, 4, 5)),
    "rational_polynomial": (Model.RATIONAL, (0, 8)),
    "equidistant": (Model.EQUIDISTANT, (0, 4)),
}


def parameters(name: str, intrinsics: FloatArray, coefficients: FloatArray) -> tuple[Model, FloatArray]:
    """Return model and (12,) parameters of a camera given as in ``sensor_msgs/CameraInfo``.

    The name is distortion_model; many drivers of rectified cameras leave it empty, where there is no distortion.
    Intrinsics are (4,) fx fy cx cy, px. No coefficients means no distortion; zeros beyond those of the model are let
    pass.

    Raises:
        CameraError: the model is unknown, or the numbers do not fit it.
    """
    if name == "" and not np.any(coefficients):
        name, coefficients = "plumb_bob", coefficients[:0]
    if name not in _NAMES:
        known = ", ".join(_NAMES)
        raise CameraError(
            f"distortion_model {name!r} is not supported: choose one of {known}, or rectify the images and send no d"
        )
    model, counts = _NAMES[name]
    if len(coefficients) > max(counts) and not np.any(coefficients[max(counts) :]):
        coefficients = coefficients[: max(counts)]
    if len(coefficients) not in counts:
        expected = " or ".join(str(c) for c in counts)
        raise CameraError(f"{name} has {len(coefficients)} coefficients, expected {expected}")
    if not (np.isfinite(intrinsics).all() and np.isfinite(coefficients).all()):
        raise CameraError(f"camera parameters are not finite: k = {intrinsics}, d = {coefficients}")
    if intrinsics[FX] <= 0 or intrinsics[FY] <= 0:
        raise CameraError(f"focal lengths fx = {intrinsics[FX]:g}, fy = {intrinsics[FY]:g} px: expected > 0")
    params = np.zeros(N_PARAMS)
    params[:4] = intrinsics
    params[4 : 4 + len(coefficients)] = coefficients
    return model, params


def fold(model: Model, params: FloatArray) -> tuple[float, float]:
    """Return from where on the distortion folds over: the image of rays farther out turns back.

    Given as the angle of the ray from the axis, rad, and as the length of its distorted ray; inf without a limit.
    Tangential terms are left out.
    """
    if not params[DISTORTION].any():
        return np.inf, np.inf
    angle = np.linspace(0.0, np.pi if model == Model.EQUIDISTANT else np.deg2rad(89.0), _FOLD_STEPS)
    with np.errstate(all="ignore"):
        if model == Model.EQUIDISTANT:
            t2 = angle * angle
            k1, k2, k3, k4 = params[4:8]
            radius = angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        else:
            radial = np.where(np.isin(np.arange(N_PARAMS), (6, 7)), 0.0, params)
            ray = np.stack([np.tan(angle), np.zeros(_FOLD_STEPS)], axis=1)
            radius = _rational(ray, radial[None, DISTORTION])[0][:, 0]
        turns = np.flatnonzero(~(np.diff(radius) > 0.0))
    return (float(angle[turns[0]]), float(radius[turns[0]])) if len(turns) else (np.inf, np.inf)


def widest(model: Model, params: FloatArray) -> float:
    """Return how far from the axis a distorted ray may lie and be the image of one ray alone; inf without a limit."""
    return fold(model, params)[1]


def behind(x_cam: FloatArray, model: ModelArray) -> BoolArray:
    """Return which points no camera of their row's model can see: (n,).

    Those on or behind the camera plane; for the equidistant model, which sees beyond it, those near the axis behind.

    Points are (n, 3), m; the model is (n,) or (1,).
    """
    hidden = x_cam[:, 2] <= MIN_DEPTH
    fisheye = model == Model.EQUIDISTANT
    if fisheye.any():
        distance = np.linalg.norm(x_cam, axis=1)
        hidden = np.where(fisheye, (x_cam[:, 2] <= LEAST_COSINE * distance) | (distance <= MIN_DEPTH), hidden)
    return np.asarray(hidden)


def project(x_cam: FloatArray, model: ModelArray, params: FloatArray) -> FloatArray:
    """Project points (n, 3) in the optical frame of each row's camera, m, to pixels.

    What is :func:`behind` gives infinities or pixels without meaning: callers sort these out. Model and parameters are
    those of each row, (n,) and (n, 12), or (1,) and (1, 12) of all; without distortion beyond k1 and k2 six will do.

    Returns:
        (n, 2) u, v, px.
    """
    fisheye = model == Model.EQUIDISTANT
    if not fisheye.any():
        ray = x_cam[:, :2] / x_cam[:, 2:]
        distorted = _rational(ray, params[:, DISTORTION])[0] if params[:, DISTORTION].any() else ray
    elif fisheye.all():
        distorted = _equidistant(x_cam, params[:, DISTORTION])[0]
    else:
        distorted = np.empty((len(x_cam), 2))
        straight = ~fisheye
        ray = x_cam[straight, :2] / x_cam[straight, 2:]
        distorted[straight] = _rational(ray, params[straight, DISTORTION])[0]
        distorted[fisheye] = _equidistant(x_cam[fisheye], params[fisheye, DISTORTION])[0]
    return params[:, FX : FY + 1] * distorted + params[:, CX : CY + 1]


def project_jacobian(
    x_cam: FloatArray, model: ModelArray, params: FloatArray, *, intrinsics: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project points, with derivatives; arrays as of :func:`project`, those by f, k1 and k2 if they are wanted.

    The pixels are those of :func:`project` to rounding: the lenses stand once, and here one division by z serves both.

    Returns:
        uv: (n, 2) px; d uv / d x_cam: (n, 2, 3) px/m; d uv / d (f, k1, k2): (n, 2, 3) where f scales fx and fy
        alike (fx = fy = f when the camera's own fx and fy are 1), or (n, 2, 0) where it is not wanted.
    """
    fisheye = model == Model.EQUIDISTANT
    if fisheye.any() and not fisheye.all():
        return _mixed_jacobian(x_cam, fisheye, params, intrinsics=intrinsics)
    focal = params[:, FX : FY + 1]
    d_x = columns.empty(len(x_cam), 2, 3)
    if fisheye.any():
        distorted, jacobian, by_k12 = _equidistant(x_cam, params[:, DISTORTION])
        base = x_cam[:, :2]
        for i in range(2):
            np.multiply(jacobian[:, i], focal[:, i, None], out=d_x[:, i])
    else:
        inverse_z = 1.0 / x_cam[:, 2:]
        base = x_cam[:, :2] * inverse_z
        distorted, by_k12 = base, base
        if not intrinsics and not params[:, DISTORTION].any():
            d_x[:, 0, 1] = d_x[:, 1, 0] = 0.0
            for i in range(2):
                np.multiply(focal[:, i], inverse_z[:, 0], out=d_x[:, i, i])
                np.multiply(d_x[:, i, i], -base[:, i], out=d_x[:, i, 2])
        else:
            distorted, jacobian, by_k12 = _rational(base, params[:, DISTORTION])
            for i in range(2):
                np.multiply(jacobian[:, i], focal[:, i, None] * inverse_z, out=d_x[:, i, :2])
            d_x[:, :, 2] = -(d_x[:, :, 0] * base[:, :1] + d_x[:, :, 1] * base[:, 1:])
    d_intrinsics = columns.empty(len(x_cam), 2, 3 if intrinsics else 0)
    if intrinsics:
        d_intrinsics[:, :, 0] = distorted
        d_intrinsics[:, :, 1:] = (base * focal)[:, :, None] * by_k12[:, None, :]
    return focal * distorted + params[:, CX : CY + 1], d_x, d_intrinsics


def _mixed_jacobian(
    x_cam: FloatArray, fisheye: BoolArray, params: FloatArray, *, intrinsics: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Do the work of project_jacobian for rows of both models."""
    out = (
        np.empty((len(x_cam), 2)),
        columns.empty(len(x_cam), 2, 3),
        columns.empty(len(x_cam), 2, 3 if intrinsics else 0),
    )
    for rows, model in ((~fisheye, Model.RATIONAL), (fisheye, Model.EQUIDISTANT)):
        one = np.array([model], np.uint8)
        parts = project_jacobian(x_cam[rows], one, params[rows], intrinsics=intrinsics)
        for whole, part in zip(out, parts, strict=True):
            whole[rows] = part
    return out


def rays(uv: FloatArray, model: ModelArray, params: FloatArray) -> FloatArray:
    """Return the directions in which cameras see pixels (n, 2), the inverse of :func:`project`.

    Returns:
        (n, 3) unit vectors in the optical frame; NaN where no ray projects to the pixel (outside the model's domain).
    """
    fisheye = model == Model.EQUIDISTANT
    out = np.ones((len(uv), 3))
    straight = ~fisheye if fisheye.any() else slice(None)
    out[straight, :2] = _undistort(uv[straight], params[straight])
    out[straight] /= np.linalg.norm(out[straight], axis=1)[:, None]
    if fisheye.any():
        out[fisheye] = _fisheye_rays(uv[fisheye], params[fisheye])
    return out


def normalise(uv: FloatArray, model: ModelArray, params: FloatArray) -> FloatArray:
    """Return X/Z, Y/Z of the rays of pixels (n, 2); NaN where there is none, or one that is beyond 90 degrees."""
    fisheye = model == Model.EQUIDISTANT
    if not fisheye.any():
        return _undistort(uv, params)
    ray = rays(uv, model, params)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(ray[:, 2:] > 0.0, ray[:, :2] / ray[:, 2:], np.nan)


def _target(uv: FloatArray, params: FloatArray) -> FloatArray:
    return np.asarray((uv - params[:, CX : CY + 1]) / params[:, FX : FY + 1])


def _undistort(uv: FloatArray, params: FloatArray) -> FloatArray:
    """Return X/Z, Y/Z of pixels of rational cameras, by Newton's method."""
    target = _target(uv, params)
    if not params[:, DISTORTION].any():
        return target
    ray = target
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            distorted, jacobian, _ = _rational(ray, params[:, DISTORTION])
            step = _solve2(jacobian, target - distorted)
            # Limited steps: far out in a strong distortion the full Newton step overshoots the domain.
            limit = 0.5 * (1.0 + np.linalg.norm(ray, axis=1, keepdims=True))
            size = np.linalg.norm(step, axis=1, keepdims=True)
            ray = ray + step * np.minimum(1.0, limit / np.maximum(size, 1e-300))
            if not np.any(size > 1e-13 * limit):
                break
        error = np.abs(_rational(ray, params[:, DISTORTION])[0] - target).max(axis=1, initial=0.0)
    return np.where((error < 1e-7)[:, None], ray, np.nan)


def _fisheye_rays(uv: FloatArray, params: FloatArray) -> FloatArray:
    """Return unit rays of pixels of equidistant cameras: Newton's method for the angle to the axis."""
    target = _target(uv, params)
    radius = np.linalg.norm(target, axis=1)
    k = params[:, DISTORTION]
    angle = np.minimum(radius, MAX_ANGLE)
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            bent, slope = _bent_angle(angle, k)
            step = (bent - radius) / slope
            angle = np.clip(angle - np.clip(step, -0.5, 0.5), 0.0, MAX_ANGLE)
            if not np.any(np.abs(step) > 1e-15):
                break
        bent, slope = _bent_angle(angle, k)
        sound = (np.abs(bent - radius) < 1e-9) & (slope > 0.0)
        across = np.sin(angle) * np.where(radius > 0.0, 1.0 / radius, 1.0)
    ray = np.stack([target[:, 0] * across, target[:, 1] * across, np.cos(angle)], axis=1)
    return np.where(sound[:, None], ray, np.nan)


def _solve2(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve (n, 2, 2) systems by Cramer's rule."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    determinant = a * d - b * c
    return np.stack(
        [(d * rhs[:, 0] - b * rhs[:, 1]) / determinant, (a * rhs[:, 1] - c * rhs[:, 0]) / determinant], axis=1
    )


def _rational(ray: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distort by the rational model; ``k`` is (n, 8) k1 k2 p1 p2 k3 k4 k5 k6, or (n, 2) k1 k2."""
    a, b = ray[:, 0], ray[:, 1]
    s = a * a + b * b
    k1, k2 = k[:, 0], k[:, 1]
    if not k[:, 2:].any():
        return _radial(ray, 1.0 + s * (k1 + s * k2), k1 + 2.0 * s * k2, (s, s * s))
    p1, p2, k3, k4, k5, k6 = (k[:, i] for i in range(2, 8))
    over = 1.0 / (1.0 + s * (k4 + s * (k5 + s * k6)))
    g = (1.0 + s * (k1 + s * (k2 + s * k3))) * over
    dg = (k1 + s * (2 * k2 + 3 * s * k3) - g * (k4 + s * (2 * k5 + 3 * s * k6))) * over
    distorted, jacobian, by_k12 = _radial(ray, g, dg, (s * over, s * s * over))
    distorted[:, 0] += 2 * p1 * a * b + p2 * (s + 2 * a * a)
    distorted[:, 1] += p1 * (s + 2 * b * b) + 2 * p2 * a * b
    cross = 2 * (p1 * a + p2 * b)
    jacobian[:, 0, 0] += 2 * p1 * b + 6 * p2 * a
    jacobian[:, 0, 1] += cross
    jacobian[:, 1, 0] += cross
    jacobian[:, 1, 1] += 6 * p1 * b + 2 * p2 * a
    return distorted, jacobian, by_k12


def _radial(
    ray: FloatArray, g: FloatArray, dg: FloatArray, by_k12: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``g ray``, its derivatives for a factor g(s) with derivative dg, and the two factors side by side."""
    jacobian = columns.empty(len(ray), 2, 2)
    bent = 2.0 * dg[:, None] * ray
    np.multiply(bent[:, :1], ray, out=jacobian[:, 0])
    jacobian[:, 1, 0] = jacobian[:, 0, 1]
    np.multiply(bent[:, 1], ray[:, 1], out=jacobian[:, 1, 1])
    jacobian[:, 0, 0] += g
    jacobian[:, 1, 1] += g
    return g[:, None] * ray, jacobian, np.stack(by_k12).T


def _bent_angle(angle: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the radius in the image of an angle to the axis, and its derivative; ``k`` is (n, 8) k1 k2 k3 k4."""
    t2 = angle * angle
    poly = 1.0 + t2 * (k[:, 0] + t2 * (k[:, 1] + t2 * (k[:, 2] + t2 * k[:, 3])))
    slope = 1.0 + t2 * (3 * k[:, 0] + t2 * (5 * k[:, 1] + t2 * (7 * k[:, 2] + 9 * t2 * k[:, 3])))
    return angle * poly, slope


def _equidistant(x: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project points (n, 3) by the equidistant model; ``k`` is (n, 8) k1 k2 k3 k4 and zeros.

    Returns:
        (n, 2) a', b'; their derivatives by the points (n, 2, 3); and (n, 2) by what to multiply X and Y for the
        derivatives by k1 and by k2.
    """
    flat2 = x[:, 0] * x[:, 0] + x[:, 1] * x[:, 1]
    z = x[:, 2]
    small = flat2 < _SMALL_RADIUS2 * z * z
    flat = np.sqrt(np.where(small, 1.0, flat2))
    angle = np.arctan2(flat, z)
    bent, slope = _bent_angle(angle, k)
    over = 1.0 / (flat2 + z * z)
    # a' = g X;  dg/dX = X bend;  dg/dZ = -slope over.
    with np.errstate(divide="ignore", invalid="ignore"):
        g = np.where(small, 1.0 / z, bent / flat)
        bend = np.where(small, 2.0 * (k[:, 0] - 1.0 / 3.0) / z**3, (slope * z * over - g) / np.where(small, 1.0, flat2))
        slope = np.where(small, 1.0, slope)
        k1 = np.where(small, flat2 / z**3, angle**3 / flat)
        k2 = np.where(small, 0.0, k1 * angle * angle)
    jacobian = columns.empty(len(x), 2, 3)
    jacobian[:, 0, 0] = g + bend * x[:, 0] * x[:, 0]
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = bend * x[:, 0] * x[:, 1]
    jacobian[:, 1, 1] = g + bend * x[:, 1] * x[:, 1]
    jacobian[:, :, 2] = -(slope * over)[:, None] * x[:, :2]
    return g[:, None] * x[:, :2], jacobian, np.stack([k1, k2]).T
