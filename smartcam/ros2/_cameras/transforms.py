"""Publish where a calibrated camera is, as transforms on ``/tf_static``.

Frames are as in REP-103 and REP-105: metres, right-handed; the camera's pictures have an optical
frame, x right, y down and z ahead, whose name has the suffix ``_optical``.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.exceptions import CalibrationError, ConfigurationError
from smartcam.geometry import Transform
from smartcam.ros2._cameras.image_messages import stamp_fields
from smartcam.ros2._cameras.reading import calibrations_by_application
from smartcam.ros2._node.qos import LATCHED

if TYPE_CHECKING:
    from collections.abc import Iterable

logger: logging.Logger = logging.getLogger("smartcam.ros2")

TOPIC = "/tf_static"

TYPE = "tf2_msgs/msg/TFMessage"


class CameraFrames:
    """The names of a camera's frames, for its messages and ``/tf_static``.

    Args:
        frame_id: name of the camera's frame, the frame of its results without a calibration.
        calibration: calibration of the camera's settings, or one for each application; None
            without.
        hand_eye: hand-eye calibration of the camera; None without.
        parent: name of the robot's frame; empty: the name in a calibration.
        flange: name of the frame of the part of the robot that carries the camera; empty: the name
            in a calibration.
        calibration_pose: pose of that part in the robot's frame when ``calibration`` was made; None
            if the camera stands still.

    Attributes:
        optical: name of the frame of the camera's pictures, z ahead and y down.
        robot: name of the frame of results with a calibration; empty: the calibration's own.
    """

    def __init__(
        self,
        frame_id: str,
        calibration: Any = None,
        *,
        hand_eye: Any = None,
        parent: str = "",
        flange: str = "",
        calibration_pose: Transform | None = None,
    ) -> None:
        self._frame_id, self._parent, self._flange = frame_id, parent, flange
        self._calibrations = calibrations_by_application(calibration)
        self._hand_eye, self._calibration_pose = hand_eye, calibration_pose
        self.optical: str = f"{frame_id.removesuffix('_optical')}_optical"
        self.robot: str = parent if calibration_pose is None else f"{frame_id}_robot"

    def transforms(self) -> list[Transform]:
        """Return the transforms from the calibrations.

        ================== ================================= ==================================
        calibration        parent                            child
        ================== ================================= ==================================
        plane              the robot                         the camera's frame
        sheet              the robot                         the camera's frame with ``_sheet``
        plane or sheet,    the part of the robot that        the robot's frame at the time of
        carried camera     carries the camera                the calibration
        hand-eye           the robot's base; its flange,     the pictures' frame
                           if the robot carries the
                           camera
        ================== ================================= ==================================

        With calibrations for several applications, each child's name ends with ``_APPLICATION``.
        """
        transforms = [] if self._hand_eye is None else [self._picture_transform(self._hand_eye)]
        if self._calibration_pose is not None:
            base_in_flange = self._calibration_pose.inverse()
            return [
                *transforms,
                _with_frame_names(
                    base_in_flange, self._flange or base_in_flange.target, self.robot
                ),
            ]
        for application, calibration in self._calibrations.items():
            suffix = "" if application is None else f"_{application}"
            transforms += self._plane_transforms(calibration, suffix)
        return transforms

    def _picture_transform(self, hand_eye: Any) -> Transform:
        pose: Transform = hand_eye.camera_pose
        frame = self._flange if hand_eye.setup == "eye-in-hand" else self._parent
        return _with_frame_names(pose, frame or pose.target, self.optical)

    def _plane_transforms(self, calibration: Any, suffix: str) -> list[Transform]:
        """Return the frame of a plane; none if a calibration has no plane."""
        plane = getattr(calibration, "plane", calibration)
        if getattr(plane, "kind", "") != "plane":
            return []
        name = self._frame_id if plane is calibration else f"{self._frame_id}_sheet"
        child, parent = f"{name}{suffix}", self._parent or plane.robot_frame
        try:
            return [Transform(parent, child, plane.rotation, plane.origin)]
        except CalibrationError as exc:
            logger.info("%s: no frame of its plane: %s", child, exc)
            return []


def _with_frame_names(transform: Transform, parent: str, child: str) -> Transform:
    return Transform(parent, child, transform.rotation, transform.translation)


def transform_fields(transform: Transform, utc: float) -> dict[str, Any]:
    """Return ``geometry_msgs/TransformStamped``: the source's pose in the target, its parent."""
    x, y, z, w = map(float, transform.quaternion / np.linalg.norm(transform.quaternion))
    x_translation, y_translation, z_translation = map(float, transform.translation)
    return {
        "header": {"stamp": stamp_fields(utc), "frame_id": transform.target},
        "child_frame_id": transform.source,
        "transform": {
            "translation": {"x": x_translation, "y": y_translation, "z": z_translation},
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


class StaticTransforms:
    """Publishes all static transforms of a node, latched, with one publisher.

    Args:
        node: open node of ROS.
        transforms: each from a child, its source, into its parent, its target.

    Raises:
        ConfigurationError: as :meth:`replace`.
    """

    def __init__(self, node: Any, transforms: Iterable[Transform] = ()) -> None:
        self._node = node
        self._transforms = _check_transforms(transforms)
        self._publisher: Any = None

    def start(self) -> None:
        """Publish the transforms, if there are any."""
        if self._publisher is None and self._transforms:
            self._publisher = self._node.publisher(TOPIC, TYPE, qos=LATCHED)
            self._publish()

    async def close(self) -> None:
        """Stop publishing. Idempotent."""
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            publisher.close()

    def replace(self, transforms: Iterable[Transform]) -> None:
        """Replace the transforms, as after a new calibration.

        A listener keeps an old transform whose child has no new one, since TF never removes
        transforms.

        Raises:
            ConfigurationError: a frame has no name, begins with ``/``, is its own parent, or has
                two parents.
        """
        self._transforms = _check_transforms(transforms)
        if self._publisher is not None:
            self._publish()
        else:
            self.start()

    def _publish(self) -> None:
        now = time.time()
        self._publisher.publish(
            transforms=[transform_fields(each, now) for each in self._transforms]
        )


def _check_transforms(transforms: Iterable[Transform]) -> tuple[Transform, ...]:
    checked: dict[str, Transform] = {}
    for transform in transforms:
        for name in (transform.target, transform.source):
            if not name or name.startswith("/"):
                raise ConfigurationError(
                    f"tf: {transform.label}: expected names of frames that do not begin with /, "
                    f"got {name!r}"
                )
        if transform.target == transform.source or transform.source in checked:
            other = checked.get(transform.source, transform).target
            raise ConfigurationError(
                f"tf: {transform.source}: expected one parent that is another frame, "
                f"got {transform.target} and {other}"
            )
        checked[transform.source] = transform
    return tuple(checked.values())
