"""Find edges, lines and circles by OpenCV and scikit-image, for comparison.

Each is used as its documentation and most answers on the web do it. What is not installed, or finds
nothing, gives NaN.
"""

from __future__ import annotations

import contextlib
import importlib
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from tests.inspection.rendering import Array

skimage_measure: Any = None
with contextlib.suppress(ImportError):
    skimage_measure = importlib.import_module("skimage.measure")

NOTHING = math.nan


def edge_by_profile(picture: Any, start: Array, end: Array, width: int) -> float:
    """Return the steepest place of a profile from its middle, by a parabola through the maximum."""
    if skimage_measure is None:
        return NOTHING
    (u0, v0), (u1, v1) = start, end
    profile = skimage_measure.profile_line(
        picture.astype(float), (v0, u0), (v1, u1), linewidth=width, order=1, mode="nearest"
    )
    slopes = np.abs(np.gradient(profile))
    top = int(np.argmax(slopes[2:-2])) + 2
    before, at, after = slopes[top - 1 : top + 2]
    peak = top + 0.5 * (before - after) / (before - 2 * at + after)
    step = math.dist(start, end) / math.ceil(math.dist(start, end))
    return float(peak * step - math.dist(start, end) / 2)


def contour_points(picture: Any) -> Array:
    """Return the points (N, 2) of the longest contour at the middle level."""
    if skimage_measure is None:
        return np.zeros((0, 2))
    levels = picture.astype(float)
    middle = (np.percentile(levels, 5) + np.percentile(levels, 95)) / 2
    contours = skimage_measure.find_contours(levels, middle)
    longest = max(contours, key=len, default=np.zeros((0, 2)))
    points: Array = longest[:, ::-1]
    return points


def canny_points(picture: Any) -> Array:
    """Return the pixels (N, 2) of OpenCV's Canny edges."""
    scaled = picture if picture.dtype == np.uint8 else (picture // 257).astype(np.uint8)
    v, u = np.nonzero(cv2.Canny(cv2.GaussianBlur(scaled, (5, 5), 1.0), 30, 90))
    return np.column_stack([u, v]).astype(np.float64)


def near(points: Array, far: Callable[[Array], Array], reach: float) -> Array:
    """Return the points within ``reach`` of the expected line."""
    return points[np.abs(far(points)) <= reach] if len(points) else points


def line_by_opencv(points: Array) -> tuple[Array, Array] | None:
    """Return a point and the direction of the line through points, by Huber's weights."""
    if len(points) < 2:
        return None
    found = cv2.fitLine(points.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()
    return found[2:].astype(float), found[:2].astype(float)


def line_by_ransac(points: Array) -> tuple[Array, Array] | None:
    """Return a point and the direction of the line by scikit-image's RANSAC."""
    if skimage_measure is None or len(points) < 2:
        return None
    model, _ = skimage_measure.ransac(
        points, skimage_measure.LineModelND, 2, 0.5, max_trials=200, rng=1
    )
    return None if not model else (np.asarray(model.origin), np.asarray(model.direction))


def circle_by_ransac(points: Array) -> Array:
    """Return centre and radius (3,) by scikit-image's RANSAC."""
    if skimage_measure is None or len(points) < 3:
        return np.full(3, NOTHING)
    model, _ = skimage_measure.ransac(
        points, skimage_measure.CircleModel, 3, 0.5, max_trials=200, rng=1
    )
    return np.array([*model.center, model.radius]) if model else np.full(3, NOTHING)


def circle_by_hough(picture: Any, radius: float) -> Array:
    """Return centre and radius (3,) by OpenCV's HoughCircles."""
    scaled = picture if picture.dtype == np.uint8 else (picture // 257).astype(np.uint8)
    found = cv2.HoughCircles(
        cv2.GaussianBlur(scaled, (5, 5), 1.0),
        cv2.HOUGH_GRADIENT_ALT,
        1.0,
        radius,
        param1=100,
        param2=0.8,
        minRadius=int(0.7 * radius),
        maxRadius=int(1.3 * radius) + 1,
    )
    return np.full(3, NOTHING) if found is None else np.asarray(found, float).reshape(-1, 3)[0]
