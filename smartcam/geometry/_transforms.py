"""Transforms between coordinate frames, each with the time at which it was valid.

A :class:`Transform` knows its direction: from ``source`` coordinates into ``target`` coordinates.
Two transforms can be composed only if one begins in the frame in which the other ends, so a
transform of the wrong direction raises an error. A :class:`PoseHistory` keeps the transforms of a
moving frame, and interpolates the pose at a moment.

Right-handed, metres, Hamilton quaternions ``x, y, z, w``.
"""

from __future__ import annotations

import bisect
import dataclasses
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam._argument_checks import check_arguments
from smartcam._arguments import check_seconds
from smartcam.geometry._codes import Code
from smartcam.geometry._rigid import Rigid, exp_rotation, log_rotation
from smartcam.geometry._rotations import (
    MAX_COORDINATE,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_multiply,
)
from smartcam.models import Header, Pose, Position, Quaternion

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from smartcam.geometry._rotations import Array

_MAX_ORTHONORMAL_DEVIATION: Final = 1e-6
"""Largest deviation of ``R R^T`` from the identity: at a metre this is a micrometre."""

_MAX_UNIT_DEVIATION: Final = 0.01
"""Largest deviation of a quaternion's length from 1. Robots print few digits; a larger deviation
means that the numbers are in another order, or are not a quaternion."""


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rigid motion ``T_target_source``: ``p_target = rotation @ p_source + translation``.

    Attributes:
        target: frame of the transformed coordinates.
        source: frame of the given coordinates.
        rotation: (3, 3), determinant +1. Read-only.
        translation: (3,), metres: the source's origin in the target. Read-only.
        at: moment at which the transform held; None if it does not change.

    Raises:
        CalibrationError: ``NOT_RIGID``: the matrix is not a rotation (also a reflection or a
            scale), or numbers are not finite; ``BAD_TIME``: the time has no time zone.
    """

    target: str
    source: str
    rotation: Array
    translation: Array
    at: datetime | None = None

    def __post_init__(self) -> None:
        """Make read-only copies, and check them."""
        for name in (self.target, self.source):
            if not isinstance(name, str):
                raise Code.SHAPE.error(
                    "transform: expected names of two frames, then a rotation and a translation, "
                    f"got {type(name).__name__} in place of a name",
                    "names of frames",
                    type(name).__name__,
                )
        rotation = _numbers(self.rotation, f"{self.label}: rotation")
        translation = _numbers(self.translation, f"{self.label}: translation")
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise Code.NOT_RIGID.error(
                f"{self.label}: expected a (3, 3) rotation and a (3,) translation, got "
                f"{rotation.shape} and {translation.shape}",
                ((3, 3), (3,)),
                (rotation.shape, translation.shape),
            )
        with np.errstate(all="ignore"):
            error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
            determinant = float(np.linalg.det(rotation))
        is_too_far = not np.abs(translation).max() <= MAX_COORDINATE
        if not (error < _MAX_ORTHONORMAL_DEVIATION and determinant > 0) or is_too_far:
            mirror = " (a reflection: one of the frames is left-handed)" if determinant < 0 else ""
            raise Code.NOT_RIGID.error(
                f"{self.label}: expected a rotation and a finite translation, got a matrix of "
                f"determinant {determinant:.6g}{mirror}, off by {error:.3g}, and "
                f"{translation.tolist()}",
                "a rotation, determinant 1",
                determinant,
            )
        if self.at is not None and getattr(self.at, "tzinfo", None) is None:
            raise Code.BAD_TIME.error_with_value(
                f"{self.label}: expected a time with its time zone", "a time zone", self.at
            )
        rotation.flags.writeable = translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def from_quaternion(
        cls,
        target: str,
        source: str,
        translation: ArrayLike,
        quaternion: ArrayLike,
        at: datetime | None = None,
    ) -> Transform:
        """Return the transform of a position and an orientation.

        Args:
            target: frame in which position and orientation are given.
            source: frame that has this pose.
            translation: (3,), metres.
            quaternion: (4,), ``x, y, z, w``. It is normalised.
            at: moment at which the transform held.

        Raises:
            CalibrationError: ``NOT_RIGID``: the quaternion's length is more than 1 % off.
        """
        values = _numbers(quaternion, f"T_{target}_{source}: quaternion")
        with np.errstate(all="ignore"):
            length = float(np.linalg.norm(values))
        if values.shape != (4,) or not abs(length - 1.0) < _MAX_UNIT_DEVIATION:
            raise Code.NOT_RIGID.error(
                f"T_{target}_{source}: expected a quaternion x, y, z, w of length 1, got "
                f"{values.tolist()} of length {length:.6g}",
                1.0,
                length,
            )
        rotation = matrix_from_quaternion(values / length)
        return cls(target, source, rotation, _numbers(translation, "translation"), at)

    @classmethod
    def from_pose(cls, pose: Pose, source: str) -> Transform:
        """Return the transform into the frame in the pose's header, with the header's time.

        Raises:
            CalibrationError: ``NOT_RIGID``, ``BAD_TIME``.
        """
        if not isinstance(pose, Pose):
            raise Code.SHAPE.error_with_value(
                "from_pose: expected a Pose", "Pose", type(pose).__name__
            )
        header = pose.header
        return cls.from_quaternion(
            header.frame_id, source, pose.position, pose.orientation, header.stamp
        )

    @property
    def label(self) -> str:
        """Name of the transform as in formulas: ``T_target_source``."""
        return f"T_{self.target}_{self.source}"

    @property
    def rigid(self) -> Rigid:
        """The motion without the frames' names."""
        return Rigid(self.rotation, self.translation)

    @property
    def quaternion(self) -> Array:
        """Rotation as a quaternion (4,), ``x, y, z, w``; its largest element is positive."""
        return quaternion_from_matrix(self.rotation)

    def pose(self, seq: int = 0) -> Pose:
        """Return the pose of the source frame in the target frame.

        Raises:
            CalibrationError: ``BAD_TIME``: the transform has no time, which a pose needs.
        """
        if self.at is None:
            raise Code.BAD_TIME.error(
                f"{self.label}: expected a time for the pose's header, got none", "a time"
            )
        position = Position(*self.translation.tolist())
        orientation = Quaternion(*self.quaternion.tolist())
        return Pose(Header(seq, self.at, self.target), position, orientation)

    def inverse(self) -> Transform:
        """Return ``T_source_target``."""
        return Transform(self.source, self.target, *self.rigid.inverse(), self.at)

    def undated(self) -> Transform:
        """Return the transform without its time, to compare transforms of different times."""
        return dataclasses.replace(self, at=None)

    def __matmul__(self, other: Transform) -> Transform:
        """Return ``T_a_b @ T_b_c = T_a_c``.

        Raises:
            CalibrationError: ``WRONG_FRAME``: ``other`` does not lead into this transform's
                ``source``; ``NOT_SIMULTANEOUS``: their times differ.
        """
        as_motion(other, f"{self.label} @", self.source, "source")
        if self.source != other.target:
            raise Code.WRONG_FRAME.error(
                f"{self.label} @ {other.label}: expected a transform into {self.source!r}, got one "
                f"into {other.target!r}",
                self.source,
                other.target,
            )
        if self.at is not None and other.at is not None and self.at != other.at:
            raise Code.NOT_SIMULTANEOUS.error(
                f"{self.label} @ {other.label}: expected both at one time, got {self.at} and "
                f"{other.at}",
                self.at,
                other.at,
            )
        at = other.at if self.at is None else self.at
        return Transform(self.target, other.source, *(self.rigid @ other.rigid), at)

    def apply(self, points: ArrayLike) -> Array:
        """Return points (..., 3) of the source in the target, metres; raise SHAPE."""
        return _rows(points, 3, f"{self.label}: points") @ self.rotation.T + self.translation

    def apply_to_orientations(self, quaternions: ArrayLike) -> Array:
        """Return orientations (..., 4) of the source in the target; raise SHAPE."""
        return quaternion_multiply(self.quaternion, _rows(quaternions, 4, "orientations"))

    def between(self, later: Transform, at: datetime) -> Transform:
        """Interpolate between this transform and a later one of the same frames, at a moment.

        The position moves on a straight line, the orientation turns about one axis at one speed.

        Raises:
            CalibrationError: ``WRONG_FRAME``; ``BAD_TIME``: the moment is not between the two.
        """
        if (self.target, self.source) != (later.target, later.source):
            raise Code.WRONG_FRAME.error_with_value(
                f"between: expected two of {self.label}", self.label, later.label
            )
        if self.at is None or later.at is None or not self.at <= at <= later.at:
            raise Code.BAD_TIME.error_with_value(
                f"{self.label}: expected a time between {self.at} and {later.at}",
                (self.at, later.at),
                at,
            )
        if later.at == self.at:
            return self
        fraction = (at - self.at) / (later.at - self.at)
        # R1 exp(s log(R1^T R2)) goes the shortest way from R1 to R2 at one speed: slerp.
        # Source: Shoemake, Animating Rotation with Quaternion Curves (1985).
        step = exp_rotation(fraction * log_rotation(self.rotation.T @ later.rotation))
        translation = self.translation + fraction * (later.translation - self.translation)
        return Transform(self.target, self.source, self.rotation @ step, translation, at)


