"""Convert a camera's results to messages of ROS, without a node.

Lengths are metres and angles radians on both sides, and axes are as in REP-103: a camera's plane
has x right, y up and z towards the camera, right-handed. With a calibration, smartcam's poses are
already in the robot's frame.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._client._inside import localizations_of
from smartcam._json import json_of
from smartcam.exceptions import RosMessageError
from smartcam.ros2._cameras.reading import (
    calibration_of,
    calibrations_by_application,
    robot_frame_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.models import Localization, Result
    from smartcam.ros2._types.types import RosTypes

EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)

POSES: Final = "geometry_msgs/msg/PoseArray"
DETECTIONS: Final = "vision_msgs/msg/Detection3DArray"
RESULT: Final = "smartcam_msgs/msg/Result"
LOCALIZATION: Final = "smartcam_msgs/msg/Localization"

MAX_ERROR_CHARACTERS = 1000
"""Largest number of characters of an error in a message."""


def error_text(error: BaseException) -> str:
    """Return an error's text for a field ``error``: never empty, and valid as UTF-8."""
    text = str(error) or type(error).__name__
    return utf8(text[:MAX_ERROR_CHARACTERS])


def utf8(text: str) -> str:
    """Return a text without characters that no string of ROS can hold: NUL and lone surrogates."""
    return text.replace("\0", "\ufffd").encode(errors="replace").decode()


class ResultMessages:
    """Makes messages of ROS from results.

    Args:
        types: types of the messages, from the node that publishes them.
        camera: name of the camera, which is also the frame of poses without a calibration.
        frame_id: name of the camera's frame in ROS.
        calibration: calibration in the camera's settings, which names the robot's frame.
        robot_frame: name of the robot's frame in ROS; empty: the calibration's own.

    Attributes:
        frame_id: name of the camera's frame in ROS.
    """

    def __init__(
        self,
        types: RosTypes,
        camera: str,
        frame_id: str,
        calibration: Any = None,
        robot_frame: str = "",
    ) -> None:
        self.frame_id: str = frame_id
        self._camera, self._calibration = camera, calibration
        robots = {
            robot_frame_of(each) for each in calibrations_by_application(calibration).values()
        }
        self._ros_frame_names: dict[str, str] = (
            dict.fromkeys(robots, robot_frame) if robot_frame else {}
        )
        self._ros_frame_names[camera] = frame_id
        by_name = {
            name: types.message(name).cls
            for name in (
                "builtin_interfaces/msg/Time",
                "std_msgs/msg/Header",
                "geometry_msgs/msg/Point",
                "geometry_msgs/msg/Quaternion",
                "geometry_msgs/msg/Vector3",
                "geometry_msgs/msg/Pose",
                "geometry_msgs/msg/PoseStamped",
                "geometry_msgs/msg/PoseWithCovariance",
                POSES,
                LOCALIZATION,
                RESULT,
                "vision_msgs/msg/BoundingBox3D",
                "vision_msgs/msg/ObjectHypothesis",
                "vision_msgs/msg/ObjectHypothesisWithPose",
                "vision_msgs/msg/Detection3D",
                DETECTIONS,
            )
        }
        self._classes: Any = type(
            "Classes", (), {name.rpartition("/")[2]: each for name, each in by_name.items()}
        )
        self._no_covariance = np.zeros(36)
        self._no_covariance.flags.writeable = False

    def frame_of(self, result: Result) -> str:
        """Return the frame of a result's poses.

        Raises:
            RosMessageError: the poses are in several frames.
        """
        localizations = localizations_of(result.value)
        frames = {localization.pose.header.frame_id for localization in localizations or ()}
        if len(frames) > 1:
            raise RosMessageError(
                f"{self._camera}: expected the poses of a result in one frame, got "
                f"{', '.join(sorted(frames))}"
            )
        return self._ros_frame_name(
            frames.pop() if frames else self._default_frame(result.application)
        )

    def _ros_frame_name(self, frame_id: str) -> str:
        return self._ros_frame_names.get(frame_id, frame_id)

    def _default_frame(self, application: int) -> str:
        """Return smartcam's name of the frame of a result without localizations."""
        calibration = calibration_of(self._calibration, application)
        return robot_frame_of(calibration) or self._camera

    def header(self, at: datetime, frame_id: str) -> Any:
        """Return a header."""
        elapsed, ros = at - EPOCH, self._classes
        time = ros.Time(elapsed.days * 86_400 + elapsed.seconds, elapsed.microseconds * 1000)
        return ros.Header(time, frame_id)

    def _pose(self, localization: Localization) -> Any:
        _, position, orientation = localization.pose
        ros = self._classes
        return ros.Pose(ros.Point(*position), ros.Quaternion(*orientation))

    def poses(self, result: Result, parts: Sequence[Localization]) -> Any:
        """Return the ``PoseArray`` of a result.

        Raises:
            RosMessageError: the poses are in several frames.
        """
        header = self.header(result.received_at, self.frame_of(result))
        return self._classes.PoseArray(header, [self._pose(part) for part in parts])

    def detections(self, result: Result, parts: Sequence[Localization]) -> Any:
        """Return the ``Detection3DArray`` of a result: one hypothesis for each part.

        ``class_id`` is its feature, ``score`` its quality, ``bbox.center`` its pose; sizes and
        covariances are 0, which means that they are not known.

        Raises:
            RosMessageError: the poses are in several frames.
        """
        ros = self._classes
        header = self.header(result.received_at, self.frame_of(result))
        no_size = ros.Vector3(0.0, 0.0, 0.0)
        detections = list[Any]()
        for part in parts:
            pose = self._pose(part)
            hypothesis = ros.ObjectHypothesisWithPose(
                ros.ObjectHypothesis(part.feature_id, part.quality),
                ros.PoseWithCovariance(pose, self._no_covariance),
            )
            detections.append(
                ros.Detection3D(header, [hypothesis], ros.BoundingBox3D(pose, no_size), "")
            )
        return ros.Detection3DArray(header, detections)

    def localizations(self, parts: Sequence[Localization]) -> list[Any]:
        """Return the ``smartcam_msgs/msg/Localization`` of each part."""
        ros, messages = self._classes, list[Any]()
        for part in parts:
            pose_header = part.pose.header
            header = self.header(pose_header.stamp, self._ros_frame_name(pose_header.frame_id))
            pose = ros.PoseStamped(header, self._pose(part))
            messages.append(ros.Localization(part.feature_id, part.quality, part.photo_index, pose))
        return messages

    def result(self, result: Result, parts: Sequence[Localization] | None) -> Any:
        """Return the message of a result: the result's bytes and its value.

        Args:
            result: result to send.
            parts: localizations of the result, in metres. If it is None, the result has no
                localizations, and the message has the value as JSON.
        """
        try:
            frame_id = self.frame_of(result)
        except RosMessageError:  # each part has its own frame
            frame_id = ""
        text, error = "", ""
        if parts is None and not isinstance(result.value, bytes):
            try:
                text = json_of(result.value)
            except Exception as exc:  # noqa: BLE001 - a plug-in's value
                error = utf8(f"the value is no JSON: {exc!r:.200}")
        return self._classes.Result(
            self.header(result.received_at, frame_id),
            self._camera,
            max(result.application, 0),  # a camera that does not report it has -1
            result.number,
            error,
            self.localizations(parts or ()),
            text,
            result.raw,
        )

    def failed(self, error: BaseException, at: datetime) -> Any:
        """Return the message of a result that could not be interpreted."""
        header = self.header(at, self.frame_id)
        return self._classes.Result(header, self._camera, 0, 0, error_text(error), [], "", b"")
