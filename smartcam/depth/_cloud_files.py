"""Read and write clouds as PLY or PCD files, chosen by the suffix."""

from __future__ import annotations

import os
import re
import stat
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._argument_checks import check_arguments, of_class, or_none
from smartcam._arguments import check_flag, check_path, check_text, excerpt
from smartcam._whole_files import replace_file
from smartcam.calibration._inside import METRES_PER_UNIT
from smartcam.depth import _pcd, _ply
from smartcam.depth._cloud import Cloud
from smartcam.depth._tables import BadFileError
from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from smartcam.calibration._inside import LengthUnit

MAX_FILE_BYTES: Final = 1 << 30
"""Largest size of a file that is read, bytes."""

MAX_HEAD_BYTES: Final = 1 << 12
"""Number of bytes at a file's beginning that are searched for the unit's comment."""

UNIT_COMMENT: Final = re.compile(rb"^(?:comment|#) unit (m|cm|mm|inch)\r?$", re.MULTILINE)
"""Comment in which :func:`save_cloud` writes the unit."""

COLOUR_NAMES: Final = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
"""Names that programs give the columns of red, green and blue."""

MAX_ROUNDING_METRES: Final = 1e-3
"""Largest error, metres, of rounding a coordinate from double to float32."""


class _CloudFormat(NamedTuple):
    read: Callable[[bytes], Mapping[str, NDArray[Any]]]  # columns by their names
    write: Callable[[Cloud, bool], bytes]  # the flag is true for text


FORMATS: Final = {
    ".ply": _CloudFormat(_ply.read, _ply.write),
    ".pcd": _CloudFormat(_pcd.read, _pcd.write),
}
"""File formats by suffix, in lower case."""


@check_arguments(unit=or_none(check_text))
def load_cloud(path: str | os.PathLike[str], *, unit: LengthUnit | None = None) -> Cloud:
    """Return the cloud of a ``.ply`` or a ``.pcd`` file, up to 1 GiB.

    Neither format has a unit of length, and programs write metres or millimetres. Files of
    :func:`save_cloud` name the unit in a comment. For any other file give ``unit``: ``m``, ``cm``,
    ``mm`` or ``inch``.

    PLY files may be text, or bytes in either order; PCD files may be text, bytes, or compressed.
    Points with a coordinate that is not finite, as in organised files, are left out. Colours are
    ``red``, ``green``, ``blue``, or ``diffuse_red`` and so on, or ``r``, ``g``, ``b``, or PCL's
    ``rgb``: bytes, 16 bits, other numbers of 0 to 255, or of 0 to 1. ``sigma`` is in the same unit.
    Other properties are skipped, as is a PCD file's viewpoint. Large files take seconds: read them
    in a thread, not in a coroutine.

    Raises:
        ConfigurationError: the suffix or the unit is unknown.
        FrameSourceError: the file cannot be read.
        FrameFormatError: the unit is not given, the file is no cloud or has no x, y and z, or its
            coordinates are so large that float32 would round them by a millimetre.
    """
    path = check_path(path, "path", "cloud")
    cloud_format = _find_format(path)
    if unit is not None and unit not in METRES_PER_UNIT:
        raise ConfigurationError(
            f"unit: expected one of {', '.join(METRES_PER_UNIT)}, got {excerpt(unit)}"
        )
    try:
        with path.open("rb") as stream:
            # read() allocates as many bytes as it is asked for, so the size is checked before
            status = os.fstat(stream.fileno())
            is_readable_whole = stat.S_ISREG(status.st_mode) and status.st_size <= MAX_FILE_BYTES
            data = stream.read(status.st_size if is_readable_whole else MAX_FILE_BYTES + 1)
    except OSError as exc:
        reason = exc.strerror or exc
        raise FrameSourceError(f"{path}: cannot be read: {reason}", source=str(path)) from exc
    try:
        if len(data) > MAX_FILE_BYTES:
            raise BadFileError(f"a file of {MAX_FILE_BYTES:,} bytes at most", actual="a larger one")
        return _make_cloud(cloud_format.read(data), METRES_PER_UNIT[unit or _read_unit(data)])
    except BadFileError as exc:
        raise FrameFormatError(f"{path}: {exc}", source=str(path)) from exc