def _numbers(values: ArrayLike, label: str) -> Array:
    """Return a copy as float64; raise NOT_RIGID if it holds no numbers."""
    try:
        if np.iscomplexobj(values):
            raise TypeError("got complex numbers")
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise Code.NOT_RIGID.error(f"{label}: expected numbers: {exc!s:.200}", "numbers") from exc


def _rows(values: ArrayLike, count: int, label: str) -> Array:
    """Return numbers (..., ``count``), NaN included; raise SHAPE."""
    try:
        if np.iscomplexobj(values):
            raise TypeError("got complex numbers")
        rows = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise Code.SHAPE.error(f"{label}: expected numbers: {exc!s:.200}", "numbers") from exc
    if rows.shape[-1:] != (count,):
        raise Code.SHAPE.error_with_value(
            f"{label}: expected shape (..., {count})", f"(..., {count})", rows.shape
        )
    return rows


def as_motion(value: object, label: str, target: str, source: str) -> Transform:
    """Return the value if it is a :class:`Transform`, else raise an error of the code SHAPE."""
    if isinstance(value, Transform):
        return value
    shape = np.shape(value) if isinstance(value, np.ndarray) else ()
    kind = "None" if value is None else type(value).__name__
    raise Code.SHAPE.error(
        f"{label}: expected a Transform, which knows its frames, got {kind}{shape or ''}: to make "
        f'one of a matrix M (4, 4), write Transform("{target}", "{source}", M[:3, :3], M[:3, 3])',
        "Transform",
        kind,
    )


