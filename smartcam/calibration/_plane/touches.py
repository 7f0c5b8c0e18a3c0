"""Fit a plane from the origin mark that the camera localizes, and touches of the sheet's rays.

The sheet has an origin and two rays at right angles, A along its x and B along its y. The camera
localizes the origin with its angle; the robot touches the origin, and each ray at any place. The
touched places along the rays are not known, so the user gives the scale, and three touches allow
only one check: of the angle between the rays. If the camera sees more than one mark,
:func:`~smartcam.calibration.fit_plane` gives a better calibration from as many touches.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, check_arguments, numbers, of_class, or_none
from smartcam.calibration._plane.calibration import PlaneCalibration, mean_axis
from smartcam.calibration._plane.diagnostics import (
    TYPICAL_SIGMA_M,
    check_side,
    estimate_sigma,
    side_remarks,
)
from smartcam.calibration._plane.fitting import Normalization, rigid_tangent
from smartcam.calibration._plane.model_selection import ROUNDING_RATIO
from smartcam.calibration._plane.validation import check_extent, check_lever, check_positive
from smartcam.calibration._statistics import Noise
from smartcam.geometry._inside import Code, Remark, as_points, frame_from_axes, rotate_ccw

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from smartcam.geometry._inside import Array
    from smartcam.models import Localization

MAX_STEPS = 50
"""The fit takes at most this many steps; it usually takes 3 to 6."""

SIGNIFICANCE_LEVEL = 0.01
"""Probability with which noise alone may cause a warning."""


class _FittedRays(NamedTuple):
    """A sheet that was fitted to touches."""

    origin: Array  # (3,), origin, metres
    frame: Array  # (3, 3): rays A and B and the normal as columns
    positions: Array  # (N,), position of each touch along its ray, metres
    residuals: Array  # (N, 3), residuals, metres
    covariance: Array  # (6, 6), covariance of shift and turn, for touches with a variance of 1 m^2


@check_arguments(
    origin=of_class("Localization"),
    o=numbers,
    a=numbers,
    b=numbers,
    nominal_scale=a_number,
    theta_sigma=a_number,
    tool_z=or_none(numbers),
)
def fit_touches(
    origin: Localization,
    o: ArrayLike,
    a: ArrayLike,
    b: ArrayLike,
    *,
    nominal_scale: float = 1.0,
    touch_sigma: float | None = None,
    theta_sigma: float = 0.0,
    tool_z: ArrayLike | None = None,
    robot_frame: str = "robot",
    camera_frame: str | None = None,
    y_down: bool | None = None,
) -> PlaneCalibration:
    """Return the map from the camera's plane to the robot, from touches of the sheet's rays.

    All touches have the same weight; the result is the most likely origin and frame with rays at
    right angles.

    Args:
        origin: the origin mark, as the camera localized it; its theta is the direction of ray A.
        o: (3,) or (K, 3), touches of the origin, metres.
        a: (3,) or (K, 3), touches anywhere on ray A.
        b: (3,) or (K, 3), touches anywhere on ray B.
        nominal_scale: metres per unit of the camera; a smart camera gives metres.
        touch_sigma: standard deviation of one coordinate of a touch, metres.
        theta_sigma: standard deviation of the origin's theta, radians; 0.1 degrees are 0.5 mm at
            300 mm. It is part of the predicted error if ``touch_sigma`` is given.
        tool_z: (3,), direction of the tool's axis, into the plane, when it touched.
        robot_frame: name of the frame that poses will be given in.
        camera_frame: name of the frame that localizations must come in; None for any.
        y_down: whether the camera's own y axis points down; ``origin`` has the opposite y. None:
            not known. The value is stored, and compared when the calibration is used; nothing is
            turned here.

    Returns:
        A calibration with the model ``touches``. Its camera points are the places of the touches on
        their rays; none can be left out.

    Raises:
        CalibrationError: SHAPE, NOT_FINITE, TOO_FEW, COINCIDENT: A or B lies on the origin;
            COLLINEAR: the rays are less than 10 degrees apart; SHORT_LEVER; MIRRORED; UNIT_UNKNOWN:
            the touches are farther apart than 20 m.

    Source: the thesis' procedure, sections 3.2.3 and 3.2.4, with its mathematics corrected.
    """
    check_positive(touch_sigma, "touch_sigma", "metres")
    check_positive(nominal_scale, "nominal_scale", "metres for each unit of the camera")
    if not (math.isfinite(theta_sigma) and theta_sigma >= 0.0):
        raise Code.NOT_FINITE.error_with_value(
            "theta_sigma: expected a number of radians that is not negative",
            "a number that is not negative",
            theta_sigma,
        )
    groups = [
        _as_touches(touches, name)
        for name, touches in (("the origin", o), ("ray A", a), ("ray B", b))
    ]
    all_touches = np.concatenate(groups)
    check_extent(all_touches)
    ray_index = np.repeat([0, 1, 2], [len(group) for group in groups])
    levers = [float(np.linalg.norm(group.mean(0) - groups[0].mean(0))) for group in groups[1:]]
    sheet = _fit_rays(all_touches, ray_index)
    for lever in levers if touch_sigma is not None else ():
        check_lever(lever, touch_sigma or 0.0)
    tool_axis = None if tool_z is None else mean_axis(tool_z, len(all_touches))
    tool_cosine = None if tool_axis is None else check_side(sheet.frame[:, 2], tool_axis)
    freedom = 3 * len(groups[0]) + 2 * len(groups[1]) + 2 * len(groups[2]) - 6
    sigma = estimate_sigma(float((sheet.residuals**2).sum()), freedom, TYPICAL_SIGMA_M)
    centre = np.array([origin.pose.position.x, origin.pose.position.y])
    theta = origin.pose.orientation.theta
    size = math.sqrt(float(np.mean(np.square(levers))))
    normalization = Normalization(centre, size / nominal_scale, sheet.origin, size)
    normalized_matrix = np.zeros((4, 3))
    normalized_matrix[:3, :2] = rotate_ccw(sheet.frame[:, :2], theta)
    normalized_matrix[3, 2] = 1.0
    directions = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    places = directions[ray_index] * (sheet.positions / nominal_scale)[:, None]
    tangent = rigid_tangent(normalized_matrix)
    scaled_tangent = tangent / [size, size, size, 1.0, 1.0, 1.0]
    covariance = scaled_tangent @ sheet.covariance @ scaled_tangent.T
    if touch_sigma is not None:
        theta_effect = tangent[:, 3:] @ sheet.frame[:, 2] * (theta_sigma / touch_sigma)
        covariance += np.outer(theta_effect, theta_effect)
    return PlaneCalibration(
        model="touches",
        camera_points=centre + rotate_ccw(places, theta),
        robot_points=all_touches,
        weights=np.ones(len(all_touches)),
        matrix=normalization.to_original(normalized_matrix),
        normalization=normalization,
        unit_covariance=covariance,
        residuals=sheet.residuals,
        leave_one_out=np.full_like(all_touches, np.nan),
        freedom=freedom,
        touch_sigma=sigma if touch_sigma is None else touch_sigma,
        sigma_given=touch_sigma is not None,
        candidate_errors={},
        nominal_scale=nominal_scale,
        tool_z=tool_axis,
        robot_frame=robot_frame,
        camera_frame=camera_frame,
        y_down=y_down,
        warnings=_remarks(sheet, freedom, touch_sigma, nominal_scale, tool_cosine),
    )


def _as_touches(values: ArrayLike, name: str) -> Array:
    touches = as_points(np.atleast_2d(np.asarray(values)), 3, f"touches of {name}")
    if not len(touches):
        raise Code.TOO_FEW.error(f"touches of {name}: expected one or more, got none", 1, 0)
    return touches


def _fit_rays(touches: Array, ray_index: NDArray[np.intp]) -> _FittedRays:
    """Return the most likely sheet; the position of each touch along its ray is free."""
    # Gauss and Newton's steps of shift and turn: 3 to 6 of them, in 2.5 ms; SciPy's least_squares
    # takes 6 ms (measured).
    origin = touches[ray_index == 0].mean(axis=0)
    frame = frame_from_axes(
        *(touches[ray_index == index].mean(axis=0) - origin for index in (1, 2))
    )
    for _ in range(MAX_STEPS):
        positions, residuals, jacobian = _linearize(touches, ray_index, origin, frame)
        step = np.linalg.lstsq(jacobian, residuals.ravel(), rcond=None)[0]
        origin = origin + step[:3]
        x_axis, y_axis = (frame[:, axis] + np.cross(step[3:], frame[:, axis]) for axis in (0, 1))
        y_axis = y_axis - x_axis * (x_axis @ y_axis) / (x_axis @ x_axis)
        frame = frame_from_axes(x_axis, y_axis)
        if np.abs(step).max() < ROUNDING_RATIO**1.5 * (1.0 + np.abs(origin).max()):
            break
    positions, residuals, jacobian = _linearize(touches, ray_index, origin, frame)
    covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64)
    return _FittedRays(origin, frame, positions, residuals, covariance)


def _linearize(
    touches: Array, ray_index: NDArray[np.intp], origin: Array, frame: Array
) -> tuple[Array, Array, Array]:
    """Return the touches' positions along their rays, the residuals, and the Jacobian (3N, 6)."""
    axes: Array = np.concatenate([np.zeros((1, 3)), frame[:, :2].T])
    directions = axes[ray_index]
    # A touch q is off its ray with direction d by (I - d d^T) (q - o). A shift s of the origin and
    # a turn w move the ray's point beneath it, o + l d, by s + l w x d.
    offsets = touches - origin
    positions = (offsets * directions).sum(axis=1)
    projections = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    turn_jacobian = np.cross(np.eye(3)[None], directions[:, None], axis=2).swapaxes(1, 2)
    sheet_jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), turn_jacobian.shape), positions[:, None, None] * turn_jacobian],
        axis=2,
    )
    jacobian = (projections @ sheet_jacobian).reshape(-1, 6)
    return positions, (projections @ offsets[..., None])[..., 0], jacobian


