"""Read and write other programs' transforms, samples of hand-eye calibrations, and poses over time.

``calibration/_files`` reads and writes smartcam's own files.

::

    write_transform("camera.txt", "ros2", plane_frame(calibration).transform)
    camera = read_transform("handeye.calib", "easy_handeye2")
    pose = pose_from("kuka", [400, 120, 35.5, 90, 0, 180])

``TRANSFORMS``, ``SAMPLES`` and ``TRAJECTORIES`` are the tables of formats; ``_cameras.py`` has the
table of cameras' formats, for :func:`read_cameras`. To add a format, add a row with a function
that parses and one that composes. Files are not trusted: their size and depth, every number and
every rotation are checked.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from smartcam.calibration.formats import _foreign as foreign
from smartcam.calibration.formats import _handeye as handeye
from smartcam.calibration.formats import _opencv as opencv
from smartcam.calibration.formats import _ros as ros
from smartcam.calibration.formats import _samples as samples
from smartcam.calibration.formats import _trajectories as trajectories
from smartcam.calibration.formats._cameras import (
    CameraChain,
    read_cameras,
    write_camera_info,
    write_cameras,
)
from smartcam.calibration.formats._file_format import (
    MAX_FILE_BYTES,
    MAX_YAML_BYTES,
    Format,
    ignore_names,
)
from smartcam.calibration.formats._plain import frame_name, look_up
from smartcam.calibration.formats._planes import plane_frame
from smartcam.calibration.formats._robots import pose_from, pose_to
from smartcam.calibration.formats._samples import HandEyeSample
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.calibration._units import LengthUnit
    from smartcam.calibration.formats._opencv import PlaneMatrix
    from smartcam.geometry import Transform

__all__ = [
    "CameraChain",
    "HandEyeSample",
    "plane_frame",
    "pose_from",
    "pose_to",
    "read_cameras",
    "read_matrix",
    "read_samples",
    "read_trajectory",
    "read_transform",
    "write_camera_info",
    "write_cameras",
    "write_samples",
    "write_trajectory",
    "write_transform",
]


def _arguments_format(
    title: str, compose: Callable[..., str], **options: bool
) -> Format[Transform]:
    """Return a format of command-line arguments; all these formats are read in the same way."""
    return Format(title, ".txt", ignore_names(ros.parse_arguments), partial(compose, **options))


def _handeye_formats(
    name: str,
    program: str,
    suffix: str,
    parse: Callable[[str], Transform],
    compose: Callable[..., str],
) -> dict[str, Format[Transform]]:
    """Return a program's two formats: one for a fixed camera, one for a camera on the robot."""
    compose_in_hand = partial(compose, in_hand=True)
    return {
        name: Format(f"{name}, {program}: a fixed camera", suffix, ignore_names(parse), compose),
        f"{name}_in_hand": Format(
            f"{name}, {program}: a camera that the robot carries",
            suffix,
            ignore_names(parse),
            compose_in_hand,
        ),
    }


TRANSFORMS: Mapping[str, Format[Transform]] = {
    "tf": _arguments_format(
        "arguments of ROS 1, tf: quaternion, period", ros.compose_positional, period=True
    ),
    "tf_ypr": _arguments_format(
        "arguments of ROS 1, tf: yaw, pitch and roll, period",
        ros.compose_positional,
        angles=True,
        period=True,
    ),
    "tf2": _arguments_format("arguments of ROS 1, tf2_ros: quaternion", ros.compose_positional),
    "tf2_ypr": _arguments_format(
        "arguments of ROS 1, tf2_ros: yaw, pitch and roll", ros.compose_positional, angles=True
    ),
    "ros2": _arguments_format("arguments of ROS 2, tf2_ros: quaternion", ros.compose_options),
    "ros2_ypr": _arguments_format(
        "arguments of ROS 2, tf2_ros: yaw, pitch and roll", ros.compose_options, angles=True
    ),
    "ros_industrial": Format(
        "pose of ROS-Industrial's calibration, without names of frames",
        ".yaml",
        ros.parse_pose,
        ros.compose_pose,
    ),
    **_handeye_formats(
        "easy_handeye", "ROS 1", ".yaml", handeye.parse_easy_handeye, handeye.compose_easy_handeye
    ),
    **_handeye_formats(
        "easy_handeye2",
        "ROS 2",
        ".calib",
        handeye.parse_easy_handeye2,
        handeye.compose_easy_handeye2,
    ),
    "opencv": Format(
        "matrix (4, 4) of cv2.FileStorage",
        ".yaml",
        opencv.parse_transform,
        opencv.compose_transform,
        head=opencv.HEAD,
    ),
    "matrix": Format("a bare matrix (4, 4): rows of numbers, or JSON", ".txt", foreign.parse_bare),
    "zivid": Format("Zivid's matrix (4, 4), millimetres", ".yaml", foreign.parse_zivid),
    "euroc_sensor": Format(
        "sensor.yaml of EuRoC: a sensor on its body", ".yaml", foreign.parse_sensor
    ),
    "urdf": Format("origin of a joint in a robot's description", ".urdf", ros.parse_urdf),
}
"""Formats of one transform. Formats that differ only in writing are read in the same way."""

SAMPLES: Mapping[str, Format[Sequence[HandEyeSample]]] = {
    "moveit": Format(
        "samples of MoveIt's hand-eye solver, JSON",
        ".json",
        ignore_names(samples.parse_json),
        samples.compose_json,
        max_bytes=MAX_FILE_BYTES,
    ),
    "moveit_yaml": Format(
        "samples of MoveIt's hand-eye panel, YAML",
        ".yaml",
        ignore_names(samples.parse_yaml),
        samples.compose_yaml,
        max_bytes=MAX_YAML_BYTES,
    ),
}
"""Formats of samples of a hand-eye calibration; their files do not name the frames."""

