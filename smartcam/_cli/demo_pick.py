"""``smartcam demo --pick``: an emulated camera and a simulated robot, from touches to picks.

The robot does not know where the table is: it touches marks that the camera sees, and these pairs
give the calibration. The robot's picks are then compared with the truth, which a real cell does
not know, and with the calibration's prediction, which a real cell knows.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import smartcam
from smartcam._cli.demo import Steps
from smartcam._cli.options import label_file_errors
from smartcam._cli.texts import table_text
from smartcam.emulator import EmulatedCamera, TablePose
from smartcam.emulator._inside import TABLE_SIZE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam._cli.options import Options
    from smartcam.calibration import PlaneCalibration
    from smartcam.emulator import TableScene
    from smartcam.geometry import Transform
    from smartcam.models import Localization

TANGRAM_ID: Final = 7

TOUCH_SIGMA: Final = 2e-4
"""Standard deviation of a touch along each of the robot's axes, metres."""

MAX_GRIP_ERROR: Final = 2e-3
"""Largest distance from a part at which the gripper can take it, metres."""

EDGE_DISTANCE: Final = 0.025
"""Distance of the outer marks from the table's edge, metres."""


class Pick(NamedTuple):
    """The outcome of picking one part."""

    part: str
    x: float  # place that the robot went to, metres in the robot's frame: x
    y: float  # y
    z: float  # z
    error: float  # distance from there to the part, metres
    predicted: float  # rms of the error to expect there, metres
    heading_error: float  # error of the gripper's heading, radians
    taken: bool  # whether the gripper was near enough


class SimulatedRobot:
    """A robot beside the table; the table's pose in the robot's frame is random.

    Args:
        scene: the table.
        seed: seed of the table's place, and of the noise of the touches.
    """

    def __init__(self, scene: TableScene, seed: int) -> None:
        import numpy as np

        from smartcam.geometry import Transform

        self._scene = scene
        self._random = np.random.default_rng(seed)
        quaternion = self._random.normal(size=4)
        position = self._random.uniform(-0.6, 0.6, 3)
        self.table: Transform = Transform.from_quaternion(
            "robot", "table", position, quaternion / np.linalg.norm(quaternion)
        )
        """The table's true pose; only the comparison uses it."""

    @property
    def tool_z(self) -> NDArray[Any]:
        """Direction of the tool's axis when it touches the table, (3,), in the robot's frame."""
        return -self.table.rotation[:, 2]

    def touch(self, mark: TablePose) -> NDArray[Any]:
        """Return the robot's reading when its tip touches a mark, (3,) in metres."""
        true_point = self.table.apply([mark.x, mark.y, 0.0])
        return true_point + self._random.normal(0.0, TOUCH_SIGMA, 3)

    def pick(self, part: Localization, predicted: float) -> Pick:
        """Go to a part and close the gripper, which takes the part if it is near enough.

        ``part``: the pose to go to, in the robot's frame, z into the table. ``predicted``: rms of
        the expected error, metres.
        """
        from smartcam.geometry import Transform

        pose = part.pose
        gripper = Transform.from_quaternion("robot", "part", pose.position, pose.orientation)
        pose_on_table = self.table.inverse() @ gripper
        x, y, z = pose_on_table.translation.tolist()
        true_pose = self._scene.pieces[part.feature_id]
        error = math.dist((x, y, z), (true_pose.x, true_pose.y, 0.0))
        heading = math.atan2(pose_on_table.rotation[1, 0], pose_on_table.rotation[0, 0])
        heading_error = math.remainder(heading - true_pose.theta, math.tau)
        taken = error < MAX_GRIP_ERROR
        if taken:
            del self._scene.pieces[part.feature_id]
        return Pick(part.feature_id, *pose.position, error, predicted, heading_error, taken)


async def pick(options: Options, picture: str, seed: int) -> None:
    """Calibrate, localize, pick all seven pieces, and write a picture (SVG).

    ``seed``: seed of the camera's noise, the table's place and the touches' noise. Raises
    MissingExtraError: the extra ``calibration`` is not installed; ConfigurationError: the picture
    cannot be written.
    """
    from smartcam._extras import load

    load("scipy")  # first, so that it fails before the other steps
    steps = Steps(options)
    async with EmulatedCamera(active=TANGRAM_ID, seed=seed) as emulator:
        robot = SimulatedRobot(emulator.scene, seed)
        steps.step(
            f"A camera above a table: {emulator.url}. A robot beside it, which does not know where "
            "the table is.",
            url=emulator.url,
        )
        async with smartcam.connect(
            emulator.url, name="demo", application=TANGRAM_ID, interpret_as="localizations"
        ) as camera:
            timeout = options.step_timeout(5.0)
            pieces = dict(emulator.scene.pieces)
            marks = nine_marks()
            _put_on_table(emulator.scene, marks)
            marks_seen = (await camera.trigger(timeout=timeout)).value
            calibration = _calibrate(marks_seen, marks, robot, steps)
            _put_on_table(emulator.scene, pieces)
            result = await camera.trigger(timeout=timeout)
            noise = emulator.scene.pixel_noise / emulator.scene.scale
            _pick_all(result.value, calibration, robot, noise, steps)
            parts_left = (await camera.trigger(timeout=timeout)).value
            steps.step(
                f"Triggered once more: {len(parts_left)} parts on the table.", left=len(parts_left)
            )
    _write_picture(picture, calibration, result.value, steps)