def _read_unit(data: bytes) -> str:
    """Return the unit from the header's comment; raise BadFileError if it is missing."""
    match = UNIT_COMMENT.search(data[:MAX_HEAD_BYTES])
    if match is None:
        raise BadFileError(
            'a unit, which neither the file nor its format says: give unit="m" or unit="mm", or '
            "--unit on the command line",
            actual="none",
        )
    return match[1].decode()


@check_arguments(cloud=of_class("Cloud"), text=check_flag)
def save_cloud(path: str | os.PathLike[str], cloud: Cloud, *, text: bool = False) -> None:
    """Write a cloud as ``.ply`` or ``.pcd``, in bytes (little endian) or as text.

    An existing file is replaced only after the new one is complete.

    Raises:
        ConfigurationError: the suffix is unknown, or the file cannot be written.
    """
    path = check_path(path, "path", "cloud")
    data = _find_format(path).write(cloud, text)
    try:
        replace_file(path, data)
    except OSError as exc:
        raise ConfigurationError(f"{path}: cannot be written: {exc.strerror or exc}") from exc


def _find_format(path: Path) -> _CloudFormat:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise ConfigurationError(
            f"{path}: expected a name that ends in {' or '.join(FORMATS)}"
        ) from None


def _make_cloud(columns: Mapping[str, NDArray[Any]], unit_metres: float) -> Cloud:
    """Return the cloud of a file's columns; raise BadFileError if the columns are not valid.

    ``unit_metres``: metres of the file's unit.
    """
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise BadFileError("x, y and z", f"no {', '.join(missing)}, but {', '.join(columns)}")
    coordinates = [columns[name] for name in "xyz"]
    valid = np.isfinite(coordinates[0])
    for column in coordinates[1:]:
        valid = valid & np.isfinite(column)
    points = np.empty((int(valid.sum()), 3), np.float32)
    for axis, column in enumerate(coordinates):
        values = column[valid] if unit_metres == 1.0 else column[valid] * unit_metres
        with np.errstate(over="ignore"):
            points[:, axis] = values
        if values.dtype == np.float64 and values.size and _rounds_too_much(values, points[:, axis]):
            raise BadFileError(
                "coordinates that float32 keeps to a millimetre",
                f"{'xyz'[axis]} up to {np.abs(values).max():g} m: move the origin",
            )
    try:
        sigma = _find_sigma(columns, valid)
        scaled = (
            sigma
            if sigma is None or unit_metres == 1.0
            else (unit_metres * sigma).astype(sigma.dtype)
        )
        return Cloud(points, _find_colours(columns, valid), scaled)
    except ConfigurationError as exc:
        raise BadFileError("a cloud", str(exc)) from exc


def _rounds_too_much(exact: NDArray[Any], stored: NDArray[Any]) -> bool:
    with np.errstate(invalid="ignore"):
        return not float(np.abs(exact - stored.astype(np.float64)).max()) <= MAX_ROUNDING_METRES


def _find_colours(
    columns: Mapping[str, NDArray[Any]], valid: NDArray[np.bool_]
) -> NDArray[np.uint8] | None:
    names = next(
        (form for form in COLOUR_NAMES if all(name in columns for name in form)),
        None,
    )
    if names is None:
        return None
    colours: NDArray[Any] = np.stack([columns[name][valid] for name in names], axis=1)
    if colours.dtype == np.uint8 or not colours.size:
        return colours.astype(np.uint8)
    least, most = float(colours.min()), float(colours.max())
    if colours.dtype == np.uint16:
        scale = 1 / 257  # 65535 is 255
    elif colours.dtype.kind == "f" and least >= 0 and most <= 1:
        scale = 255.0
    elif colours.dtype.itemsize > 1 and least >= 0 and most <= 255:
        scale = 1.0
    else:
        raise BadFileError(
            "colours of 0 to 1, of 0 to 255 or of 16 bits",
            f"{colours.dtype} of {least:g} to {most:g}",
        )
    levels: NDArray[np.uint8] = np.rint(colours * scale).astype(np.uint8)
    return levels


def _find_sigma(
    columns: Mapping[str, NDArray[Any]], valid: NDArray[np.bool_]
) -> NDArray[np.float32] | None:
    if "sigma" not in columns:
        return None
    with np.errstate(over="ignore"):
        return columns["sigma"][valid].astype(np.float32)
