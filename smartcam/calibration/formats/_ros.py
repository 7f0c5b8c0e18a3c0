"""Read and write arguments of ROS' ``static_transform_publisher`` and poses of ROS-Industrial.

Three programs are called ``static_transform_publisher``. The arguments of ROS 1's ``tf`` end with a
period in milliseconds, the arguments of ROS 1's ``tf2_ros`` do not, and ROS 2's program takes
options. Each program accepts quaternions, and yaw, pitch and roll: ``Rz(yaw) Ry(pitch) Rx(roll)``,
radians.

Source: wiki.ros.org/tf, section 6.3; github.com/ros2/geometry2,
``static_transform_broadcaster_program.cpp``; github.com/moveit/moveit_calibration,
``handeye_control_widget.cpp``, for the launch file; github.com/Jmeyer1292/robot_cal_tools,
``rct_examples``, for poses (all published).
"""

from __future__ import annotations

import ast
import re
import shlex
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._units import check_angles
from smartcam.calibration.formats._plain import (
    POSE,
    as_list,
    as_mapping,
    as_number,
    as_numbers,
    block_mapping,
    frame_name,
    load_yaml,
    malformed_error,
    numbers_by_key,
    pose_numbers,
    transform_of_pose,
)
from smartcam.calibration.formats._robots import angles_zyx, rotation_zyx
from smartcam.calibration.formats._xml import load_xml
from smartcam.geometry import Transform

if TYPE_CHECKING:
    from collections.abc import Sequence

PERIOD_MS = 100
"""Period of the messages of ``tf``, milliseconds; the documents of ``tf`` call 100 a good value."""

_COMMAND = "static_transform_publisher"
_PYTHON = re.compile(r"^(?:from|import) [a-z]", re.MULTILINE)
_QUATERNION = {"--qx": 0.0, "--qy": 0.0, "--qz": 0.0, "--qw": 1.0}
_ANGLES = {"--yaw": 0.0, "--pitch": 0.0, "--roll": 0.0}
_POSITION = {"--x": 0.0, "--y": 0.0, "--z": 0.0}
_FRAMES = ("--frame-id", "--child-frame-id")


def parse_arguments(text: str) -> Transform:
    """Return the transform that ``static_transform_publisher`` would send.

    ``text``: the program's arguments, with or without the command before them; ``#`` begins a
    comment. The text may also be a launch file with one such node: XML of ROS 1 or 2, or ROS 2's
    Python, which is read as text and not run. Raises ``MALFORMED`` if the number of arguments is
    wrong, an option is unknown, or the arguments have two possible meanings.
    """
    if text.lstrip().startswith("<"):
        text = _launch_arguments(text)
    elif _PYTHON.search(text):
        return _parse_words(_python_arguments(text))
    try:
        words = shlex.split(text, comments=True)
    except ValueError as exc:
        raise malformed_error("arguments", f"words as on a command line ({exc})") from exc
    return _parse_words(words)


def _parse_words(words: list[str]) -> Transform:
    if _COMMAND in words:
        words = words[words.index(_COMMAND) + 1 :]
    if any(word.startswith("--") for word in words):
        return _parse_options(words)
    return _parse_positional(words)


def _launch_arguments(text: str) -> str:
    """Return the arguments of the one publisher in a launch file."""
    nodes = [node.attrib for node in load_xml(text.strip()).iter("node")]
    arguments = [
        node["args"]
        for node in nodes
        if _COMMAND in (node.get("type"), node.get("exec")) and "args" in node
    ]
    if len(arguments) != 1:
        raise malformed_error("launch file", f"one node of type {_COMMAND}", str(len(arguments)))
    return arguments[0]


