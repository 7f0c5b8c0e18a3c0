"""Frames: how coordinate systems lie against each other, and when they did so.

A :class:`Transform` knows which way it goes: from ``source`` coordinates into ``target``
coordinates. Two of them can be put one behind the other only where the frame between them is the
same, so one that is taken the wrong way round does not pass. A :class:`FrameTree` keeps many and
gives the way between any two frames, at one moment.

Right-handed, metres, Hamilton quaternions ``x, y, z, w``.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_multiply,
)
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike

    from smartcam.calibration.geometry.rotations import Array

__all__ = ["FrameTree", "Transform"]


_ORTHONORMAL: Final = 1e-6
"""How far ``R R^T`` may be from one: at a metre this is a micrometre."""

_UNIT: Final = 0.01
"""How far a quaternion's length may be from one; it is made one. Robots print few digits; what is
farther off is no quaternion, or is in another order."""


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rigid motion ``T_target_source``: ``p_target = rotation @ p_source + translation``.

    Attributes:
        target: the frame that it leads to.
        source: the frame that it comes from.
        rotation: (3, 3), determinant +1. Read-only.
        translation: (3,), metres: the source's origin in the target. Read-only.
        at: when it was so; None for one that does not change.

    Raises:
        CalibrationError: no rotation (``NOT_RIGID``: a reflection and a scale, too), not finite,
            or a time without a time zone (``BAD_TIME``).
    """

    target: str
    source: str
    rotation: Array
    translation: Array
    at: datetime | None = None

    def __post_init__(self) -> None:
        """Take read-only copies, and check them."""
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise CalibrationError(
                f"{self.label}: expected a (3, 3) rotation and a (3,) translation, got "
                f"{rotation.shape} and {translation.shape}",
                code=Code.NOT_RIGID,
                expected=((3, 3), (3,)),
                got=(rotation.shape, translation.shape),
            )
        with np.errstate(all="ignore"):
            off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
            turn = float(np.linalg.det(rotation))
        if not (off < _ORTHONORMAL and turn > 0 and np.isfinite(translation).all()):
            raise CalibrationError(
                f"{self.label}: expected a rotation and a finite translation, got a matrix of "
                f"determinant {turn:.6g}, off by {off:.3g}, and {translation.tolist()}",
                code=Code.NOT_RIGID,
                expected="a rotation, determinant 1",
                got=turn,
            )
        if self.at is not None and self.at.tzinfo is None:
            raise CalibrationError(
                f"{self.label}: expected a time with its time zone, got {self.at}",
                code=Code.BAD_TIME,
                expected="a time zone",
                got=self.at,
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
        """Return one of a position and an orientation.

        Args:
            target: the frame in which both are given.
            source: the frame whose pose they are.
            translation: (3,), metres.
            quaternion: (4,), ``x, y, z, w``. Its length is made one.
            at: when it was so.

        Raises:
            CalibrationError: ``NOT_RIGID``: the quaternion's length is more than 1 % off.
        """
        values = np.asarray(quaternion, dtype=np.float64)
        length = float(np.linalg.norm(values))
        if values.shape != (4,) or not abs(length - 1.0) < _UNIT:
            raise CalibrationError(
                f"T_{target}_{source}: expected a quaternion x, y, z, w of length 1, got "
                f"{values.tolist()} of length {length:.6g}",
                code=Code.NOT_RIGID,
                expected=1.0,
                got=length,
            )
        rotation = matrix_from_quaternion(values / length)
        return cls(target, source, rotation, np.asarray(translation, dtype=np.float64), at)

    @classmethod
    def from_pose(cls, pose: Pose, source: str) -> Transform:
        """Return one of a pose in the frame that its header names, with its stamp.

        Raises:
            CalibrationError: ``NOT_RIGID``, ``BAD_TIME``.
        """
        header = pose.header
        return cls.from_quaternion(
            header.frame_id, source, pose.position, pose.orientation, header.stamp
        )

    @property
    def label(self) -> str:
        """Its name as it is written in formulas: ``T_target_source``."""
        return f"T_{self.target}_{self.source}"

    @property
    def quaternion(self) -> Array:
        """(4,), ``x, y, z, w``, whose largest element is positive."""
        return quaternion_from_matrix(self.rotation)

    def pose(self, seq: int = 0) -> Pose:
        """Return the source's pose in the target.

        Raises:
            CalibrationError: ``BAD_TIME``: it has no time, and a pose must have one.
        """
        if self.at is None:
            raise CalibrationError(
                f"{self.label}: expected a time for the pose's header, got none",
                code=Code.BAD_TIME,
                expected="a time",
            )
        position = Position(*self.translation.tolist())
        orientation = Quaternion(*self.quaternion.tolist())
        return Pose(Header(seq, self.at, self.target), position, orientation)

    def inverse(self) -> Transform:
        """Return ``T_source_target``."""
        rotation = self.rotation.T
        return Transform(self.source, self.target, rotation, -rotation @ self.translation, self.at)

    def undated(self) -> Transform:
        """Return the same without its time: to compare what was with what is."""
        return dataclasses.replace(self, at=None)

    def __matmul__(self, other: Transform) -> Transform:
        """Return ``T_a_b @ T_b_c = T_a_c``.

        Raises:
            CalibrationError: ``WRONG_FRAME``: the frames between them differ; ``NOT_SIMULTANEOUS``:
                their times do.
        """
        if self.source != other.target:
            raise CalibrationError(
                f"{self.label} @ {other.label}: expected a transform into {self.source!r}, got one "
                f"into {other.target!r}",
                code=Code.WRONG_FRAME,
                expected=self.source,
                got=other.target,
            )
        if self.at is not None and other.at is not None and self.at != other.at:
            raise CalibrationError(
                f"{self.label} @ {other.label}: expected both at one time, got {self.at} and "
                f"{other.at}",
                code=Code.NOT_SIMULTANEOUS,
                expected=self.at,
                got=other.at,
            )
        return Transform(
            self.target,
            other.source,
            self.rotation @ other.rotation,
            self.rotation @ other.translation + self.translation,
            other.at if self.at is None else self.at,
        )

    def apply(self, points: ArrayLike) -> Array:
        """Return points of the source, (..., 3) in metres, in the target."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def turn(self, quaternions: ArrayLike) -> Array:
        """Return orientations in the source, (..., 4), as orientations in the target."""
        return quaternion_multiply(self.quaternion, np.asarray(quaternions, dtype=np.float64))

    def between(self, later: Transform, at: datetime) -> Transform:
        """Return it at a moment between this one and a later one of the same frames.

        The position moves on a straight line, the orientation turns about one axis at one speed.

        Raises:
            CalibrationError: ``WRONG_FRAME``; ``BAD_TIME``: the moment is not between the two.
        """
        if (self.target, self.source) != (later.target, later.source):
            raise CalibrationError(
                f"between: expected two of {self.label}, got {later.label}",
                code=Code.WRONG_FRAME,
                expected=self.label,
                got=later.label,
            )
        if self.at is None or later.at is None or not self.at <= at <= later.at:
            raise CalibrationError(
                f"{self.label}: expected a time between {self.at} and {later.at}, got {at}",
                code=Code.BAD_TIME,
                expected=(self.at, later.at),
                got=at,
            )
        if later.at == self.at:
            return self
        part = (at - self.at) / (later.at - self.at)
        turn = quaternion_from_matrix(self.rotation.T @ later.rotation)
        x, y, z, w = (turn * math.copysign(1.0, turn[3])).tolist()  # the short way round
        sine = math.hypot(x, y, z)
        half = part * math.atan2(sine, w)
        share = math.sin(half) / sine if sine > 0 else 0.0
        step = matrix_from_quaternion(np.array([share * x, share * y, share * z, math.cos(half)]))
        translation = self.translation + part * (later.translation - self.translation)
        return Transform(self.target, self.source, self.rotation @ step, translation, at)


@dataclass(slots=True)
class _Link:
    """What leads from a frame to its parent.

    Attributes:
        parent: name of the parent.
        transforms: one, or those of many moments in order.
        times: the moments; none for one that does not change.
    """

    parent: str
    transforms: list[Transform]
    times: list[datetime]

    @property
    def newest(self) -> datetime | None:
        return self.times[-1] if self.times else None


class FrameTree:
    """Frames, each with one parent; the way between any two of them, at one moment.

    Args:
        history: how many moments of a moving frame are kept; the oldest goes first.
        max_gap: seconds between two moments at most, to take one in between. A robot that
            accelerates with ``a`` leaves the straight line between them by ``a * max_gap^2 / 8``:
            a tenth of a second and 1 m/s^2 are 1.25 mm.
    """

    def __init__(self, *, history: int = 1000, max_gap: float = 0.1) -> None:
        self._links: dict[str, _Link] = {}
        self._history = history
        self._max_gap = timedelta(seconds=max_gap)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        parents = {link.parent for link in self._links.values()}
        return sorted(parents.union(self._links))

    def parent(self, frame: str) -> str | None:
        """Return a frame's parent; None for a root, and for a frame that is not there."""
        link = self._links.get(frame)
        return None if link is None else link.parent

    def set(self, transform: Transform) -> None:
        """Put in where ``transform.source`` lies in its parent, ``transform.target``.

        One without a time is always so, and a later one takes its place. One with a time holds at
        that moment; one more of the same moment takes its place.

        Raises:
            CalibrationError: ``SECOND_PARENT``: the frame has another parent already; ``CYCLE``:
                the parent hangs on the frame, or is the frame; ``BAD_TIME``: with a time where
                those before had none, or the other way round.
        """
        child, parent = transform.source, transform.target
        link = self._links.get(child)
        if link is None:
            if child in (above := list(self._upwards(parent))):
                raise CalibrationError(
                    f"{transform.label}: expected a parent that does not hang on {child!r}, got "
                    f"{' in '.join(above)}",
                    code=Code.CYCLE,
                    got=parent,
                )
            times = [] if transform.at is None else [transform.at]
            self._links[child] = _Link(parent, [transform], times)
            return
        if link.parent != parent:
            raise CalibrationError(
                f"{transform.label}: expected {link.parent!r}, in which {child!r} lies already, "
                f"got a second parent {parent!r}",
                code=Code.SECOND_PARENT,
                expected=link.parent,
                got=parent,
            )
        if (not link.times) != (transform.at is None):
            raise CalibrationError(
                f"{transform.label}: expected {'a time' if link.times else 'no time'} as "
                f"before, got {transform.at}",
                code=Code.BAD_TIME,
                got=transform.at,
            )
        self._keep(link, transform)

    def _keep(self, link: _Link, transform: Transform) -> None:
        if transform.at is None:
            link.transforms[0] = transform
            return
        place = bisect.bisect_left(link.times, transform.at)
        if transform.at in link.times[place : place + 1]:
            link.transforms[place] = transform
            return
        link.transforms.insert(place, transform)
        link.times.insert(place, transform.at)
        del link.transforms[: -self._history], link.times[: -self._history]

    def remove(self, frame: str) -> None:
        """Take a frame from its parent; what hangs on it goes on hanging on it.

        Raises:
            CalibrationError: ``UNKNOWN_FRAME``: it has no parent.
        """
        if self._links.pop(frame, None) is None:
            raise self._unknown(frame)

    def lookup(self, target: str, source: str, at: datetime | None = None) -> Transform:
        """Return ``T_target_source``.

        Args:
            target: the frame of the coordinates that are wanted.
            source: the frame of the coordinates that are there.
            at: when; None is the newest moment for which every moving frame on the way is known.

        Returns:
            With ``at``, or with that newest moment; without a time where nothing on the way moves
            and none was given.

        Raises:
            CalibrationError: ``UNKNOWN_FRAME``; ``NOT_CONNECTED``; ``BAD_TIME``: before the
                first or after the last known moment (nothing is extrapolated), or in a gap longer
                than ``max_gap``.
        """
        known = self.frames
        for frame in (target, source):
            if frame not in known:
                raise self._unknown(frame)
        up, down = list(self._upwards(target)), list(self._upwards(source))
        if up[-1] != down[-1]:
            raise CalibrationError(
                f"T_{target}_{source}: expected a common parent, got the roots {up[-1]!r} and "
                f"{down[-1]!r}",
                code=Code.NOT_CONNECTED,
                expected=up[-1],
                got=down[-1],
            )
        while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
            up.pop()
            down.pop()
        if at is None:
            newest = [self._links[frame].newest for frame in up[:-1] + down[:-1]]
            at = min((time for time in newest if time is not None), default=None)
        return self._climb(target, up, at).inverse() @ self._climb(source, down, at)

    def _upwards(self, frame: str) -> Iterator[str]:
        """Yield the frame, its parent, the parent's, to the root."""
        above: str | None = frame
        while above is not None:
            yield above
            above = self.parent(above)

    def _climb(self, frame: str, way: list[str], at: datetime | None) -> Transform:
        """Return ``T_top_frame``, where the top is the last of the way."""
        whole = Transform(frame, frame, np.eye(3), np.zeros(3), at)
        for one in way[:-1]:
            whole = self._at(self._links[one], at) @ whole
        return whole

    def _at(self, link: _Link, at: datetime | None) -> Transform:
        if not link.times or at is None:
            return link.transforms[0]
        place = bisect.bisect_left(link.times, at)
        if at in link.times[place : place + 1]:
            return link.transforms[place]
        label, first, last = link.transforms[0].label, link.times[0], link.times[-1]
        if place in (0, len(link.times)):
            raise CalibrationError(
                f"{label}: expected a time from {first} to {last}, got {at}: nothing is "
                "extrapolated",
                code=Code.BAD_TIME,
                expected=(first, last),
                got=at,
            )
        gap = link.times[place] - link.times[place - 1]
        if gap > self._max_gap:
            raise CalibrationError(
                f"{label}: expected two poses at most {self._max_gap.total_seconds():g} s apart "
                f"around {at}, got {gap.total_seconds():g} s",
                code=Code.BAD_TIME,
                expected=self._max_gap,
                got=gap,
            )
        return link.transforms[place - 1].between(link.transforms[place], at)

    def _unknown(self, frame: str) -> CalibrationError:
        known = self.frames
        return CalibrationError(
            f"frame {frame!r}: expected one of {', '.join(known) or 'none'}",
            code=Code.UNKNOWN_FRAME,
            expected=known,
            got=frame,
        )
