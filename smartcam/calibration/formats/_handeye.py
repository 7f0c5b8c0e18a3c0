"""Read and write files of easy_handeye (ROS 1) and easy_handeye2 (ROS 2): a camera's pose.

The pose is that of the camera (``tracking_base_frame``), in the effector's frame if the robot
carries it, in the base's if it is fixed; another entry of the file says which.

Source: github.com/IFL-CAMP/easy_handeye, ``handeye_calibration.py`` (published);
github.com/marcoesposito1988/easy_handeye2, ``handeye_calibration.py`` and ``easy_handeye2_msgs``
(published).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.calibration.formats._plain import (
    POSE,
    Plain,
    block,
    flag,
    frame_name,
    load_yaml,
    malformed_error,
    mapping,
    numbers,
    placed,
    quoted,
    row,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.geometry import Transform

_ROBOT = {False: "robot_base_frame", True: "robot_effector_frame"}
_TYPES = {"eye_on_base": False, "eye_in_hand": True}


def parse_easy_handeye(text: str) -> Transform:
    """Return the camera's pose of an easy_handeye file."""
    data = mapping(load_yaml(text), "file", ["transformation"])
    parameters = mapping(data.get("parameters", data), "parameters", ["eye_on_hand"])
    pose = numbers(data["transformation"], "transformation", POSE)
    in_hand = flag(parameters["eye_on_hand"], "parameters.eye_on_hand")
    return _camera(parameters, pose, in_hand=in_hand)


def parse_easy_handeye2(text: str) -> Transform:
    """Return the camera's pose of an easy_handeye2 file."""
    data = mapping(load_yaml(text), "file", ["parameters", "transform"])
    parameters = mapping(data["parameters"], "parameters", ["calibration_type"])
    transform = mapping(data["transform"], "transform", ["translation", "rotation"])
    pose = [
        *numbers(transform["translation"], "transform.translation", "xyz"),
        *numbers(transform["rotation"], "transform.rotation", "xyzw"),
    ]
    kind = parameters["calibration_type"]
    if kind not in _TYPES:
        raise malformed_error("parameters.calibration_type", " or ".join(_TYPES), kind)
    return _camera(parameters, pose, in_hand=_TYPES[kind])


def _camera(parameters: Mapping[str, Plain], pose: list[float], *, in_hand: bool) -> Transform:
    names = mapping(parameters, "parameters", [_ROBOT[in_hand], "tracking_base_frame"])
    robot, camera = (
        frame_name(names[key], f"parameters.{key}")
        for key in (_ROBOT[in_hand], "tracking_base_frame")
    )
    return placed(robot, camera, pose)


def compose_easy_handeye(transform: Transform, *, in_hand: bool = False) -> str:
    """Return an easy_handeye file.

    ``transform``: the camera's pose, ``T_base_camera``, or ``T_effector_camera`` if the robot
    carries it.
    """
    pose = dict(zip(POSE, row(transform), strict=True))
    return (
        "parameters:\n"
        f"  eye_on_hand: {'true' if in_hand else 'false'}\n"
        "  move_group: manipulator\n"
        "  move_group_namespace: /\n"
        '  namespace: "/smartcam/"\n'
        f"{_frames(transform, in_hand)}"
        f"transformation:\n{block(pose, '  ')}"
    )


def compose_easy_handeye2(transform: Transform, *, in_hand: bool = False) -> str:
    """Return an easy_handeye2 file; the arguments are those of :func:`compose_easy_handeye`."""
    translation = dict(zip("xyz", row(transform)[:3], strict=True))
    rotation = dict(zip("xyzw", row(transform)[3:], strict=True))
    return (
        "parameters:\n"
        '  name: "smartcam"\n'
        f"  calibration_type: {'eye_in_hand' if in_hand else 'eye_on_base'}\n"
        f"{_frames(transform, in_hand)}"
        "  freehand_robot_movement: true\n"
        "  move_group_namespace: /\n"
        "  move_group: manipulator\n"
        f"transform:\n  translation:\n{block(translation, '    ')}"
        f"  rotation:\n{block(rotation, '    ')}"
    )


def _frames(transform: Transform, in_hand: bool) -> str:
    names = dict.fromkeys(["robot_base_frame", "robot_effector_frame"], "")
    names[_ROBOT[in_hand]] = frame_name(transform.target, "target")
    names["tracking_base_frame"] = frame_name(transform.source, "source")
    names["tracking_marker_frame"] = ""
    return "".join(f"  {key}: {quoted(name)}\n" for key, name in names.items())
