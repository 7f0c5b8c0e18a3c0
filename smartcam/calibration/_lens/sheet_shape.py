"""What is printed is not quite what was meant: the points of a sheet as the views show them.

Printers stretch, paper bends. Where many views show the same points off in the same way, the sheet
is off, and a lens that is fitted to the points as they were meant takes the blame. Here the points
are adjusted, too: in turn with the lenses and poses, each from all of its views. As a whole they
keep place, direction and size of the points that were meant, so no scale is lost.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Final, Literal, TypeAlias, TypeVar

import numpy as np

from smartcam.calibration._lens.bundle import adjust, known_lens
from smartcam.calibration._lens.projection import excess, linearize, whitening

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.bundle import AdjustedBundle, Bundle, Sight

Errors = TypeVar("Errors")

Sheet: TypeAlias = Literal["auto", "exact", "free"]
"""Whether a sheet's points are where they were meant to be."""

LOOSE: Final = 0.01
"""Standard deviation that a point is thought to be off, in parts of its distance to the next."""

ROUNDS: Final = 15
"""In which points and cameras are adjusted in turn."""

ROUNDS_WITHOUT: Final = 4
"""The same where one pose is left out of what has been adjusted."""

SETTLED: Final = 1e-3
"""Part of the weighted squares by which the last round still lowers them."""

GAIN: Final = 0.9
"""Held-out error with adjusted points over that without, up to which they are worth it."""


def adjust_shape(
    bundle: Bundle, sights: Sequence[Sight], more: float, *, rounds: int = ROUNDS
) -> AdjustedBundle:
    """Return the least squares in which the target's points are adjusted, too.

    ``bundle`` is near the solution; its ``points`` are where the target's points start from, None
    for where they were meant to be. ``more``: first guess of the variance beside the points'
    covariance, pixels^2; found anew. ``rounds``: at most.
    """
    covariance = np.concatenate([one.view.covariance for one in sights])
    bundle = dataclasses.replace(bundle, points=_points(bundle, sights))
    adjusted = adjust(bundle, sights, more)
    for _ in range(rounds):
        points = _moved(adjusted.bundle, sights, more)
        better = adjust(dataclasses.replace(adjusted.bundle, points=points), sights, more)
        settled = adjusted.weighted - better.weighted <= SETTLED * adjusted.weighted
        if not better.weighted < adjusted.weighted:
            break
        adjusted = better
        if settled:
            break
        more = excess(np.concatenate(better.residuals), covariance, better.freedom)
        adjusted = adjust(better.bundle, sights, more)
    return adjusted


def choose_shape(
    adjusted: AdjustedBundle,
    sights: Sequence[Sight],
    sheet: Sheet,
    held_out: Callable[[AdjustedBundle], Errors],
    rms: Callable[[Errors], float],
) -> tuple[AdjustedBundle, Errors]:
    """Return the fit with the target's points as meant or as seen, and its held-out errors.

    ``adjusted`` has the points as they were meant. ``sheet``: ``auto``: what has the smaller
    held-out error, where it is clearly smaller. ``held_out`` gives the held-out errors of a fit,
    ``rms`` is of these; NaN where there are none.
    """
    errors = held_out(adjusted)
    if sheet == "exact" or (sheet == "auto" and math.isnan(rms(errors))):
        return adjusted, errors
    free = adjust_shape(adjusted.bundle, sights, adjusted.more)
    seen = held_out(free)
    better = free.freedom > 0 and rms(seen) <= GAIN * rms(errors)
    return (free, seen) if sheet == "free" or better else (adjusted, errors)


def leave_out(adjusted: AdjustedBundle, sights: Sequence[Sight], pose: int) -> Bundle:
    """Return the same fit without the views of one pose."""
    others = [one for one in sights if one.pose != pose]
    if adjusted.bundle.points is None:
        return adjust(adjusted.bundle, others, adjusted.more).bundle
    return adjust_shape(adjusted.bundle, others, adjusted.more, rounds=ROUNDS_WITHOUT).bundle


def held_out_residuals(
    bundle: Bundle, sights: Sequence[Sight], pose: int, more: float
) -> list[Array]:
    """Return the residuals of a pose's views (N, 2), pixels, where nothing but it is adjusted."""
    lenses = tuple(known_lens(one) for one in bundle.cameras)
    known = dataclasses.replace(bundle, basis=lenses, rigid=True)
    return adjust(known, [one for one in sights if one.pose == pose], more).residuals


def _points(bundle: Bundle, sights: Sequence[Sight]) -> Array:
    return sights[0].view.target.points if bundle.points is None else bundle.points


def _moved(bundle: Bundle, sights: Sequence[Sight], more: float) -> Array:
    """Return the points (T, 3) that fit the views best with everything else as it is."""
    # Of each point: minimise sum |L^T (r - J d)|^2 + |p + d - meant|^2 / loose^2, so
    # (sum J^T C^-1 J + I / loose^2) d = sum J^T C^-1 r + (meant - p) / loose^2. The last is a
    # prior: a point that few views show does not go astray. J has the chain rule's R_c R.
    meant, points = sights[0].view.target.points, _points(bundle, sights)
    spacing = float(np.linalg.norm(meant[1:] - meant[0], axis=1).min())
    weight = 1.0 / (LOOSE * spacing) ** 2
    normal = np.tile(weight * np.eye(3), (len(meant), 1, 1))
    right = weight * (meant - points)
    for camera, number, view in sights:
        pose = bundle.from_first(camera) @ bundle.poses.taken(number)
        seen = linearize(pose.apply(points[view.ids]), bundle.cameras[camera])
        white = whitening(view.covariance, more)
        by_point = white @ seen.by_point @ pose.rotation
        off = white @ (view.points - seen.pixels)[..., None]
        normal[view.ids] += by_point.swapaxes(1, 2) @ by_point
        right[view.ids] += (by_point.swapaxes(1, 2) @ off)[..., 0]
    return as_meant(points + np.linalg.solve(normal, right[..., None])[..., 0], meant)


def as_meant(points: Array, meant: Array) -> Array:
    """Return points with place, direction and size of those that were meant."""
    # Least squares of s R a + t - b: with the points centred and sum b a^T = U S V^T it is
    # R = U diag(1, 1, det(U V^T)) V^T and s = sum b (R a) / sum |a|^2.
    # Source: Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point
    # Patterns (1991).
    middle = points.mean(axis=0)
    near, far = points - middle, meant - meant.mean(axis=0)
    left, _, right = np.linalg.svd(far.T @ near)
    turn = left @ np.diag([1.0, 1.0, math.copysign(1.0, np.linalg.det(left @ right))]) @ right
    turned = near @ turn.T
    size = float((turned * far).sum() / (turned**2).sum())
    fitted: Array = size * turned + meant.mean(axis=0)
    return fitted
