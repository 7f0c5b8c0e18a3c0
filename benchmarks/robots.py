"""Simulated robots of many kinds: what a controller says, and where the hand really is.

An arm of six axes with a spherical wrist goes where it is told by the lengths and angles that its
controller believes in; the real ones differ. A kind of robot says how: offsets of the joints, play
in the gears, lengths of the links, a drift of the whole, noise of each pose, tails. Lens and sheet
may differ from what is believed, too.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from smartcam.calibration._targets import Checkerboard, resized
from smartcam.calibration.simulation._scenes import poses_around, view
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import Rigid, exp_rotation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._views import TargetView
    from smartcam.geometry._inside import Array

__all__ = ["CAMERA", "KINDS", "SHEET", "Kind", "Measured"]

SHEET = Checkerboard(columns=9, rows=6, square=0.02)
CAMERA = CameraModel(
    size=(1280, 960), matrix=np.array([[1200.0, 0, 640], [0, 1200, 480], [0, 0, 1]])
)

LENGTHS = np.array([0.4, 0.45, 0.45, 0.1])
"""Of the arm, metres: from the floor to the shoulder, to the elbow, to the wrist, to the flange."""

GEARS = 40.0
"""Waves of a joint's ripple in a turn."""

DISTANCE = 0.4
"""From camera to sheet, metres."""


@dataclass(frozen=True, slots=True)
class Kind:
    """What is wrong with a robot; all of it standard deviations where nothing else is said."""

    name: str
    seen: Literal["chosen-by", "unseen"] = "chosen-by"
    poses: int = 15
    cone: float = 30.0  # degrees
    pixels: float = 0.1
    degrees: float = 0.0  # of each axis of a pose, fresh for each
    millimetres: float = 0.0  # the same of its place
    tails: float = math.inf  # degrees of freedom of Student's t, of these two
    offsets: float = 0.0  # of the joints, degrees
    play: float = 0.0  # between the two sides of a tooth, degrees; the joint leans to the last way
    links: float = 0.0  # of each length, mm
    sag: float = 0.0  # of shoulder and elbow where the arm is stretched out level, degrees; fixed
    ripple: float = 0.0  # of each joint as its gears turn, degrees; an amplitude
    drift: float = 0.0  # of the robot's base, mm between first and last pose; a tenth of it in deg
    focal: float = 0.0  # by which the focal length differs from the believed one, part of it
    scale: float = 0.0  # by which the sheet does, part of it; fixed

    def measured(self, setup: Setup, seed: int, fresh: int = 20) -> Measured:
        """Return a robot of this kind; the last ``fresh`` poses are for the judge."""
        random = np.random.default_rng([seed, self.poses, round(self.cone), setup == "eye-in-hand"])
        count = self.poses + fresh
        told, camera, target = _planned(setup, count, math.radians(self.cone), random)
        real = self._real(told, random)
        lens = CAMERA.matrix.copy()
        lens[[0, 1], [0, 1]] *= 1.0 + self.focal * random.normal()
        really = CameraModel(size=CAMERA.size, matrix=lens)
        sheet = resized(SHEET, 1.0 + self.scale)
        views = []
        for place in real:
            between = place.inverse() if setup == "eye-in-hand" else place
            seen = Transform("camera", "target", *(camera.inverse() @ (between @ target)))
            shown = view(sheet, really, seen, sigma=self.pixels, random=random)
            views.append(dataclasses.replace(shown, target=SHEET))
        said = [Transform("base", "flange", *one) for one in told]
        order = random.permutation(count) if not self.drift else np.arange(count)
        split = np.sort(order[: self.poses]), np.sort(order[self.poses :])
        if self.drift:  # the judge's poses lie between the others
            late = np.linspace(0, count - 1, fresh + 2)[1:-1].round().astype(int)
            split = np.setdiff1d(np.arange(count), late), late
        return Measured(setup, said, views, camera, *split)

    def _real(self, told: list[Rigid], random: np.random.Generator) -> list[Rigid]:
        offsets = math.radians(self.offsets) * random.normal(size=6)
        lengths = LENGTHS + 1e-3 * self.links * random.normal(size=4)
        away, turned = random.normal(size=3), random.normal(size=3)
        phases = np.random.default_rng(int(1e6 * abs(away[0]))).uniform(-3, 3, size=6)
        real: list[Rigid] = []
        last = np.zeros(6)
        for number, one in enumerate(told):
            joints = inverse(one)
            lean = math.radians(self.play) / 2 * np.sign(joints - last)
            last = joints
            place = forward(joints + offsets + lean + self._bent(joints, phases), lengths)
            late = number / len(told)
            moved = Rigid(
                exp_rotation(math.radians(0.1 * self.drift) * late * turned),
                1e-3 * self.drift * late * away,
            )
            size = np.repeat([math.radians(self.degrees), 1e-3 * self.millimetres], 3)
            heavy = math.sqrt(self.tails / random.chisquare(self.tails)) if self.tails < 99 else 1.0
            real.append((moved @ place).turned_in_source(heavy * size * random.normal(size=6)))
        return real

    def _bent(self, joints: Array, phases: Array) -> Array:
        """Return by how much joints (6,) are off for where they are, radians."""
        bent: Array = math.radians(self.ripple) * np.sin(GEARS * joints + phases)
        bent[1] += math.radians(self.sag) * math.sin(joints[1])
        bent[2] += math.radians(self.sag) * math.sin(joints[1] + joints[2])
        return bent


