"""Formats of other programs: transforms, samples of a hand-eye calibration, poses over time.

::

    write_transform("camera.txt", "ros2", plane_frame(calibration).transform)
    camera = read_transform("handeye.calib", "easy_handeye2")
    pose = pose_from("kuka", [400, 120, 35.5, 90, 0, 180])

:data:`TRANSFORMS`, :data:`SAMPLES` and :data:`TRAJECTORIES` are the tables of them. Everything that
is read is bad input until it has been checked: size, depth, every number and every rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from smartcam.calibration.codes import Code
from smartcam.calibration.files.store import replace_file
from smartcam.calibration.formats import handeye, opencv, ros, samples, trajectories
from smartcam.calibration.formats.opencv import PlaneMatrix
from smartcam.calibration.formats.plain import frame_name, malformed
from smartcam.calibration.formats.planes import PlaneFrame, plane_frame
from smartcam.calibration.formats.robots import ROBOTS, Robot, pose_from, pose_to
from smartcam.calibration.formats.samples import Sample
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.calibration.geometry.frames import Transform
    from smartcam.calibration.plane.calibration import PlaneCalibration

__all__ = [
    "MAX_FILE",
    "MAX_TEXT",
    "MAX_YAML",
    "ROBOTS",
    "SAMPLES",
    "TRAJECTORIES",
    "TRANSFORMS",
    "Format",
    "PlaneFrame",
    "PlaneMatrix",
    "Robot",
    "Sample",
    "compose",
    "plane_frame",
    "pose_from",
    "pose_to",
    "read_matrix",
    "read_samples",
    "read_trajectory",
    "read_transform",
    "write_samples",
    "write_trajectory",
    "write_transform",
]

MAX_TEXT = 1 << 16
"""Bytes at most of a file with one pose, which has some hundred."""

MAX_YAML = 1 << 18
"""Bytes at most of a YAML file with samples: some 400 of them. PyYAML may take seconds for it."""

MAX_FILE = 1 << 24
"""Bytes at most of a JSON or CSV file: a ground truth of EuRoC has 6 MB."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Format(Generic[T]):
    """One format.

    Attributes:
        title: what it is.
        suffix: what its files' names end in.
        parse: makes a value of a text and the names of target and source, which formats without
            names of frames use.
        compose: makes a text of a value, without ``head``.
        head: what the file begins with.
        most: bytes of a file at most.
    """

    title: str
    suffix: str
    parse: Callable[[str, str, str], T]
    compose: Callable[[T], str]
    head: str = ""
    most: int = MAX_TEXT


def _named(parse: Callable[[str], T]) -> Callable[[str, str, str], T]:
    """Return a parser for a format that names its frames, or has none to name."""
    return lambda text, _target, _source: parse(text)