def _python_arguments(text: str) -> list[str]:
    """Return the arguments of the one publisher in a launch file of Python, which is not run."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, MemoryError, RecursionError) as exc:
        raise malformed_error("launch file", f"Python ({exc})") from exc
    calls = [
        {keyword.arg: keyword.value for keyword in node.keywords}
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
    ]
    arguments = [
        call["arguments"]
        for call in calls
        if "arguments" in call
        and isinstance(call.get("executable"), ast.Constant)
        and getattr(call["executable"], "value", None) == _COMMAND
    ]
    if len(arguments) != 1:
        raise malformed_error(
            "launch file", f"one Node of executable {_COMMAND}", str(len(arguments))
        )
    try:
        words = ast.literal_eval(arguments[0])
    except (ValueError, TypeError, MemoryError, RecursionError) as exc:
        raise malformed_error(
            "arguments", "texts and numbers, no variables or calls", "others"
        ) from exc
    return [str(word) for word in as_list(words, "arguments")]


def parse_urdf(text: str, target: str, source: str) -> Transform:
    """Return the origin of a joint of a robot's description: the child's pose in the parent.

    If there are several joints, the joint from ``target`` to ``source`` is used.
    """
    joints = {}
    for joint in load_xml(text.strip()).iter("joint"):
        ends = [link.get("link", "") for kind in ("parent", "child") for link in joint.iter(kind)]
        if len(ends) == 2:
            joints[ends[0], ends[1]] = joint
    names = (target, source)
    if names not in joints and len(joints) == 1:
        (names,) = joints
    if names not in joints:
        joints_text = ", ".join(f"{parent} to {child}" for parent, child in joints) or "none"
        raise malformed_error("file", f"a joint of parent {target} and child {source}", joints_text)
    given = next((origin.attrib for origin in joints[names].iter("origin")), {})
    position, rotation = (
        as_numbers(given.get(name, "0 0 0").split(), f"origin {name}", 3) for name in ("xyz", "rpy")
    )
    return _make_transform(position, rotation[::-1], names)


def _parse_options(words: Sequence[str]) -> Transform:
    options = [*_POSITION, *_QUATERNION, *_ANGLES, *_FRAMES]
    given: dict[str, str] = {}
    for option, value in zip(words[::2], [*words[1::2], None], strict=False):
        if option not in options or option in given or value is None:
            raise malformed_error("arguments", f"options {', '.join(options)}, each once", option)
        given[option] = value
    missing = [frame for frame in _FRAMES if frame not in given]
    if missing or (given.keys() & _QUATERNION and given.keys() & _ANGLES):
        raise malformed_error(
            "arguments",
            f"{' and '.join(_FRAMES)}, and a quaternion or angles, not both",
            " ".join(given),
        )
    return _make_transform(
        _option_values(_POSITION, given),
        _option_values(_ANGLES if given.keys() & _ANGLES else _QUATERNION, given),
        [given[frame] for frame in _FRAMES],
    )


def _option_values(defaults: dict[str, float], given: dict[str, str]) -> list[float]:
    return [
        as_number(given[field], field) if field in given else default
        for field, default in defaults.items()
    ]


def _parse_positional(words: Sequence[str]) -> Transform:
    count = len(words)
    if count not in {8, 9, 10}:
        raise malformed_error(
            "arguments",
            "x y z, qx qy qz qw or yaw pitch roll, frame, child, and perhaps a period",
            f"{count} words",
        )
    has_angles = count == 8
    # nine words have a quaternion, or angles and a period; the frames' names show which
    if count == 9:
        has_angles = not _is_number(words[6])
        if has_angles != _is_number(words[8]):
            raise malformed_error(
                "arguments",
                "a quaternion and two frames, or three angles, two frames and a period",
                " ".join(words[6:]),
            )
    pose_length = 6 if has_angles else 7
    for period in words[pose_length + 2 :]:
        as_number(period, "period")
    values = [
        as_number(word, f"argument {index + 1}") for index, word in enumerate(words[:pose_length])
    ]
    return _make_transform(values[:3], values[3:], words[pose_length : pose_length + 2])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _make_transform(
    position: Sequence[float], rotation: Sequence[float], frames: Sequence[str]
) -> Transform:
    frame, child = (frame_name(frame, "frame") for frame in frames)
    if len(rotation) == 4:
        return Transform.from_quaternion(frame, child, position, rotation)
    check_angles(rotation, "yaw, pitch and roll")
    return Transform(frame, child, rotation_zyx(*rotation), np.array(position))


def compose_positional(transform: Transform, *, angles: bool = False, period: bool = False) -> str:
    """Return the command line of ``tf``'s program (with a period) or ``tf2_ros``' (without).

    ``angles``: yaw, pitch and roll instead of a quaternion. ``period``: whether :data:`PERIOD_MS`
    follows at the end.
    """
    frames = frame_name(transform.target, "target"), frame_name(transform.source, "source")
    values = pose_numbers(transform)
    if angles:
        values = [*values[:3], *angles_zyx(transform.rotation)]
    words = [*map(repr, values), *frames, *([str(PERIOD_MS)] if period else [])]
    return f"{_COMMAND} {' '.join(words)}\n"


def compose_options(transform: Transform, *, angles: bool = False) -> str:
    """Return the arguments of ROS 2's program, one line.

    ``angles``: as for :func:`compose_positional`.
    """
    values = dict(zip([*_POSITION, *_QUATERNION], pose_numbers(transform), strict=True))
    if angles:
        angle_values = zip(_ANGLES, angles_zyx(transform.rotation), strict=True)
        values = dict([*list(values.items())[:3], *angle_values])
    words = [f"{option} {value!r}" for option, value in values.items()]
    frames = frame_name(transform.target, "target"), frame_name(transform.source, "source")
    words += [f"{option} {name}" for option, name in zip(_FRAMES, frames, strict=True)]
    return f"{_COMMAND} {' '.join(words)}\n"


def parse_pose(text: str, target: str, source: str) -> Transform:
    """Return the pose of a ROS-Industrial file: ``x y z qx qy qz qw``, perhaps under a name.

    The file has no names of frames: the pose is ``source``'s pose in ``target``.
    """
    data = as_mapping(load_yaml(text), "file")
    where = "pose"
    if not data.keys() & set(POSE):
        if len(data) != 1:
            raise malformed_error("file", "one pose", ", ".join(data) or "none")
        ((where, data),) = data.items()
    pose = numbers_by_key(data, where, POSE)
    return transform_of_pose(target, source, pose)


def compose_pose(transform: Transform) -> str:
    """Return a pose in ROS-Industrial's form, which has no place for the frames' names."""
    return block_mapping(dict(zip(POSE, pose_numbers(transform), strict=True)))