class PoseHistory:
    """Poses of a moving frame, each with its time.

    Args:
        size: largest number of poses that are kept; the oldest is dropped first.
        max_gap: longest time, seconds, between two poses that are interpolated. With an
            acceleration ``a``, a robot is up to ``a * max_gap^2 / 8`` away from the straight line
            between them: 1.25 mm for 0.1 s and 1 m/s^2.
    """

    @check_arguments(max_gap=check_seconds)
    def __init__(self, *, size: int = 1000, max_gap: float = 0.1) -> None:
        self._transforms: list[Transform] = []
        self._times: list[datetime] = []
        self._size = size
        self._max_gap = timedelta(seconds=max_gap)

    def add(self, transform: Transform) -> None:
        """Add the pose at a moment; it replaces an earlier pose of the same moment.

        Poses may be added in any order.

        Raises:
            CalibrationError: ``BAD_TIME``: the transform has no time; ``WRONG_FRAME``: its frames
                differ from those of earlier transforms.
        """
        if transform.at is None:
            raise Code.BAD_TIME.error(f"{transform.label}: expected a time, got none", got=None)
        if self._transforms and transform.label != self._transforms[0].label:
            expected_label = self._transforms[0].label
            raise Code.WRONG_FRAME.error_with_value(
                f"pose history: expected {expected_label} as before",
                expected_label,
                transform.label,
            )
        index = bisect.bisect_left(self._times, transform.at)
        has_same_time = transform.at in self._times[index : index + 1]
        self._times[index : index + has_same_time] = [transform.at]
        self._transforms[index : index + has_same_time] = [transform]
        del self._times[: -self._size], self._transforms[: -self._size]

    def at(self, moment: datetime) -> Transform:
        """Return the pose at a moment, interpolated between the poses before and after.

        Raises:
            CalibrationError: ``BAD_TIME``: before the first or after the last known moment (nothing
                is extrapolated), or in a gap longer than ``max_gap``.
        """
        index = bisect.bisect_left(self._times, moment)
        if moment in self._times[index : index + 1]:
            return self._transforms[index]
        if index in (0, len(self._times)):
            known = f"from {self._times[0]} to {self._times[-1]}" if self._times else "in it"
            reason = "nothing is extrapolated" if self._times else "the pose history is empty"
            raise Code.BAD_TIME.error(
                f"pose history: expected a time {known}, got {moment}: {reason}", known, moment
            )
        before, after = self._transforms[index - 1 : index + 1]
        gap = self._times[index] - self._times[index - 1]
        if gap > self._max_gap:
            raise Code.BAD_TIME.error(
                f"{before.label}: expected two poses at most {self._max_gap.total_seconds():g} s "
                f"apart around {moment}, got {gap.total_seconds():g} s",
                self._max_gap,
                gap,
            )
        return before.between(after, moment)