TRAJECTORIES: Mapping[str, Format[Sequence[Transform]]] = {
    "asl": Format(
        "t, x, y, z, qx, qy, qz, qw; seconds",
        ".csv",
        trajectories.parse_csv,
        trajectories.compose_asl,
        max_bytes=MAX_FILE_BYTES,
    ),
    "euroc": Format(
        "EuRoC: nanoseconds, the quaternion's real part first",
        ".csv",
        trajectories.parse_csv,
        trajectories.compose_euroc,
        max_bytes=MAX_FILE_BYTES,
    ),
}
"""Formats of poses over time; both are read in the same way: the file's header tells them apart."""

_MATRIX: Format[PlaneMatrix] = Format(
    "matrix of a plane calibration",
    ".yaml",
    ignore_names(opencv.parse_matrix),
    opencv.compose_matrix,
)


# ---------------------------------------------------------------------- readers and writers


def read_transform(
    path: str | os.PathLike[str],
    form: str,
    *,
    target: str = "robot",
    source: str = "camera",
    unit: LengthUnit | None = None,
) -> Transform:
    """Read a transform.

    Args:
        path: the file.
        form: name of the format, such as ``tf2``.
        target: the frame that the transform leads to, for a format that does not name it.
        source: the frame that the transform comes from, for a format that does not name it.
        unit: unit of the file's lengths; None for the unit that the file or its format names. A
            bare matrix and OpenCV's files name none.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``MALFORMED``: the file does not have the format, or
            is too large; ``UNIT_UNKNOWN``: nothing names the unit, or a distance of more than 20 m
            or an angle of more than a turn suggests another one; ``NOT_FINITE``, ``NOT_RIGID``,
            ``BAD_NAME``: its values are no pose.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    return look_up(TRANSFORMS, form).read(path, target, source, unit=unit)


def write_transform(path: str | os.PathLike[str], form: str, transform: Transform) -> None:
    """Write a transform; if this fails, the file stays as it was.

    Args:
        path: the file.
        form: name of the format, such as ``tf2``.
        transform: ``source`` is the child, ``target`` its parent; a time is not written.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``BAD_NAME``: a frame's name that the format cannot
            hold; ``NOT_WRITTEN``: the file cannot be written.
    """
    look_up(TRANSFORMS, form).write(path, transform)


def read_samples(
    path: str | os.PathLike[str], form: str, *, unit: LengthUnit | None = None
) -> Sequence[HandEyeSample]:
    """Read the samples of a hand-eye calibration; ``form`` is ``moveit`` or ``moveit_yaml``.

    Their frames are called base, effector, camera and object. Errors are those of
    :func:`read_transform`.
    """
    return look_up(SAMPLES, form).read(path, unit=unit)


def write_samples(path: str | os.PathLike[str], form: str, values: Sequence[HandEyeSample]) -> None:
    """Write samples; if this fails, the file stays as it was.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``WRONG_FRAME``: samples are between different frames,
            whose names the file cannot hold; ``NOT_WRITTEN``: the file cannot be written.
    """
    look_up(SAMPLES, form).write(path, values)


def read_trajectory(
    path: str | os.PathLike[str],
    form: str,
    *,
    target: str = "world",
    source: str = "body",
    unit: LengthUnit | None = None,
) -> Sequence[Transform]:
    """Read poses over time, in the order of the file; ``form`` is ``asl`` or ``euroc``.

    Times are rounded to the nearest microsecond. Arguments and errors are those of
    :func:`read_transform`, and ``BAD_TIME``.
    """
    return look_up(TRAJECTORIES, form).read(path, target, source, unit=unit)


def write_trajectory(path: str | os.PathLike[str], form: str, values: Sequence[Transform]) -> None:
    """Write poses over time; if this fails, the file stays as it was.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``, ``WRONG_FRAME``; ``BAD_TIME``: a pose has no time;
            ``NOT_WRITTEN``: the file cannot be written.
    """
    look_up(TRAJECTORIES, form).write(path, values)


def read_matrix(path: str | os.PathLike[str]) -> PlaneMatrix:
    """Read the matrix of a plane calibration that was exported as ``.yaml``.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``; ``COLLINEAR``: the matrix maps the plane to
            a line.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    return _MATRIX.read(path)


def compose_plane_frame(
    form: str, calibration: PlaneCalibration, *, suffix: str | None = None
) -> str:
    """Return the text of a file with a plane calibration's frame, and its scale in a comment.

    Args:
        form: name of the format, such as ``tf2``.
        calibration: calibration that has a frame, see :func:`plane_frame`.
        suffix: required suffix of the file's name; None for any.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``, ``NOT_SIMILAR``; ``BAD_NAME``: a frame's name that the
            format cannot hold, or ``suffix`` is not the format's.
    """
    file_format = look_up(TRANSFORMS, form)
    if suffix not in {None, file_format.suffix}:
        raise Code.BAD_NAME.error_with_value(
            f"format {form}: expected a name that ends in {file_format.suffix}",
            file_format.suffix,
            suffix,
        )
    transform, scale = plane_frame(calibration)
    for name in (transform.target, transform.source):
        frame_name(name, "frame")  # the comment must be able to hold this name
    comment = (
        f"# multiply coordinates of {transform.source} by {scale!r} to have metres, then apply "
        f"{transform.label}\n"
    )
    return file_format.head + comment + file_format.to_text(transform)