@dataclass(frozen=True, slots=True)
class Measured:
    """What a robot of some kind says and its camera sees.

    Attributes:
        setup: where the camera is.
        poses: ``T_base_flange`` as the controller says.
        views: as many.
        camera: where the camera really is.
        used: numbers of the poses to calibrate with.
        fresh: numbers of those to judge with.
    """

    setup: Setup
    poses: list[Transform]
    views: list[TargetView]
    camera: Rigid
    used: NDArray[np.intp] = field(repr=False)
    fresh: NDArray[np.intp] = field(repr=False)


def _planned(
    setup: Setup, count: int, cone: float, random: np.random.Generator
) -> tuple[list[Rigid], Rigid, Rigid]:
    """Return poses of the flange that an arm can take, camera and target."""
    down = np.diag([1.0, -1.0, -1.0])
    hand = Rigid(
        exp_rotation(random.uniform(-0.5, 0.5, size=3)), random.uniform(-0.06, 0.06, size=3)
    )
    looks = [
        one.rigid for one in poses_around(SHEET, count, tilt=cone, distance=DISTANCE, random=random)
    ]
    looks = [looks[i] for i in random.permutation(count)]
    spot = np.array([0.4, 0.0, 0.15]) + random.uniform(-0.05, 0.05, size=3)
    if setup == "eye-in-hand":
        turn = exp_rotation(np.array([0.0, 0.0, random.uniform(-3, 3)]))
        target = Rigid(turn, spot)
        return [target @ one @ hand.inverse() for one in looks], hand, target
    # the camera hangs above and looks down; the sheet is on the hand, its back to the flange
    beside = Rigid(down, spot + np.array([0.0, 0.0, 0.3 + DISTANCE]))
    target = Rigid(hand.rotation @ down, hand.translation)
    flipped = Rigid(down, np.zeros(3))
    # the flange points up then: turned over, so that an arm from below reaches it
    target = Rigid(flipped.rotation @ target.rotation, target.translation)
    return [beside @ one.inverse() @ target.inverse() for one in looks], beside, target


def forward(joints: Array, lengths: Array = LENGTHS) -> Rigid:
    """Return the flange's pose of joint angles (6,): yaw, two pitches, roll, pitch, roll."""
    first, shoulder, elbow, roll, bend, last = joints
    up, upper, lower, hand = lengths
    place = Rigid(_about(2, first), np.array([0.0, 0.0, up]))
    place = place @ Rigid(_about(1, shoulder), np.zeros(3))
    place = place @ Rigid(_about(1, elbow), np.array([0.0, 0.0, upper]))
    place = place @ Rigid(_about(2, roll), np.array([0.0, 0.0, lower]))
    place = place @ Rigid(_about(1, bend), np.zeros(3))
    return (
        place
        @ Rigid(_about(2, last), np.array([0.0, 0.0, 0.0]))
        @ Rigid(np.eye(3), np.array([0.0, 0.0, hand]))
    )


