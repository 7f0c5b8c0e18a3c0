"""Convert poses to and from the forms in which robots' controllers show them.

::

    pose_from("kuka", [400, 120, 35.5, 90, 0, 180])    # T_base_tool
    pose_to("ur", pose)                                # [x, y, z, rx, ry, rz]

Each convention is a row of :data:`ROBOTS`: its numbers in their order, its unit of length, and its
form of an orientation. Angles are right-handed turns.

Source: Universal Robots, Script Manual, module motion (m, axis-angle); Roboception, rc_visard
manual, appendix "Pose formats", for ABB, FANUC, KUKA (published: ``r_z(R) r_y(P) r_x(W)``,
``r_z(A) r_y(B) r_x(C)``, ``w = Q1``); Mecademic, Meca500 Programming Manual for firmware 9.2,
section 1.1.4 (mobile XYZ, mm, degrees).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._units import check_angles, check_length, metres_of
from smartcam.calibration.formats._plain import MAX_NUMBER, look_up
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code, as_vector, matrix_from_quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import ArrayLike

    from smartcam.calibration._units import LengthUnit
    from smartcam.geometry._inside import Array

_MAX_UNIT_DEVIATION: Final = 0.01
"""Largest deviation of a quaternion's length from 1; such a length is corrected."""


def rotation_zyx(z: float, y: float, x: float) -> Array:
    """Return ``Rz(z) Ry(y) Rx(x)``, (3, 3): turned about x, y, z of the fixed frame, radians."""
    cz, sz, cy, sy, cx, sx = (f(a) for a in (z, y, x) for f in (math.cos, math.sin))
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def angles_zyx(rotation: Array) -> tuple[float, float, float]:
    """Return z, y, x of :func:`rotation_zyx`, radians; y is within a quarter turn.

    At a quarter turn about y, only the sum or difference of z and x is determined; then z is 0.
    Near a quarter turn, rounding changes z, and x compensates this, so the three angles together
    still give the rotation.
    """
    r = rotation.tolist()
    z = math.atan2(r[1][0], r[0][0]) if math.hypot(r[1][0], r[0][0]) > 1e-15 else 0.0
    cz, sz = math.cos(z), math.sin(z)
    x = math.atan2(sz * r[0][2] - cz * r[1][2], cz * r[1][1] - sz * r[0][1])
    return z, math.atan2(-r[2][0], cz * r[0][0] + sz * r[1][0]), x


def _matrix_from_vector(vector: Array) -> Array:
    angle = float(np.linalg.norm(vector))
    share = math.sin(0.5 * angle) / angle if angle > 0 else 0.5
    return matrix_from_quaternion([*(share * vector), math.cos(0.5 * angle)])


def _vector_from_pose(pose: Transform) -> list[float]:
    x, y, z, w = (pose.quaternion * math.copysign(1.0, pose.quaternion[3])).tolist()
    sine = math.hypot(x, y, z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return [factor * x, factor * y, factor * z]


def _matrix_from_xyzw(quaternion: Array) -> Array:
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) < _MAX_UNIT_DEVIATION:
        raise Code.NOT_RIGID.error(
            f"expected a quaternion of length 1, got {quaternion.tolist()} of length {length:.6g}",
            1.0,
            length,
        )
    return matrix_from_quaternion(quaternion / length)


def _quaternion_converters(
    real_part_shift: int,
) -> tuple[Callable[[Array], Array], Callable[[Transform], list[float]]]:
    """Return two functions for quaternions: from numbers to a matrix, and from a pose to numbers.

    ``real_part_shift``: 1 if the real part is the first number, 0 if it is the last.
    """
    return (
        lambda given: _matrix_from_xyzw(np.roll(given, -real_part_shift)),
        lambda pose: list(map(float, np.roll(pose.quaternion, real_part_shift))),
    )


def _angle_converters(
    sign: int, order: slice
) -> tuple[Callable[[Array], Array], Callable[[Transform], list[float]]]:
    """Return two functions for angles in degrees: from numbers to a matrix, and from a pose.

    ``order``: slice that brings the numbers into the order z, y, x. With a ``sign`` of -1 the turns
    are about the moving axes, x first: Rx(a) Ry(b) Rz(c) is the inverse of Rz(-c) Ry(-b) Rx(-a).
    """
    return (
        lambda given: _inverse_if_negative(
            rotation_zyx(*(math.radians(sign * angle) for angle in given.tolist()[order])), sign
        ),
        lambda pose: [
            sign * math.degrees(angle)
            for angle in list(angles_zyx(_inverse_if_negative(pose.rotation, sign)))[order]
        ],
    )


def _inverse_if_negative(rotation: Array, sign: int) -> Array:
    return rotation if sign > 0 else rotation.T


