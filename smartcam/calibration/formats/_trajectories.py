"""Read and write poses over time as CSV, with the columns of ASL's tools or of EuRoC's data sets.

The header names the columns, and so tells the order of the quaternion and the unit of time. EuRoC
has nanoseconds and the real part first; other files have seconds and the real part last. A file
without a header is refused, since the rows of all these files are eight numbers.

Source: github.com/ethz-asl/hand_eye_calibration (published) for ``t, x, y, z, qx, qy, qz, qw``; the
files ``state_groundtruth_estimate0/data.csv`` and ``vicon0/data.csv`` of EuRoC MAV (published).
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import TYPE_CHECKING, NamedTuple

from smartcam.calibration.formats._file_format import UnscaledValue
from smartcam.calibration.formats._plain import POSE, as_number, malformed_error, pose_numbers
from smartcam.calibration.formats._samples import check_same_frames
from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_LINE_LENGTH = 4096
"""Largest number of characters of a line; EuRoC's lines have some 200."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MAX_TIME = Decimal(253_402_300_799)  # end of the year 9999
_COLUMN = re.compile(r"\s*([A-Za-z_]+)\s*(?:\[([^\]]*)\])?\s*")
_TIME = re.compile(r"[0-9]{1,21}(?:\.[0-9]{0,20})?(?:[eE][-+]?[0-9]{1,2})?")


class _Columns(NamedTuple):
    """The columns that a header names."""

    indices: tuple[int, ...]  # indices of the columns of time, then of x, y, z, qx, qy, qz, qw
    width: int  # number of columns
    time_unit: Decimal  # seconds
    length_unit: str | None  # None: the header names no unit


_COLUMNS = (
    (("timestamp", *(f"p_rs_r_{a}" for a in "xyz"), *(f"q_rs_{a}" for a in "xyzw")), "ns"),
    (("t", *POSE), "s"),
    (("t", "x", "y", "z", *(f"q_{a}" for a in "xyzw")), "s"),
    (("t", *(f"p_{a}" for a in "xyz"), *(f"q_{a}" for a in "xyzw")), "s"),
    (("timestamp", *POSE), ""),
    (("time", *POSE), ""),
)
"""For each kind of header: the names, in lower case, of the columns of time and of the pose, and
the unit of time if the header names none, as in EuRoC's ground truth. If this unit is empty, the
header must name one."""
_SECONDS: Mapping[str, Decimal] = {
    "s": Decimal(1),
    "ms": Decimal("1e-3"),
    "us": Decimal("1e-6"),
    "ns": Decimal("1e-9"),
}
_ASL_HEAD = "#t [s],x [m],y [m],z [m],qx [],qy [],qz [],qw []\n"
_EUROC_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
)


def parse_csv(
    text: str, target: str, source: str
) -> Sequence[Transform] | UnscaledValue[Sequence[Transform]]:
    """Return the poses of a file with a header, in the file's order; other columns are ignored.

    Lines that begin with ``#`` are comments; one of them may be the header. The poses are poses of
    ``source`` in ``target``; their times are rounded to the nearest microsecond. Raises
    ``MALFORMED`` if there is no known header, or if a row has another length; ``NOT_FINITE``,
    ``NOT_RIGID``; ``BAD_TIME`` for a time outside of 1970 to 9999.
    """
    header: _Columns | None = None
    poses: list[Transform] = []
    for index, line in enumerate(map(str.strip, text.splitlines()), 1):
        if len(line) > MAX_LINE_LENGTH:
            raise malformed_error(
                f"line {index}", f"{MAX_LINE_LENGTH} characters at most", len(line)
            )
        if not line or (header is not None and line.startswith("#")):
            continue
        if header is not None:
            poses.append(_parse_pose(line, header, f"line {index}", target, source))
            continue
        header = _parse_header(line)
        if header is None and not line.startswith("#"):
            raise _no_header_error(line)
    if header is None:
        raise _no_header_error("")
    return poses if header.length_unit is None else UnscaledValue(poses, header.length_unit)


