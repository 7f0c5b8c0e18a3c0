"""Unknowns of a lens, and a first guess of them from views of a target."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._geometry.rigid import Rigid
from smartcam.calibration._lens.bundle import Bundle, Sight, adjust, adjust_weighted
from smartcam.calibration._lens.model import COEFFICIENTS, CameraModel, coefficient_names
from smartcam.calibration._lens.poses import locate, plane_poses
from smartcam.calibration._optional_imports import load
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.bundle import AdjustedBundle
    from smartcam.calibration._lens.model import DistortionModel
    from smartcam.calibration._views import TargetView

FOCAL_LENGTHS: Final = (0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
"""First guesses, in parts of the image's longer side: fields of view of 127 to 11 degrees."""

GUESSED: Final = 8
"""Views that judge a first guess."""

BEST: Final = 2
"""First guesses that must lead to their end; the best of these counts."""


def parameter_names(model: DistortionModel) -> tuple[str, ...]:
    """Return the names of what :func:`~smartcam.calibration._lens.bundle.lens_values` gives.

    Raises ``SHAPE``: no such model.
    """
    return ("fx", "fy", "cx", "cy", *coefficient_names(model))


def lens_basis(model: DistortionModel, fixed: Iterable[str] = ()) -> Array:
    """Return by how much each value of a lens changes with each unknown (4 + K, F).

    ``fixed``: names of coefficients that stay 0; ``aspect``: fx and fy are one unknown. Raises
    ``SHAPE``: no such model, or a name that it does not have.
    """
    names, own, held = parameter_names(model), coefficient_names(model), set(fixed)
    unknown = sorted(held.difference(own, {"aspect"}))
    if unknown:
        raise CalibrationError(
            f"fixed: expected coefficients of {model} ({', '.join(own)}) or aspect, got "
            f"{', '.join(unknown)}",
            code=Code.SHAPE,
            expected=[*own, "aspect"],
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
) -> AdjustedBundle:
    """Return the lens and the poses that show the views' points where they are.

    Several first guesses of the focal length are judged by a few of the views, the best ones are
    adjusted: first the focal length alone, then what bends most, then the rest.

    Raises ``POOR_FIT``: no guess leads anywhere; and as :func:`lens_basis` says.
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
    # A plane's homography H = K (r1 r2 t) gives, since r1 and r2 are orthogonal and of one
    # length, h1^T K^-T K^-1 h2 = 0 and h1^T K^-T K^-1 h1 = h2^T K^-T K^-1 h2: linear equations of
    # 1/f^2 for a principal point in the middle. Views that are head-on leave them singular, hence
    # the others.
    # Source: Zhang, A Flexible New Technique for Camera Calibration (2000), section 3.1.
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
        near = pose.taken(0).apply(view.object_points)
        off = float(((camera.project(near) - view.points) ** 2).mean())
        found.append(off if math.isfinite(off) else math.inf)
    return min(found)


def _follow(guess: CameraModel, views: Sequence[TargetView], basis: Array) -> AdjustedBundle | None:
    """Return the fit from a guess; None where points come to lie behind the camera."""
    sights = [Sight(0, number, view) for number, view in enumerate(views)]
    columns = np.eye(len(basis))
    most = basis[:, ~basis[6:].any(axis=0)]  # without what only bends the corners
    stages = [columns[:, :1] + columns[:, 1:2], most, basis]
    try:
        lens, at = guess, _poses(views, guess)
        for stage in stages:
            bundle = adjust(Bundle.single(lens, at, stage), sights, 1.0).bundle
            (lens,), at = bundle.cameras, bundle.poses
        # of a plane's two poses the first guess may have taken the wrong one
        adjusted = adjust_weighted(Bundle.single(lens, _poses(views, lens), basis), sights)
    except CalibrationError:
        return None
    return adjusted if math.isfinite(adjusted.weighted) else None


def _poses(views: Sequence[TargetView], camera: CameraModel) -> Rigid:
    return Rigid.stacked(locate(view, camera).transform.rigid for view in views)