def nine_marks() -> dict[str, TablePose]:
    """Return marks on a grid over the whole table: three by three."""
    columns, rows = ((EDGE_DISTANCE, size / 2, size - EDGE_DISTANCE) for size in TABLE_SIZE)
    places = [(x, y) for y in rows for x in columns]
    return {f"mark_{n}": TablePose(x, y, 0.0) for n, (x, y) in enumerate(places, start=1)}


def _put_on_table(scene: TableScene, things: dict[str, TablePose]) -> None:
    """Replace everything on the table by these marks or parts."""
    scene.pieces.clear()
    scene.pieces.update(things)


def _calibrate(
    marks_seen: list[Localization], marks: dict[str, TablePose], robot: SimulatedRobot, steps: Steps
) -> PlaneCalibration:
    from smartcam.calibration import fit_plane

    camera_points = [tuple(mark.pose.position[:2]) for mark in marks_seen]
    robot_points = [robot.touch(marks[mark.feature_id]).tolist() for mark in marks_seen]
    steps.step(
        f"The camera localizes {len(marks_seen)} marks, the robot touches each of them "
        f"({1e3 * TOUCH_SIGMA:g} mm of noise on each axis), mm:",
        camera_points=camera_points,
        robot_points=robot_points,
    )
    rows = [
        (mark.feature_id, *_mm_texts(*camera, *touched))
        for mark, camera, touched in zip(marks_seen, camera_points, robot_points, strict=True)
    ]
    steps.detail(table_text(("mark", *_align_right("camera x", "y", "robot x", "y", "z")), rows))
    calibration = fit_plane(
        camera_points, robot_points, touch_sigma=TOUCH_SIGMA, tool_z=robot.tool_z
    )
    held_out = calibration.held_out_error or math.nan
    steps.step(
        f"Calibrated ({calibration.model}). Each touch against a calibration from the other eight: "
        f"{1e3 * held_out:.2f} mm rms, the touch's own noise included",
        model=calibration.model,
        held_out_error=held_out,
        warnings=[remark.text for remark in calibration.warnings],
    )
    for remark in calibration.warnings:
        steps.detail(f"   {remark.code}: {remark.text}")
    return calibration


def _pick_all(
    parts: list[Localization],
    calibration: PlaneCalibration,
    robot: SimulatedRobot,
    noise: float,
    steps: Steps,
) -> None:
    """Pick every part, and print the errors beside the predicted ones.

    ``noise``: the camera's noise along each axis, metres; it adds to the calibration's error.
    """
    positions = [part.pose.position[:2] for part in parts]
    predicted = [
        math.hypot(p, noise, noise) for p in calibration.predicted_error(positions).tolist()
    ]
    targets = calibration.to_robot(parts, tool_flip=True)
    picks = [robot.pick(part, error) for part, error in zip(targets, predicted, strict=True)]
    steps.step(f"Triggered: {len(parts)} parts. The robot goes to each of them and picks it, mm:")
    rows = [
        (
            pick.part,
            *_mm_texts(pick.x, pick.y, pick.z, pick.error, pick.predicted),
            f"{math.degrees(pick.heading_error):+.2f} deg",
            "picked" if pick.taken else "missed",
        )
        for pick in picks
    ]
    head = ("part", *_align_right("x", "y", "z", "error", "predicted"), "turned by", "")
    steps.detail(table_text(head, rows), picks=picks)
    errors, expected = ([getattr(pick, name) for pick in picks] for name in ("error", "predicted"))
    steps.detail(
        f"   error {1e3 * _rms(errors):.2f} mm rms, predicted {1e3 * _rms(expected):.2f} mm; "
        f"{sum(pick.taken for pick in picks)} of {len(picks)} picked",
        error=_rms(errors),
        predicted=_rms(expected),
        picked=sum(pick.taken for pick in picks),
    )


def _mm_texts(*metres: float) -> list[str]:
    """Return lengths as millimetres."""
    return _align_right(*(f"{1e3 * value:.2f}" for value in metres))


def _align_right(*texts: str) -> list[str]:
    """Return texts in cells of one width, aligned to the right."""
    return [text.rjust(9) for text in texts]


def _rms(values: list[float]) -> float:
    return math.hypot(*values) / math.sqrt(len(values))


def _write_picture(
    path: str, calibration: PlaneCalibration, parts: list[Localization], steps: Steps
) -> None:
    from smartcam.calibration._inside import draw

    text = draw(calibration, parts, title="smartcam demo --pick")
    with label_file_errors(f"--picture {path}"):
        Path(path).write_text(text, encoding="utf-8", newline="\n")
    steps.step(f"The touches, their errors and the calibration's uncertainty: {path}", picture=path)
