"""``/tf_static``: where a camera is, where its calibration says so.

Frames as in REP-103 and REP-105: metres, right-handed; the camera's is the optical one, x right,
y down and z ahead, whose name has the suffix ``_optical``.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.calibration import Transform
from smartcam.calibration.formats import plane_frame
from smartcam.exceptions import CalibrationError, ConfigurationError
from smartcam.ros2._image_messages import stamp_fields
from smartcam.ros2._qos import LATCHED

if TYPE_CHECKING:
    from collections.abc import Iterable

logger: logging.Logger = logging.getLogger("smartcam.ros2")

TOPIC = "/tf_static"

TYPE = "tf2_msgs/msg/TFMessage"


def camera_transforms(calibration: Any, frame_id: str, *, parent: str = "") -> list[Transform]:
    """Return where a calibration puts a camera; nothing where it does not say.

    ================== ==================================== =================================
    calibration        parent                               child
    ================== ==================================== =================================
    hand-eye           the robot's base; its flange, where  the camera, ``frame_id``
                       the robot carries the camera
    pair of cameras    the left camera, ``frame_id``        the right one, ``FRAME_right``
    plane, rigid or    the robot                            the plane: ``camera_frame``, or
    similar                                                 ``FRAME_plane``
    ================== ==================================== =================================

    Args:
        calibration: a ``HandEyeCalibration``, ``StereoCalibration`` or ``PlaneCalibration``; of
            others, and of a plane with another scale at each place, there is nothing to say.
        frame_id: of the camera.
        parent: what the parent is called; "": as the calibration calls it.
    """
    kind = getattr(calibration, "kind", "")
    if kind == "hand-eye":
        pose = calibration.camera_pose
        return [_named(pose, parent or pose.target, frame_id)]
    if kind == "stereo":
        stem = frame_id.removesuffix("_optical")
        right = f"{stem}_right{'_optical' if stem != frame_id else ''}"
        return [_named(calibration.transform.inverse(), parent or frame_id, right)]
    if kind == "plane":
        try:
            found = plane_frame(calibration, name=f"{frame_id}_plane").transform
        except CalibrationError as exc:
            logger.info("%s: no frame of its plane: %s", frame_id, exc)
            return []
        return [_named(found, parent or found.target, found.source)]
    return []


def _named(transform: Transform, parent: str, child: str) -> Transform:
    return Transform(parent, child, transform.rotation, transform.translation)


def transform_fields(transform: Transform, utc: float) -> dict[str, Any]:
    """Return ``geometry_msgs/TransformStamped``: the source's pose in the target, its parent."""
    x, y, z, w = (float(one) for one in transform.quaternion / np.linalg.norm(transform.quaternion))
    across, down, ahead = (float(one) for one in transform.translation)
    return {
        "header": {"stamp": stamp_fields(utc), "frame_id": transform.target},
        "child_frame_id": transform.source,
        "transform": {
            "translation": {"x": across, "y": down, "z": ahead},
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


class StaticTransforms:
    """Publishes where frames are that do not move, latched: one publisher of all of a node's.

    Args:
        node: of ROS; open.
        transforms: each from a child, its source, into its parent, its target.

    Raises:
        ConfigurationError: as :meth:`replace`.
    """

    def __init__(self, node: Any, transforms: Iterable[Transform] = ()) -> None:
        self._node = node
        self._transforms = _checked(transforms)
        self._publisher: Any = None

    def start(self) -> None:
        """Publish them, if there are any."""
        if self._publisher is None and self._transforms:
            self._publisher = self._node.publisher(TOPIC, TYPE, qos=LATCHED)
            self._say()

    async def close(self) -> None:
        """Be gone. Idempotent."""
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            publisher.close()

    def replace(self, transforms: Iterable[Transform]) -> None:
        """Publish others in their place, as after a new calibration.

        Who has heard the old ones keeps those whose child is none of the new ones: TF forgets
        nothing.

        Raises:
            ConfigurationError: a frame without a name or with a ``/`` in front, that is its own
                parent, or that has two.
        """
        self._transforms = _checked(transforms)
        if self._publisher is not None:
            self._say()
        else:
            self.start()

    def _say(self) -> None:
        now = time.time()
        self._publisher.publish(transforms=[transform_fields(one, now) for one in self._transforms])


def _checked(transforms: Iterable[Transform]) -> tuple[Transform, ...]:
    kept: dict[str, Transform] = {}
    for one in transforms:
        for name in (one.target, one.source):
            if not name or name.startswith("/"):
                raise ConfigurationError(
                    f"tf: {one.label}: expected names of frames without / in front, got {name!r}"
                )
        if one.target == one.source or one.source in kept:
            other = kept[one.source].target if one.source in kept else one.target
            raise ConfigurationError(
                f"tf: {one.source}: expected one parent that is another frame, got {one.target} "
                f"and {other}"
            )
        kept[one.source] = one
    return tuple(kept.values())
