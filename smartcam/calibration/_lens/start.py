"""Define the unknowns of a lens, and fit a lens to views of a target."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.calibration._lens.bundle import (
    Bundle,
    IndexedView,
    adjust_weighted,
    lens_values,
    with_lens,
)
from smartcam.calibration._lens.poses import likeliest_poses
from smartcam.exceptions import CalibrationError
from smartcam.geometry import CameraModel
from smartcam.geometry._inside import COEFFICIENT_COUNTS, Code, coefficient_names

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.calibration._lens.bundle import AdjustedBundle
    from smartcam.calibration._views import TargetView
    from smartcam.geometry._inside import Array, DistortionModel

FOCAL_LENGTHS: Final = (None, 1.0, 0.4, 2.0, 0.65, 4.0)
"""Focal lengths from which OpenCV starts, as fractions of the image's longer side. None: from
OpenCV's closed form. The others belong to fields of view of 53, 103, 28, 75 and 14 degrees."""

MAX_VIEWS_OF_OPENCV: Final = 20
"""OpenCV gets at most this many views; then the fit is adjusted to all views."""

MAX_GOOD_RMS_PX: Final = 0.5
"""No further focal length is tried once one has led to an RMS of at most this many pixels."""


def parameter_names(model: DistortionModel) -> tuple[str, ...]:
    """Return the names of the :func:`~smartcam.calibration._lens.bundle.lens_values`.

    Raises ``SHAPE`` if there is no such model.
    """
    return ("fx", "fy", "cx", "cy", *coefficient_names(model))


def lens_basis(model: DistortionModel, fixed: Iterable[str] = ()) -> Array:
    """Return the derivatives of the 4 + K values of a lens with respect to its F free unknowns.

    ``fixed``: names of coefficients that stay 0; ``aspect``: fx and fy are one unknown. Raises
    ``SHAPE`` if there is no such model, or if it has no coefficient of that name.
    """
    names, coefficients, fixed_names = parameter_names(model), coefficient_names(model), set(fixed)
    invalid_names = sorted(fixed_names.difference(coefficients, {"aspect"}))
    if invalid_names:
        raise Code.SHAPE.error(
            f"fixed: expected coefficients of {model} ({', '.join(coefficients)}) or aspect, got "
            f"{', '.join(invalid_names)}",
            [*coefficients, "aspect"],
            invalid_names,
        )
    columns = np.eye(len(names))
    if "aspect" in fixed_names:
        columns[:, 0] += columns[:, 1]
        fixed_names.add("fy")
    basis: Array = columns[:, [name not in fixed_names for name in names]]
    return basis


def fit_lens(
    views: Sequence[TargetView], model: DistortionModel, fixed: Iterable[str] = ()
) -> AdjustedBundle:
    """Return the lens and the poses that fit views best.

    OpenCV finds the strongest coefficients; from there all values are adjusted, with weights.

    Raises ``POOR_FIT`` if no focal length leads to a fit, and the errors of :func:`lens_basis`.
    """
    basis = lens_basis(model, fixed)
    fits: list[AdjustedBundle] = []
    for length in FOCAL_LENGTHS:
        try:
            fits.append(_fit_from_length(views, model, basis, length))
        except (CalibrationError, load("cv2").error):
            continue
        if fits[-1].rms <= MAX_GOOD_RMS_PX:
            break
    if not fits:
        raise Code.POOR_FIT.error(
            f"intrinsics: expected a lens that shows the {len(views)} views as they are, got none "
            f"from focal lengths of {min(FOCAL_LENGTHS[1:])} to {max(FOCAL_LENGTHS[1:])} image "
            "widths"
        )
    return min(fits, key=lambda candidate: candidate.rms)


def _fit_from_length(
    views: Sequence[TargetView], model: DistortionModel, basis: Array, length: float | None
) -> AdjustedBundle:
    guess = _opencv_lens(views[:: -(-len(views) // MAX_VIEWS_OF_OPENCV)], model, length)
    # coefficients that stay 0 are set to 0, and fy to fx if they are one unknown
    lens = with_lens(guess, basis @ np.linalg.pinv(basis) @ lens_values(guess))
    indexed = [IndexedView(0, number, view) for number, view in enumerate(views)]
    adjusted = adjust_weighted(Bundle.single(lens, likeliest_poses(views, lens), basis), indexed)
    if not np.isfinite(adjusted.weighted_squares):
        raise Code.POOR_FIT.error("points behind the camera")
    return adjusted


def _opencv_lens(
    views: Sequence[TargetView], model: DistortionModel, length: float | None
) -> CameraModel:
    """Return OpenCV's fit of a lens with only the two strongest coefficients (and p1, p2)."""
    cv2: Any = load("cv2")
    (width, height), matrix = views[0].size, None
    if length is not None:
        focal = length * max(width, height)
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    points = [view.object_points.astype(np.float32).reshape(-1, 1, 3) for view in views]
    pixels = [view.points.astype(np.float32).reshape(-1, 1, 2) for view in views]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-6)
    if model == "equidistant":
        names = ["RECOMPUTE_EXTRINSIC", "FIX_SKEW", "FIX_K3", "FIX_K4"]
        calibrate, namespace = cv2.fisheye.calibrate, cv2.fisheye
    else:
        names, calibrate, namespace = ["FIX_K3"], cv2.calibrateCamera, cv2
    names += [] if length is None else ["USE_INTRINSIC_GUESS"]
    # OpenCV 5 has the fisheye's flags among the others
    flags = sum(
        getattr(namespace, f"CALIB_{name}", 0) or getattr(cv2, f"CALIB_{name}") for name in names
    )
    initial = np.zeros(COEFFICIENT_COUNTS["equidistant" if model == "equidistant" else "plumb_bob"])
    _, fitted_matrix, coefficients, *_ = calibrate(
        points, pixels, (width, height), matrix, initial, flags=flags, criteria=criteria
    )
    distortion = np.zeros(COEFFICIENT_COUNTS[model])
    distortion[: coefficients.size] = coefficients.ravel()
    fitted_matrix[0, 1] = 0.0
    return CameraModel(
        size=(width, height), matrix=fitted_matrix, distortion=distortion, distortion_model=model
    )