class PoseConvention(NamedTuple):
    """The convention by which a robot's poses are written."""

    numbers: tuple[str, ...]  # names of the numbers, in order
    units_per_metre: float  # number of length units in a metre
    # function that converts the numbers after the position to a rotation (3, 3)
    to_matrix: Callable[[Array], Array]
    # function that converts a pose to the numbers after the position
    from_pose: Callable[[Transform], list[float]]
    title: str  # form of the orientation, in words


ROBOTS: Mapping[str, PoseConvention] = {
    "ur": PoseConvention(
        ("x", "y", "z", "rx", "ry", "rz"), 1.0, _matrix_from_vector, _vector_from_pose,
        "rotation vector, rad: along the axis, as long as the angle",
    ),
    "abb": PoseConvention(
        ("x", "y", "z", "q1", "q2", "q3", "q4"), 1000.0, *_quaternion_converters(1),
        "quaternion, its real part q1 first",
    ),
    "kuka": PoseConvention(
        ("x", "y", "z", "a", "b", "c"), 1000.0, *_angle_converters(1, slice(None)),
        "degrees: Rz(a) Ry(b) Rx(c)",
    ),
    "fanuc": PoseConvention(
        ("x", "y", "z", "w", "p", "r"), 1000.0, *_angle_converters(1, slice(None, None, -1)),
        "degrees: Rz(r) Ry(p) Rx(w)",
    ),
    "meca500": PoseConvention(
        ("x", "y", "z", "alpha", "beta", "gamma"), 1000.0, *_angle_converters(-1, slice(None, None,
        -1)), "degrees, mobile XYZ: Rx(alpha) Ry(beta) Rz(gamma)",
    ),
    "xyzw": PoseConvention(
        ("x", "y", "z", "qx", "qy", "qz", "qw"), 1.0, *_quaternion_converters(0),
        "quaternion, its real part last",
    ),
    "wxyz": PoseConvention(
        ("x", "y", "z", "qw", "qx", "qy", "qz"), 1.0, *_quaternion_converters(1),
        "quaternion, its real part first",
    ),
}  # fmt: skip
"""The conventions by their names. Lengths are in metres for ``ur``, ``xyzw`` and ``wxyz``, and in
millimetres for the others."""


def pose_from(
    robot: str,
    values: ArrayLike,
    *,
    target: str = "base",
    source: str = "tool",
    unit: LengthUnit | None = None,
) -> Transform:
    """Return a pose that a robot's controller shows.

    Args:
        robot: ``ur``, ``abb``, ``kuka``, ``fanuc``, ``meca500``, ``xyzw`` or ``wxyz``.
        values: numbers of the pose in the convention's order and units.
        target: name of the frame in which the pose is given.
        source: name of the frame whose pose is given.
        unit: unit of the position; None for the controller's unit.

    Returns:
        ``T_target_source``, metres.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``: the convention is unknown; ``SHAPE``: the number of
            values is wrong; ``NOT_FINITE``: a value is NaN, infinite or beyond 1e9; ``NOT_RIGID``:
            the length of the quaternion is more than 1 % off; ``UNIT_UNKNOWN``: the position is
            farther than 20 m without a ``unit``, or a rotation vector has more than a turn.
    """
    convention = look_up(ROBOTS, robot, "robot's convention")
    label = f"pose of {robot} ({', '.join(convention.numbers)})"
    given = as_vector(values, len(convention.numbers), label)
    if not np.abs(given).max() <= MAX_NUMBER:
        raise Code.NOT_FINITE.error_with_value(
            f"{label}: expected numbers of at most {MAX_NUMBER:g}", MAX_NUMBER, given.tolist()
        )
    if unit is None:
        position = given[:3] / convention.units_per_metre
        check_length(float(np.linalg.norm(position)), label)
    else:
        position = given[:3] * metres_of(unit, label)
    if robot == "ur":
        check_angles([float(np.linalg.norm(given[3:]))], label)
    return Transform(target, source, convention.to_matrix(given[3:]), position)


def pose_to(robot: str, pose: Transform) -> list[float]:
    """Return a pose in the form of a robot's controller.

    Args:
        robot: ``ur``, ``abb``, ``kuka``, ``fanuc``, ``meca500``, ``xyzw`` or ``wxyz``.
        pose: ``T_base_tool``, metres.

    Returns:
        The convention's numbers, in its units. Angles are within half a turn; the angles about y
        of ``kuka``, ``fanuc`` and ``meca500`` are within a quarter turn. A rotation vector is at
        most pi long. A quaternion has the sign that makes its largest element positive.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``.
    """
    convention = look_up(ROBOTS, robot, "robot's convention")
    position: list[float] = (convention.units_per_metre * pose.translation).tolist()
    return position + convention.from_pose(pose)