def _no_header_error(line: str) -> CalibrationError:
    expected = f"{_ASL_HEAD.strip()} or {_EUROC_HEAD.strip()}"
    return malformed_error("header", f"{expected}, with the unit of time in brackets", line)


def _parse_header(line: str) -> _Columns | None:
    cells = line.lstrip(" #").rstrip(" ,").split(",")
    matches = [_COLUMN.fullmatch(cell) for cell in cells]
    names = [match[1].lower() if match else "" for match in matches]
    units = [match[2] if match else None for match in matches]
    for columns, unit in _COLUMNS:
        if all(names.count(name) == 1 for name in columns):
            indices = tuple(names.index(name) for name in columns)
            seconds = _SECONDS.get(units[indices[0]] or unit)
            if seconds is not None:
                units_found = {units[index] for index in indices[1:4]}
                if len(units_found) > 1:
                    raise malformed_error("header", "one unit of x, y and z", line)
                return _Columns(indices, len(cells), seconds, units_found.pop() or None)
    return None


def _parse_pose(line: str, header: _Columns, where: str, target: str, source: str) -> Transform:
    cells = line.rstrip(" ,").split(",")
    if len(cells) != header.width:
        raise malformed_error(where, f"{header.width} columns as in the header", f"{len(cells)}")
    time, *pose = (cells[index].strip() for index in header.indices)
    values = [as_number(cell, where) for cell in pose]
    at = _EPOCH + timedelta(microseconds=_microseconds(time, header.time_unit, where))
    try:
        return Transform.from_quaternion(target, source, values[:3], values[3:], at)
    except CalibrationError as exc:
        raise CalibrationError(
            f"{where}: {exc}", code=exc.code, expected=exc.expected, got=exc.got
        ) from exc


def _microseconds(text: str, unit: Decimal, where: str) -> int:
    seconds = Decimal(text) * unit if _TIME.fullmatch(text) else None
    if seconds is None or not seconds <= _MAX_TIME:
        raise Code.BAD_TIME.error(
            f"{where}: expected a time since 1970, before the year 10000, got {text[:64]!r}",
            got=text,
        )
    return int((seconds * 1_000_000).to_integral_value())


def compose_asl(transforms: Sequence[Transform]) -> str:
    """Return poses as ``t, x, y, z, qx, qy, qz, qw``, seconds since 1970 and metres.

    Raises ``WRONG_FRAME`` unless all are between the same frames; ``BAD_TIME`` for a pose without a
    time, or before 1970.
    """
    return _ASL_HEAD + "".join(
        f"{time // 1_000_000}.{time % 1_000_000:06d},"
        f"{','.join(map(repr, pose_numbers(transform)))}\n"
        for time, transform in _with_times(transforms)
    )


def compose_euroc(transforms: Sequence[Transform]) -> str:
    """Return poses in EuRoC's columns: nanoseconds, the real part first."""
    rows = [(time, *pose_numbers(transform)) for time, transform in _with_times(transforms)]
    return _EUROC_HEAD + "".join(
        f"{time}000,{x!r},{y!r},{z!r},{qw!r},{qx!r},{qy!r},{qz!r}\n"
        for time, x, y, z, qx, qy, qz, qw in rows
    )


def _with_times(transforms: Sequence[Transform]) -> list[tuple[int, Transform]]:
    check_same_frames(transforms, "pose {}")
    timed: list[tuple[int, Transform]] = []
    for index, transform in enumerate(transforms):
        if transform.at is None or transform.at < _EPOCH:
            raise Code.BAD_TIME.error_with_value(
                f"pose {index}: expected a time since 1970", got=transform.at
            )
        timed.append(((transform.at - _EPOCH) // timedelta(microseconds=1), transform))
    return timed