def _remarks(
    sheet: _FittedRays,
    freedom: int,
    touch_sigma: float | None,
    scale: float,
    tool_cosine: float | None,
) -> tuple[Remark, ...]:
    remarks: list[Remark] = []
    squares = float((sheet.residuals**2).sum())
    if touch_sigma is None:
        remarks.append(
            Code.UNVERIFIED.remark(
                f"the touches' sigma is estimated from {freedom} degrees of freedom only: "
                "give touch_sigma"
            )
        )
    elif Noise(touch_sigma**2).chance(squares, freedom) < SIGNIFICANCE_LEVEL:
        remarks.append(
            Code.POOR_FIT.remark(
                f"the touches lie {1e3 * math.sqrt(squares / len(sheet.positions)):.3g} mm rms "
                f"beside rays at right angles, where a sigma of {1e3 * touch_sigma:.3g} mm was "
                "given"
            )
        )
    remarks.append(
        Code.SCALE_ASSUMED.remark(
            f"{scale:.6g} m for each unit of the camera was taken as given: no touch measures it"
        )
    )
    remarks.append(
        Code.NOT_HELD_OUT.remark(
            "no touch can be left out to see how good the calibration is, "
            "and the residuals do not tell"
        )
    )
    return (*remarks, *side_remarks(tool_cosine))