TRANSFORMS: Mapping[str, Format[Transform]] = {
    "tf": Format(
        title="arguments of ROS 1, tf: quaternion, period",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=partial(ros.compose_positions, period=True),
    ),
    "tf_ypr": Format(
        title="the same with yaw, pitch and roll",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=partial(ros.compose_positions, angles=True, period=True),
    ),
    "tf2": Format(
        title="arguments of ROS 1, tf2_ros: quaternion",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=ros.compose_positions,
    ),
    "tf2_ypr": Format(
        title="the same with yaw, pitch and roll",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=partial(ros.compose_positions, angles=True),
    ),
    "ros2": Format(
        title="arguments of ROS 2, tf2_ros: quaternion",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=ros.compose_options,
    ),
    "ros2_ypr": Format(
        title="the same with yaw, pitch and roll",
        suffix=".txt",
        parse=_named(ros.parse_arguments),
        compose=partial(ros.compose_options, angles=True),
    ),
    "ros_industrial": Format(
        title="pose of ROS-Industrial's calibration, without names of frames",
        suffix=".yaml",
        parse=ros.parse_pose,
        compose=ros.compose_pose,
    ),
    "easy_handeye": Format(
        title="easy_handeye, ROS 1: a camera that stands",
        suffix=".yaml",
        parse=_named(handeye.parse_easy_handeye),
        compose=handeye.compose_easy_handeye,
    ),
    "easy_handeye_in_hand": Format(
        title="easy_handeye, ROS 1: a camera that the robot carries",
        suffix=".yaml",
        parse=_named(handeye.parse_easy_handeye),
        compose=partial(handeye.compose_easy_handeye, in_hand=True),
    ),
    "easy_handeye2": Format(
        title="easy_handeye2, ROS 2: a camera that stands",
        suffix=".calib",
        parse=_named(handeye.parse_easy_handeye2),
        compose=handeye.compose_easy_handeye2,
    ),
    "easy_handeye2_in_hand": Format(
        title="easy_handeye2, ROS 2: a camera that the robot carries",
        suffix=".calib",
        parse=_named(handeye.parse_easy_handeye2),
        compose=partial(handeye.compose_easy_handeye2, in_hand=True),
    ),
    "opencv": Format(
        title="matrix (4, 4) of cv2.FileStorage",
        suffix=".yaml",
        parse=opencv.parse_transform,
        compose=opencv.compose_transform,
        head=opencv.HEAD,
    ),
}
"""Formats of one transform. Those that differ in what they write alone read all the same."""

SAMPLES: Mapping[str, Format[Sequence[Sample]]] = {
    "moveit": Format(
        title="samples of MoveIt's hand-eye solver, JSON",
        suffix=".json",
        parse=_named(samples.parse_json),
        compose=samples.compose_json,
        most=MAX_FILE,
    ),
    "moveit_yaml": Format(
        title="samples of MoveIt's hand-eye panel, YAML",
        suffix=".yaml",
        parse=_named(samples.parse_yaml),
        compose=samples.compose_yaml,
        most=MAX_YAML,
    ),
}
"""Formats of samples of a hand-eye calibration; none has names of frames."""

TRAJECTORIES: Mapping[str, Format[Sequence[Transform]]] = {
    "asl": Format(
        title="t, x, y, z, qx, qy, qz, qw; seconds",
        suffix=".csv",
        parse=trajectories.parse_csv,
        compose=trajectories.compose_asl,
        most=MAX_FILE,
    ),
    "euroc": Format(
        title="EuRoC: nanoseconds, the quaternion's real part first",
        suffix=".csv",
        parse=trajectories.parse_csv,
        compose=trajectories.compose_euroc,
        most=MAX_FILE,
    ),
}
"""Formats of poses over time; either reads both, and the file's header decides."""

_MATRIX: Format[PlaneMatrix] = Format(
    title="matrix of a plane calibration",
    suffix=".yaml",
    parse=_named(opencv.parse_matrix),
    compose=opencv.compose_matrix,
)


# ---------------------------------------------------------------------- one for each kind of value


