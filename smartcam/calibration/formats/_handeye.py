"""Read and write files of easy_handeye (ROS 1) and easy_handeye2 (ROS 2): a camera's pose.

A file has the pose of the camera (``tracking_base_frame``): in the effector's frame if the robot
carries the camera, in the base's frame if the camera is fixed. Another entry of the file says
whether the robot carries the camera.

Source: github.com/IFL-CAMP/easy_handeye, ``handeye_calibration.py`` (published);
github.com/marcoesposito1988/easy_handeye2, ``handeye_calibration.py`` and ``easy_handeye2_msgs``
(published).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.calibration.formats._plain import (
    POSE,
    Plain,
    as_flag,
    as_mapping,
    block_mapping,
    frame_name,
    load_yaml,
    malformed_error,
    numbers_by_key,
    pose_numbers,
    quote,
    transform_of_pose,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.geometry import Transform

_ROBOT_KEYS = {False: "robot_base_frame", True: "robot_effector_frame"}
_IN_HAND_BY_TYPE = {"eye_on_base": False, "eye_in_hand": True}


def parse_easy_handeye(text: str) -> Transform:
    """Return the camera's pose of an easy_handeye file."""
    data = as_mapping(load_yaml(text), "file", ["transformation"])
    parameters = as_mapping(data.get("parameters", data), "parameters", ["eye_on_hand"])
    pose = numbers_by_key(data["transformation"], "transformation", POSE)
    in_hand = as_flag(parameters["eye_on_hand"], "parameters.eye_on_hand")
    return _camera_pose(parameters, pose, in_hand=in_hand)


def parse_easy_handeye2(text: str) -> Transform:
    """Return the camera's pose of an easy_handeye2 file."""
    data = as_mapping(load_yaml(text), "file", ["parameters", "transform"])
    parameters = as_mapping(data["parameters"], "parameters", ["calibration_type"])
    transform = as_mapping(data["transform"], "transform", ["translation", "rotation"])
    pose = [
        *numbers_by_key(transform["translation"], "transform.translation", "xyz"),
        *numbers_by_key(transform["rotation"], "transform.rotation", "xyzw"),
    ]
    calibration_type = parameters["calibration_type"]
    if calibration_type not in _IN_HAND_BY_TYPE:
        raise malformed_error(
            "parameters.calibration_type", " or ".join(_IN_HAND_BY_TYPE), calibration_type
        )
    return _camera_pose(parameters, pose, in_hand=_IN_HAND_BY_TYPE[calibration_type])


def _camera_pose(parameters: Mapping[str, Plain], pose: list[float], *, in_hand: bool) -> Transform:
    names = as_mapping(parameters, "parameters", [_ROBOT_KEYS[in_hand], "tracking_base_frame"])
    robot, camera = (
        frame_name(names[key], f"parameters.{key}")
        for key in (_ROBOT_KEYS[in_hand], "tracking_base_frame")
    )
    return transform_of_pose(robot, camera, pose)


def compose_easy_handeye(transform: Transform, *, in_hand: bool = False) -> str:
    """Return an easy_handeye file.

    ``transform``: the camera's pose, ``T_base_camera``, or ``T_effector_camera`` if the robot
    carries it.
    """
    pose = dict(zip(POSE, pose_numbers(transform), strict=True))
    return (
        "parameters:\n"
        f"  eye_on_hand: {'true' if in_hand else 'false'}\n"
        "  move_group: manipulator\n"
        "  move_group_namespace: /\n"
        '  namespace: "/smartcam/"\n'
        f"{_frame_lines(transform, in_hand)}"
        f"transformation:\n{block_mapping(pose, '  ')}"
    )


def compose_easy_handeye2(transform: Transform, *, in_hand: bool = False) -> str:
    """Return an easy_handeye2 file; the arguments are those of :func:`compose_easy_handeye`."""
    translation = dict(zip("xyz", pose_numbers(transform)[:3], strict=True))
    rotation = dict(zip("xyzw", pose_numbers(transform)[3:], strict=True))
    return (
        "parameters:\n"
        '  name: "smartcam"\n'
        f"  calibration_type: {'eye_in_hand' if in_hand else 'eye_on_base'}\n"
        f"{_frame_lines(transform, in_hand)}"
        "  freehand_robot_movement: true\n"
        "  move_group_namespace: /\n"
        "  move_group: manipulator\n"
        f"transform:\n  translation:\n{block_mapping(translation, '    ')}"
        f"  rotation:\n{block_mapping(rotation, '    ')}"
    )


def _frame_lines(transform: Transform, in_hand: bool) -> str:
    names = dict.fromkeys(["robot_base_frame", "robot_effector_frame"], "")
    names[_ROBOT_KEYS[in_hand]] = frame_name(transform.target, "target")
    names["tracking_base_frame"] = frame_name(transform.source, "source")
    names["tracking_marker_frame"] = ""
    return "".join(f"  {key}: {quote(name)}\n" for key, name in names.items())
