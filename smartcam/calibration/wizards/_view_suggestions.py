"""Suggest the views from which a camera should look at a target, and draw their outlines.

The first views are always the same. As soon as the views determine a lens, the next view is the one
that reduces the lens' uncertainty most.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._lens.guide import suggest_views
from smartcam.calibration._lens.intrinsics import MIN_VIEWS, calibrate_intrinsics
from smartcam.calibration.formats._robots import rotation_zyx
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._lens.guide import NextView
    from smartcam.calibration._targets import Target
    from smartcam.calibration._views import TargetView
    from smartcam.geometry._inside import Array


class Look(NamedTuple):
    """One of the standard views, each of which adds information to the views before."""

    text: str  # text for people
    # direction in the image about which the target is tilted, degrees from u towards v
    axis: float = 0.0
    tilt: float = 0.0  # tilt, degrees
    roll: float = 0.0  # turn about the line of sight, degrees
    fill: float = 0.6  # share of the image's width or height that the target fills
    place: tuple[float, float] = (0.5, 0.5)  # centre, as shares of the image's width and height


STANDARD_VIEWS: Final = (
    Look("straight from the front, the sheet in the middle of the image"),
    Look("tilted by 30 degrees about one side of the sheet", tilt=30),
    Look("tilted by 30 degrees to the opposite side", tilt=-30),
    Look("tilted by 30 degrees about the other side of the sheet", axis=90, tilt=30),
    Look("tilted by 30 degrees to the opposite side of that", axis=90, tilt=-30),
    Look("turned by 90 degrees about the line of sight", roll=90),
    Look("turned by 90 degrees the other way, and tilted by 20 degrees", tilt=20, roll=-90),
    Look("nearer, so that the sheet fills the image, tilted by 20 degrees", tilt=20, fill=0.95),
    Look("farther away, tilted by 30 degrees towards a corner of the sheet", 45, 30, fill=0.35),
    Look(
        "with the sheet in a corner of the image, tilted towards another corner",
        135,
        30,
        fill=0.45,
        place=(0.27, 0.27),
    ),
)
"""Views to take, in the best order."""

ROLLS_RADIANS: Final = (0.0, math.pi / 2, -math.pi / 2)
"""Turns about the line of sight, radians, that a camera on a robot needs; one for each view in
turn."""


class Suggestion(NamedTuple):
    """The suggestion for the next view."""

    text: str  # text for people
    outline: Array  # (4, 2), outline of the target in the image, pixels
    gain: str = ""  # benefit of the view, for people; empty if it is not known


def suggest_view(views: Sequence[TargetView], *, lens_known: bool) -> Suggestion:
    """Return the next view to take after views (one or more) of one target.

    ``lens_known``: whether the lens is known already, so that the views need not determine it.
    """
    next_view = None if lens_known else _most_helpful_view(views)
    if next_view is None:
        look = STANDARD_VIEWS[len(views) % len(STANDARD_VIEWS)]
        return Suggestion(look.text, outline(look, views[0].target, views[0].size))
    return Suggestion(
        f"with the sheet {next_view.text}",
        next_view.outline,
        f"the lens is known to within {next_view.rms_without:.2g} pixels over the image; with this "
        f"view, to within {next_view.rms_with:.2g}",
    )


def _most_helpful_view(views: Sequence[TargetView]) -> NextView | None:
    """Return the view that improves the lens most; None if no lens is determined yet."""
    if len(views) < MIN_VIEWS:
        return None
    try:
        lens = calibrate_intrinsics(views)
    except CalibrationError:
        return None
    # the workpieces that will be seen are assumed to be as far away as the target
    distance = float(np.median(np.linalg.norm(lens.target_points, axis=1)))
    suggested = suggest_views(
        lens, distance=distance, roll=ROLLS_RADIANS[len(views) % len(ROLLS_RADIANS)]
    )
    return suggested[0] if suggested else None


FOCAL_LENGTH_WIDTHS: Final = 1.2
"""Focal length, in image widths, of the camera for which outlines are drawn."""


def outline(look: Look, target: Target, size: tuple[int, int]) -> Array:
    """Return the outline of a target in a view by an average camera, (4, 2), pixels.

    ``size``: width and height of the image, pixels.
    """
    low, high = target.points.min(axis=0), target.points.max(axis=0)
    half = (high - low) / 2
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    axis, tilt, roll = np.radians([look.axis, look.tilt, look.roll]).tolist()
    towards_camera = np.diag([1.0, -1.0, -1.0])
    tilted = rotation_zyx(axis, 0.0, tilt) @ rotation_zyx(-axis, 0.0, 0.0) @ towards_camera
    rotated = corners @ (rotation_zyx(roll, 0.0, 0.0) @ tilted).T
    focal, image = FOCAL_LENGTH_WIDTHS * size[0], np.array(size, dtype=np.float64)
    distance = 10.0 * float(np.linalg.norm(half))
    for _ in range(5):  # the distance also changes the perspective
        projected = focal * rotated[:, :2] / (rotated[:, 2:] + distance)
        distance *= float((np.ptp(projected, axis=0) / image).max()) / look.fill
    projected = focal * rotated[:, :2] / (rotated[:, 2:] + distance)
    outline_px: Array = (
        projected - (projected.max(axis=0) + projected.min(axis=0)) / 2 + image * look.place
    )
    return outline_px
