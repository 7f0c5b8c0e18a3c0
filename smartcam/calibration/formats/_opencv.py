"""Read and write a plane's matrix, or a transform, as YAML for ``cv2.FileStorage`` and PyYAML.

Source: OpenCV, ``modules/core/src/persistence_yml.cpp`` (published): the first line begins with
``%YAML``; a number with a point is a real one; ``!!opencv-matrix`` has rows, cols, dt and data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration.formats._file_format import UnscaledValue
from smartcam.calibration.formats._plain import (
    Plain,
    as_mapping,
    flow_list,
    format_real,
    frame_name,
    load_yaml,
    malformed_error,
    matrix_rows,
    quote,
    rigid_transform,
    stored_matrix,
)
from smartcam.calibration.formats._xml import load_xml, storage_data
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

HEAD = "%YAML:1.0\n---\n"
"""Beginning of OpenCV's files; OpenCV's readers need ``%YAML`` there."""


def load_storage(text: str) -> Plain:
    """Return the data of a file of ``cv2.FileStorage``, YAML or XML."""
    if not text.lstrip().startswith("<"):
        return load_yaml(text)
    root = load_xml(text.strip())
    if root.tag != "opencv_storage":
        raise malformed_error("file", "<opencv_storage>", f"<{root.tag}>")
    return storage_data(root)


class PlaneMatrix(NamedTuple):
    """The part of a plane calibration that other programs need.

    Attributes:
        matrix: (4, 3) with ``w (x, y, z, 1) = matrix (u, v, 1)``, metres. A
            :class:`~smartcam.calibration.PlaneProjection` with this matrix maps poses.
        model: name of the model that was fitted.
        robot_frame: frame of x, y and z.
        camera_frame: frame of u and v; empty if none was given.
    """

    matrix: Array
    model: str
    robot_frame: str
    camera_frame: str

    @classmethod
    def of(cls, calibration: PlaneCalibration) -> PlaneMatrix:
        """Return the matrix of any plane calibration."""
        return cls(
            calibration.matrix,
            calibration.model,
            calibration.robot_frame,
            calibration.camera_frame or "",
        )


def compose_matrix(plane: PlaneMatrix, unit: str = "unknown unit") -> str:
    """Return the matrix of a plane calibration, in YAML for OpenCV's and PyYAML's readers.

    ``unit``: unit of the camera's coordinates u and v, as a text.
    """
    rows = plane.matrix.tolist()
    values = ",\n    ".join(", ".join(format_real(value) for value in row) for row in rows)
    formula = f"w (x, y, z, 1) = matrix (u, v, 1), metres; u and v: {unit}"
    return (
        "%YAML 1.1\n---\n"
        f"about: {quote(formula)}\n"
        f"model: {quote(plane.model)}\n"
        f"robot_frame: {quote(plane.robot_frame)}\n"
        f"camera_frame: {quote(plane.camera_frame)}\n"
        f"rows: {len(rows)}\ncols: {len(rows[0])}\n"
        f"data: [\n    {values} ]\n"
    )


def parse_matrix(text: str) -> PlaneMatrix:
    """Return the matrix of a calibration that :func:`compose_matrix` wrote, bit for bit."""
    names = ["model", "robot_frame", "camera_frame"]
    data = as_mapping(load_yaml(text), "file", [*names, "rows", "cols", "data"])
    for name in names:
        if not isinstance(data[name], str):
            raise malformed_error(name, "a text", data[name])
    matrix = stored_matrix(data, "matrix", (4, 3))
    if np.linalg.matrix_rank(matrix) < 3:
        raise Code.COLLINEAR.error_with_value("matrix: expected one of rank 3", got=matrix.tolist())
    return PlaneMatrix(matrix, *(data[name] for name in names))


def storage_matrix(name: str, matrix: Array) -> str:
    """Return the text of a named matrix, in the form of ``cv2.FileStorage``."""
    return (
        f"{name}: !!opencv-matrix\n   rows: {matrix.shape[0]}\n   cols: {matrix.shape[1]}\n"
        f"   dt: d\n   data: {flow_list(matrix.ravel())}\n"
    )


def compose_transform(transform: Transform) -> str:
    """Return the text of a transform, a (4, 4) ``!!opencv-matrix``, without :data:`HEAD`."""
    return (
        f"target: {quote(frame_name(transform.target, 'target'))}\n"
        f"source: {quote(frame_name(transform.source, 'source'))}\n"
        'unit: "m"\n' + storage_matrix("transform", np.array(matrix_rows(transform)))
    )


def parse_transform(text: str, target: str, source: str) -> UnscaledValue[Transform]:
    """Return the only (4, 4) matrix of a file of OpenCV, whatever its name.

    ``target`` and ``source`` are used as the frames' names if the file has no names.
    """
    data = as_mapping(load_storage(text), "file")
    names = [
        name
        for name, entry in data.items()
        if isinstance(entry, dict) and (entry.get("rows"), entry.get("cols")) == ("4", "4")
    ]
    if len(names) != 1:
        raise malformed_error("file", "one matrix of 4 rows and 4 cols", ", ".join(names) or "none")
    rows = stored_matrix(data[names[0]], names[0], (4, 4))
    frame_names = [
        frame_name(data.get(key, given), key)
        for key, given in (("target", target), ("source", source))
    ]
    return UnscaledValue(
        rigid_transform(frame_names[0], frame_names[1], rows, names[0]), data.get("unit")
    )