def inverse(pose: Rigid) -> Array:
    """Return the joint angles (6,) of a flange's pose, elbow up; NaN where it is out of reach."""
    up, upper, lower, hand = LENGTHS
    wrist = pose.translation - hand * pose.rotation[:, 2]
    first = math.atan2(wrist[1], wrist[0])
    out, high = math.hypot(wrist[0], wrist[1]), wrist[2] - up
    reach = out**2 + high**2
    cosine = (reach - upper**2 - lower**2) / (2 * upper * lower)
    if abs(cosine) > 1:
        return np.full(6, np.nan)
    elbow = math.acos(cosine)
    shoulder = math.atan2(out, high) - math.atan2(
        lower * math.sin(elbow), upper + lower * math.cos(elbow)
    )
    rest = (_about(2, first) @ _about(1, shoulder + elbow)).T @ pose.rotation
    bend = math.acos(min(1.0, max(-1.0, float(rest[2, 2]))))
    roll = math.atan2(rest[1, 2], rest[0, 2])
    last = math.atan2(rest[2, 1], -rest[2, 0])
    return np.array([first, shoulder, elbow, roll, bend, last])


def _about(axis: int, angle: float) -> Array:
    vector = np.zeros(3)
    vector[axis] = angle
    return exp_rotation(vector)


KINDS = (
    Kind("no error"),
    Kind("noise", degrees=0.02, millimetres=0.1),
    Kind("noise, 10 poses", poses=10, degrees=0.05, millimetres=0.3, pixels=0.3),
    Kind("noise, 8 poses", poses=8, cone=20, degrees=0.02, millimetres=0.05, pixels=0.5),
    Kind("noise, 6 poses", poses=6, degrees=0.05, millimetres=0.3),
    Kind("noise, 5 poses", poses=5, degrees=0.02, millimetres=0.1),
    Kind("noise, 40 poses", poses=40, degrees=0.05, millimetres=0.3),
    Kind("noise, narrow cone", cone=8, degrees=0.02, millimetres=0.1),
    Kind("heavy tails", degrees=0.02, millimetres=0.1, tails=3),
    Kind("heavier tails, 10 poses", poses=10, degrees=0.02, millimetres=0.1, tails=2),
    Kind("joint offsets of 0.1 deg", offsets=0.1),
    Kind("joint offsets of 0.3 deg", offsets=0.3),
    Kind("joint offsets, 6 poses", poses=6, offsets=0.1),
    Kind("play", play=0.1),
    Kind("play, 30 poses", poses=30, play=0.05, degrees=0.01, millimetres=0.05),
    Kind("drift", drift=1.0, degrees=0.01, millimetres=0.05),
    Kind("lengths of the links", links=0.5),
    Kind("another focal length", focal=0.005, degrees=0.02, millimetres=0.1),
    Kind("a larger sheet", scale=0.01, degrees=0.02, millimetres=0.1),
    Kind(
        "all of it, 20 poses",
        poses=20,
        offsets=0.05,
        play=0.03,
        links=0.2,
        degrees=0.02,
        millimetres=0.05,
        drift=0.2,
    ),
    Kind("sag", "unseen", sag=0.2, degrees=0.01, millimetres=0.05),
    Kind("ripple of the gears", "unseen", ripple=0.05),
    Kind("offsets and noise, 25", "unseen", poses=25, offsets=0.05, degrees=0.03, millimetres=0.2),
    Kind("play, 8 poses", "unseen", poses=8, play=0.1, degrees=0.01),
    Kind("offsets, tails, 12", "unseen", poses=12, offsets=0.05, degrees=0.02, tails=3),
    Kind("ripple and drift, 30", "unseen", poses=30, ripple=0.03, drift=0.5, millimetres=0.05),
)
"""What was looked at while methods were chosen, then what was not."""
