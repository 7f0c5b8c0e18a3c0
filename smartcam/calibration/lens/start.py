"""Unknowns of a lens, and a first guess of them from views of a target."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.lens.bundle import (
    IDENTITY,
    Bundle,
    Motion,
    Sight,
    adjust,
    adjust_weighted,
)
from smartcam.calibration.lens.model import COEFFICIENTS, CameraModel
from smartcam.calibration.lens.poses import locate, plane_poses
from smartcam.calibration.optional_imports import load
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.lens.bundle import Adjusted
    from smartcam.calibration.lens.model import DistortionModel
    from smartcam.calibration.views import TargetView

__all__ = ["NAMES", "fit_lens", "lens_basis", "parameter_names"]

NAMES: Final[dict[DistortionModel, tuple[str, ...]]] = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
"""Of the coefficients, in their order."""

FOCAL_LENGTHS: Final = (0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
"""First guesses, in parts of the image's longer side: fields of view of 127 to 11 degrees."""

GUESSED: Final = 8
"""Views that judge a first guess."""

BEST: Final = 2
"""First guesses that must lead to their end; the best of these counts."""


def parameter_names(model: DistortionModel) -> tuple[str, ...]:
    """Return the names of what :func:`~smartcam.calibration.lens.bundle.lens_values` gives.

    Raises:
        CalibrationError: ``SHAPE``: no such model.
    """
    if model not in NAMES:
        raise CalibrationError(
            f"distortion model: expected one of {list(NAMES)}, got {model!r}",
            code=Code.SHAPE,
            expected=list(NAMES),
            got=model,
        )
    return ("fx", "fy", "cx", "cy", *NAMES[model])


def lens_basis(model: DistortionModel, fixed: Iterable[str] = ()) -> Array:
    """Return by how much each value of a lens changes with each unknown (4 + K, F).

    Args:
        model: of the distortion.
        fixed: names of coefficients that stay 0; ``aspect``: fx and fy are one unknown.

    Raises:
        CalibrationError: ``SHAPE``: no such model, or a name that it does not have.
    """
    names, held = parameter_names(model), set(fixed)
    unknown = sorted(held.difference(NAMES[model], {"aspect"}))
    if unknown:
        raise CalibrationError(
            f"fixed: expected coefficients of {model} ({', '.join(NAMES[model])}) or aspect, got "
            f"{', '.join(unknown)}",
            code=Code.SHAPE,
            expected=[*NAMES[model], "aspect"],
            got=unknown,
        )
    columns = np.eye(len(names))
    if "aspect" in held:
        columns[:, 0] += columns[:, 1]
        held.add("fy")
    kept: Array = columns[:, [name not in held for name in names]]
    return kept


def fit_lens(
    views: Sequence[TargetView], model: DistortionModel, fixed: Iterable[str] = ()
) -> Adjusted:
    """Return the lens and the poses that show the views' points where they are.

    Several first guesses of the focal length are judged by a few of the views, the best ones are
    adjusted: first the focal length alone, then what bends most, then the rest.

    Args:
        views: of images of one size.
        model: of the distortion.
        fixed: as :func:`lens_basis` takes it.

    Raises:
        CalibrationError: ``POOR_FIT``: no guess leads anywhere; and as :func:`lens_basis` says.
    """
    basis = lens_basis(model, fixed)
    guesses = sorted(_guesses(views, model), key=lambda one: _misfit(one, views))
    followed = (_follow(guess, views, basis) for guess in guesses)
    found = list(itertools.islice((one for one in followed if one is not None), BEST))
    if not found:
        raise CalibrationError(
            f"intrinsics: expected a lens that shows the {len(views)} views as they are, got none "
            f"from focal lengths of {FOCAL_LENGTHS[0]} to {FOCAL_LENGTHS[-1]} image widths",
            code=Code.POOR_FIT,
        )
    return min(found, key=lambda one: one.weighted / max(one.freedom, 1) + one.more)


def _guesses(views: Sequence[TargetView], model: DistortionModel) -> list[CameraModel]:
    width, height = views[0].size
    centre = (width - 1) / 2, (height - 1) / 2
    lengths = [max(width, height) * part for part in FOCAL_LENGTHS]
    with np.errstate(all="ignore"):
        matrix = load("cv2").initCameraMatrix2D(
            [view.object_points.astype(np.float32) for view in views],
            [view.points.astype(np.float32) for view in views],
            (width, height),
            1.0,
        )
    closed_form = float(matrix[0, 0])
    if math.isfinite(closed_form) and 0.1 * width < closed_form < 100 * width:
        lengths.append(closed_form)
    return [
        CameraModel(
            size=(width, height),
            matrix=np.array([[length, 0.0, centre[0]], [0.0, length, centre[1]], [0.0, 0.0, 1.0]]),
            distortion=np.zeros(COEFFICIENTS[model]),
            distortion_model=model,
        )
        for length in lengths
    ]


def _misfit(camera: CameraModel, views: Sequence[TargetView]) -> float:
    """Return the median over some views of how far the points are from where they would be."""
    some = views[:: max(1, len(views) // GUESSED)]
    return float(np.median([_distance(camera, view) for view in some]))


def _distance(camera: CameraModel, view: TargetView) -> float:
    found = [math.inf]
    for pose in plane_poses(view, camera):
        near = view.object_points @ pose.rotation.T + pose.translation
        off = float(((camera.project(near) - view.points) ** 2).mean())
        found.append(off if math.isfinite(off) else math.inf)
    return min(found)


def _follow(guess: CameraModel, views: Sequence[TargetView], basis: Array) -> Adjusted | None:
    """Return where a guess leads; None where points come to lie behind the camera."""
    sights = [Sight(0, number, view) for number, view in enumerate(views)]
    columns = np.eye(len(basis))
    most = basis[:, ~basis[6:].any(axis=0)]  # without what only bends the corners
    stages = [columns[:, :1] + columns[:, 1:2], most, basis]
    try:
        bundle = Bundle((guess,), (IDENTITY,), _poses(views, guess), (stages[0],))
        for stage in stages:
            bundle = Bundle(bundle.cameras, bundle.rig, bundle.poses, (stage,))
            bundle = adjust(bundle, sights, 1.0).bundle
        # of a plane's two poses the first guess may have taken the wrong one
        bundle = Bundle(bundle.cameras, bundle.rig, _poses(views, bundle.cameras[0]), (basis,))
        adjusted = adjust_weighted(bundle, sights)
    except CalibrationError:
        return None
    return adjusted if math.isfinite(adjusted.weighted) else None


def _poses(views: Sequence[TargetView], camera: CameraModel) -> tuple[Motion, ...]:
    found = (locate(view, camera).transform for view in views)
    return tuple(Motion(one.rotation, one.translation) for one in found)
