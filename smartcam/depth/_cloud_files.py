"""Clouds as files: PLY and PCD, by the suffix."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.calibration._files.store import replace_file
from smartcam.depth import _pcd, _ply
from smartcam.depth._cloud import Cloud
from smartcam.depth._tables import BadTableError
from smartcam.exceptions import (
    CalibrationError,
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

MAX_BYTES: Final = 1 << 30
"""Of a file that is read."""

COARSE: Final = 1e-3
"""Metres that float32 may take from a coordinate that was written as a double."""


class _CloudFormat(NamedTuple):
    read: Callable[[bytes], Mapping[str, NDArray[Any]]]  # columns by their names
    write: Callable[[Cloud, bool], bytes]  # True: as text


FORMATS: Final = {
    ".ply": _CloudFormat(_ply.read, _ply.write),
    ".pcd": _CloudFormat(_pcd.read, _pcd.write),
}
"""By suffix, in lower case."""


def load_cloud(path: str | os.PathLike[str]) -> Cloud:
    """Return the cloud of a ``.ply`` or a ``.pcd`` file, up to 1 GiB.

    PLY is read as text and as bytes of either order, PCD as text, as bytes and compressed. Points
    with a coordinate that is not finite are no points, as in organised files, and are left out.
    Colours are ``red``, ``green``, ``blue`` or PCL's ``rgb``; ``sigma`` is metres. Properties of
    other names are skipped, and so is a PCD's viewpoint. It takes its time: beside an event loop
    it belongs into a thread.

    Raises:
        ConfigurationError: another suffix.
        FrameSourceError: it cannot be read.
        FrameFormatError: its bytes are no such file, or it has no x, y and z, or its coordinates
            are so large that float32 would take a millimetre from them.
    """
    path = Path(path)
    form = _format(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except OSError as exc:
        reason = exc.strerror or exc
        raise FrameSourceError(f"{path}: cannot be read: {reason}", source=str(path)) from exc
    try:
        if len(data) > MAX_BYTES:
            raise BadTableError(f"a file of {MAX_BYTES:,} bytes at most", "more")
        return _cloud(form.read(data))
    except BadTableError as exc:
        raise FrameFormatError(f"{path}: {exc}", source=str(path)) from exc


def save_cloud(path: str | os.PathLike[str], cloud: Cloud, *, text: bool = False) -> None:
    """Write a cloud as ``.ply`` or ``.pcd``, in bytes (little endian) or as text.

    The file is there as a whole or not at all: one that was there before stays until then.

    Raises:
        ConfigurationError: another suffix, or it cannot be written.
    """
    path = Path(path)
    data = _format(path).write(cloud, text)
    try:
        replace_file(path, data)
    except CalibrationError as exc:  # the text says which file, and why
        raise ConfigurationError(str(exc)) from exc


def _format(path: Path) -> _CloudFormat:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise ConfigurationError(
            f"{path}: expected a name that ends in {' or '.join(FORMATS)}"
        ) from None


def _cloud(columns: Mapping[str, NDArray[Any]]) -> Cloud:
    """Return a cloud of a file's columns; else BadTableError."""
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise BadTableError("x, y and z", f"no {', '.join(missing)}, but {', '.join(columns)}")
    coordinates = [columns[name] for name in "xyz"]
    there = np.isfinite(coordinates[0])
    for column in coordinates[1:]:
        there = there & np.isfinite(column)
    points = np.empty((int(there.sum()), 3), np.float32)
    for place, column in enumerate(coordinates):
        found = column[there]
        with np.errstate(over="ignore"):
            points[:, place] = found
        if found.dtype == np.float64 and found.size and _loses(found, points[:, place]):
            raise BadTableError(
                "coordinates that float32 keeps to a millimetre",
                f"{'xyz'[place]} up to {np.abs(found).max():g} m: move the origin",
            )
    try:
        return Cloud(points, _colours(columns, there), _sigma(columns, there))
    except ConfigurationError as exc:
        raise BadTableError("a cloud", str(exc)) from exc


def _loses(exact: NDArray[Any], kept: NDArray[Any]) -> bool:
    with np.errstate(invalid="ignore"):
        return not float(np.abs(exact - kept.astype(np.float64)).max()) <= COARSE


def _colours(
    columns: Mapping[str, NDArray[Any]], there: NDArray[np.bool_]
) -> NDArray[np.uint8] | None:
    if not all(name in columns for name in ("red", "green", "blue")):
        return None
    found: NDArray[Any] = np.stack(
        [columns[name][there] for name in ("red", "green", "blue")], axis=1
    )
    if found.dtype.kind == "f":  # 0 to 1
        if found.size and not (found.min() >= 0 and found.max() <= 1):
            raise BadTableError(
                "colours of 0 to 1, or of 8 bits", f"{found.min()} to {found.max()}"
            )
        levels: NDArray[np.uint8] = np.rint(found * 255).astype(np.uint8)
        return levels
    if found.dtype != np.uint8:
        raise BadTableError("colours of 0 to 1, or of 8 bits", f"{found.dtype}")
    return np.asarray(found, np.uint8)


def _sigma(
    columns: Mapping[str, NDArray[Any]], there: NDArray[np.bool_]
) -> NDArray[np.float32] | None:
    if "sigma" not in columns:
        return None
    with np.errstate(over="ignore"):
        return columns["sigma"][there].astype(np.float32)
