"""Grids of dots in images: found, numbered from their origin, centred."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.extra import load
from smartcam.calibration.imaging.dots import GridMap, refine_dots
from smartcam.calibration.imaging.grey import USUAL_SIZE, scaled
from smartcam.calibration.imaging.ordering import arrangements, lattice, leftmost, marked
from smartcam.calibration.imaging.sampling import mean_level
from smartcam.calibration.imaging.views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration.geometry import Array
    from smartcam.calibration.imaging.dots import Dots
    from smartcam.calibration.imaging.grey import GreyImage
    from smartcam.calibration.imaging.ordering import Arrangement
    from smartcam.calibration.imaging.targets import CircleGrid

__all__ = ["find_circles"]

RING = np.column_stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)])
"""(16, 2), points of the unit circle."""


def find_circles(image: GreyImage, target: CircleGrid, name: str = "") -> TargetView:
    """Return where the centres of a grid's dots are seen.

    Raises:
        CalibrationError: TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    for found in _candidates(image, target):
        ways = arrangements(found, lattice(found), target)
        if ways:
            break
    else:
        raise _not_found(image, target)
    way, margin = _number(image, target, found, ways)
    flat, order = target.points[:, :2], way.order.ravel()
    diameters = np.full(len(flat), target.diameter)
    diameters[0] = target.origin_diameter or target.diameter
    seen = GridMap(flat, found[order])
    dots = _refine(image, target, seen, found[order], diameters)
    shifts = GridMap(flat, dots.points - seen.shifts(flat, diameters)).shifts(flat, diameters)
    return TargetView(
        target=target,
        size=image.size,
        ids=np.arange(len(flat), dtype=np.intp),
        points=dots.points - shifts,
        covariance=dots.covariance,
        margin=margin,
        name=name,
    )


def _refine(
    image: GreyImage, target: CircleGrid, seen: GridMap, points: Array, diameters: Array
) -> Dots:
    """Return dots, each looked at to the middle of the gap to the next one."""
    flat, radii = target.points[:, :2], diameters / 2
    apart = target.spacing * (math.sqrt(0.5) if target.asymmetric else 1.0)
    gaps = apart - 2 * radii
    gaps[1:] = np.minimum(gaps[1:], np.linalg.norm(flat[1:], axis=1) - radii[0] - radii[1:])
    gaps[0] = gaps[1:].min()
    directions = seen.ways(flat, target.diameter / 2) / (target.diameter / 2)
    reaches = radii + gaps / 2
    return refine_dots(
        image,
        points,
        directions * radii[:, None, None],
        directions * reaches[:, None, None],
    )


def _number(
    image: GreyImage, target: CircleGrid, found: Array, ways: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    what = f"{target.columns} x {target.rows} dots"
    if target.origin_diameter is None:
        return leftmost(ways, what), None
    flat = target.points[:, :2]
    around = RING * (target.diameter + target.origin_diameter) / 4
    return marked(
        ways,
        lambda order: mean_level(image, GridMap(flat, found[order.ravel()])(around)),
        f"{what}, of which the larger one is the origin",
    )


def _scales(image: GreyImage) -> tuple[float, float]:
    usual = min(1.0, USUAL_SIZE / max(image.size))
    return usual, 2 * usual


def _candidates(image: GreyImage, target: CircleGrid) -> Iterator[Array]:
    """Yield all dots in any order, as OpenCV finds them in one size of the image or another."""
    cv2 = load("cv2")
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    pattern = (target.columns, target.rows)
    for scale in _scales(image):
        looked_at = scaled(image, scale)
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            ok, centres = cv2.findCirclesGrid(
                looked_at, pattern, flags=flags, blobDetector=_blobs(looked_at, target)
            )
            if ok:
                found: Array = np.array(centres, dtype=np.float64).reshape(-1, 2)
                yield (found + 0.5) / scale - 0.5


def _not_found(image: GreyImage, target: CircleGrid) -> CalibrationError:
    """Return an error that says how many dots are seen."""
    looked_at = scaled(image, _scales(image)[0])
    count = len(_blobs(looked_at, target).detect(looked_at))
    return CalibrationError(
        f"circles: expected {target.columns} x {target.rows} dots, saw {count} dark spots and no "
        "such grid among them",
        code=Code.TARGET_NOT_FOUND,
        expected=target.columns * target.rows,
        got=count,
    )


def _blobs(image: NDArray[np.uint8], target: CircleGrid) -> Any:
    cv2 = load("cv2")
    given = cv2.SimpleBlobDetector_Params()
    given.minThreshold, given.maxThreshold, given.thresholdStep = 20, 230, 10
    given.minRepeatability = 2
    given.filterByArea, given.minArea = True, 10
    given.maxArea = image.size / (target.columns * target.rows)
    given.filterByCircularity = False
    given.filterByInertia = False
    given.filterByConvexity, given.minConvexity = True, 0.9
    given.minDistBetweenBlobs = 5
    return cv2.SimpleBlobDetector_create(given)