def read_transform(
    path: str | os.PathLike[str], form: str, *, target: str = "robot", source: str = "camera"
) -> Transform:
    """Read a transform.

    Args:
        path: the file.
        form: its format, a key of :data:`TRANSFORMS`.
        target: the frame that it leads to, for a format that does not name it.
        source: the frame that it comes from, likewise.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``MALFORMED``: the file is not what the format says,
            or too large; ``NOT_FINITE``, ``NOT_RIGID``, ``BAD_NAME``: what it says is no pose.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    return _read(path, _known(TRANSFORMS, form), target, source)


def write_transform(path: str | os.PathLike[str], form: str, transform: Transform) -> None:
    """Write a transform; the file is whole, or what was there before.

    Args:
        path: the file.
        form: its format, a key of :data:`TRANSFORMS`.
        transform: ``source`` is the child, ``target`` its parent; a time is not written.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``BAD_NAME``: a frame's name that the format cannot
            hold;
            ``NOT_WRITTEN``: it cannot be written.
    """
    _write(path, _known(TRANSFORMS, form), transform)


def read_samples(path: str | os.PathLike[str], form: str) -> Sequence[Sample]:
    """Read the samples of a hand-eye calibration, a key of :data:`SAMPLES`.

    Their frames are called base, effector, camera and object. Errors are those of
    :func:`read_transform`.
    """
    return _read(path, _known(SAMPLES, form), "", "")


def write_samples(path: str | os.PathLike[str], form: str, values: Sequence[Sample]) -> None:
    """Write samples; the file is whole, or what was there before.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``; ``WRONG_FRAME``: they are not all between the same
            frames, whose names the file cannot tell;
            ``NOT_WRITTEN``: it cannot be written.
    """
    _write(path, _known(SAMPLES, form), values)


def read_trajectory(
    path: str | os.PathLike[str], form: str, *, target: str = "world", source: str = "body"
) -> Sequence[Transform]:
    """Read poses over time, a key of :data:`TRAJECTORIES`, in the order of the file.

    Times come to the nearest microsecond. Arguments and errors are those of
    :func:`read_transform`, and ``BAD_TIME``.
    """
    return _read(path, _known(TRAJECTORIES, form), target, source)


def write_trajectory(path: str | os.PathLike[str], form: str, values: Sequence[Transform]) -> None:
    """Write poses over time; the file is whole, or what was there before.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``, ``WRONG_FRAME``; ``BAD_TIME``: one has none;
            ``NOT_WRITTEN``: it cannot be written.
    """
    _write(path, _known(TRAJECTORIES, form), values)


def read_matrix(path: str | os.PathLike[str]) -> PlaneMatrix:
    """Read the matrix of a plane calibration that was exported as ``.yaml``.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``; ``COLLINEAR``: it maps to a line.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    return _read(path, _MATRIX, "", "")


def compose(form: str, calibration: PlaneCalibration, *, suffix: str | None = None) -> str:
    """Return the file of a plane calibration's frame, its scale in a comment.

    Args:
        form: its format, a key of :data:`TRANSFORMS`.
        calibration: one that has a frame: see :func:`plane_frame`.
        suffix: what the file's name ends in; None for whatever.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``, ``NOT_SIMILAR``; ``BAD_NAME``: a frame's name that
            the format cannot hold, or another suffix than the format's.
    """
    known = _known(TRANSFORMS, form)
    if suffix not in {None, known.suffix}:
        raise CalibrationError(
            f"format {form}: expected a name that ends in {known.suffix}, got {suffix}",
            code=Code.BAD_NAME,
            expected=known.suffix,
            got=suffix,
        )
    transform, scale = plane_frame(calibration)
    for name in (transform.target, transform.source):
        frame_name(name, "frame")  # it stands in the comment whatever the format holds
    said = (
        f"# multiply coordinates of {transform.source} by {scale!r} to have metres, then apply "
        f"{transform.label}\n"
    )
    return known.head + said + known.compose(transform)


def _known(table: Mapping[str, Format[T]], form: str) -> Format[T]:
    if form not in table:
        raise CalibrationError(
            f"no format is called {form!r}; expected one of {', '.join(table)}",
            code=Code.UNKNOWN_FORMAT,
            expected=list(table),
            got=form,
        )
    return table[form]


def _read(path: str | os.PathLike[str], form: Format[T], target: str, source: str) -> T:
    with Path(path).open("rb") as stream:
        body = stream.read(form.most + 1)
    try:
        if len(body) > form.most:
            raise malformed("file", f"{form.most} bytes at most")
        try:
            text = body.decode("utf-8-sig")
        except UnicodeDecodeError as exc:
            raise malformed("file", f"UTF-8 ({exc.reason} at byte {exc.start})") from exc
        return form.parse(text, target, source)
    except CalibrationError as exc:
        raise CalibrationError(
            f"{path}: {form.title}: {exc}", code=exc.code, expected=exc.expected, got=exc.got
        ) from exc


def _write(path: str | os.PathLike[str], form: Format[T], value: T) -> None:
    replace_file(Path(path), (form.head + form.compose(value)).encode())
