"""Read lenses from other programs' files that smartcam does not write.

Each function returns lenses as :class:`ForeignLens`, and transforms; ``_cameras.py`` makes cameras
of them. The centre of the upper left pixel is at (0, 0). COLMAP counts from this pixel's corner, so
its coordinates are larger by half a pixel.

Source: dkogan/mrcal, ``doc/cameramodels.org``; colmap/colmap, ``sensor/models.h`` and
``doc/format.rst``; ros-perception/image_common, ``camera_calibration_parsers``, ``parse_ini.cpp``;
EuRoC MAV, ``mav0/cam0/sensor.yaml``; VladyslavUsenko/basalt, ``data/euroc_eucm_calib.json``;
oliver-batchelor/multical, ``io/export_calib.py`` (all published).
"""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.calibration.formats._file_format import MAX_YAML_BYTES, UnscaledValue
from smartcam.calibration.formats._plain import (
    POSE,
    Plain,
    as_list,
    as_mapping,
    as_matrix,
    as_number,
    as_numbers,
    lens_matrix,
    load_json,
    load_yaml,
    malformed_error,
    numbers_by_key,
    rigid_transform,
    transform_of_pose,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import DistortionModel


class ForeignLens(NamedTuple):
    """A lens as a file describes it."""

    name: str
    size: Sequence[Plain] | None  # width and height, pixels; None: the file has no size
    intrinsics: Sequence[float]  # fx, fy, cx, cy, pixels
    model: DistortionModel
    coefficients: Sequence[float]


class _LensParameters(NamedTuple):
    """A program's lens model: the names of its parameters, in their order."""

    intrinsics: str  # names of fx, fy, cx and cy among the parameters, in their order
    model: DistortionModel = "plumb_bob"
    coefficients: str = ""  # names of the coefficients, in the order of the parameters


_TWO_FOCALS: Final = "fx fy cx cy"
_ONE_FOCAL: Final = "f cx cy"
_RADTAN: Final = "k1 k2 p1 p2"
_RATIONAL: Final = "k1 k2 p1 p2 k3 k4 k5 k6"
_FISHEYE: Final = "k1 k2 k3 k4"

_KALIBR_MODELS: Final = {
    "radtan": _LensParameters(_TWO_FOCALS, coefficients=_RADTAN),
    "equidistant": _LensParameters(_TWO_FOCALS, "equidistant", _FISHEYE),
    "none": _LensParameters(_TWO_FOCALS),
}

MODELS: Final[Mapping[str, Mapping[str, _LensParameters]]] = {
    "colmap": {
        "SIMPLE_PINHOLE": _LensParameters(_ONE_FOCAL),
        "PINHOLE": _LensParameters(_TWO_FOCALS),
        "SIMPLE_RADIAL": _LensParameters(_ONE_FOCAL, coefficients="k1"),
        "RADIAL": _LensParameters(_ONE_FOCAL, coefficients="k1 k2"),
        "OPENCV": _LensParameters(_TWO_FOCALS, coefficients=_RADTAN),
        "FULL_OPENCV": _LensParameters(_TWO_FOCALS, "rational_polynomial", _RATIONAL),
        "SIMPLE_RADIAL_FISHEYE": _LensParameters(_ONE_FOCAL, "equidistant", "k1"),
        "RADIAL_FISHEYE": _LensParameters(_ONE_FOCAL, "equidistant", "k1 k2"),
        "OPENCV_FISHEYE": _LensParameters(_TWO_FOCALS, "equidistant", _FISHEYE),
    },
    "mrcal": {
        "LENSMODEL_PINHOLE": _LensParameters(_TWO_FOCALS),
        "LENSMODEL_OPENCV4": _LensParameters(_TWO_FOCALS, coefficients=_RADTAN),
        "LENSMODEL_OPENCV5": _LensParameters(_TWO_FOCALS, coefficients=f"{_RADTAN} k3"),
        "LENSMODEL_OPENCV8": _LensParameters(_TWO_FOCALS, "rational_polynomial", _RATIONAL),
    },
    "kalibr": _KALIBR_MODELS,
    "basalt": {
        "pinhole": _LensParameters(_TWO_FOCALS),
        "pinhole-radtan8": _LensParameters(_TWO_FOCALS, "rational_polynomial", _RATIONAL),
        "kb4": _LensParameters(_TWO_FOCALS, "equidistant", _FISHEYE),
    },
    "euroc": {
        **_KALIBR_MODELS,
        "radial-tangential": _LensParameters(_TWO_FOCALS, coefficients=_RADTAN),
    },
    "multical": {
        "standard": _LensParameters(_TWO_FOCALS, coefficients=f"{_RADTAN} k3"),
        "rational": _LensParameters(_TWO_FOCALS, "rational_polynomial", _RATIONAL),
    },
}
"""Lens models of each program, by their names in its files."""


def _make_lens(
    program: str,
    name: Plain,
    values: Sequence[float],
    where: str,
    size: Sequence[Plain] | None,
) -> ForeignLens:
    """Return a lens from its parameters, which are in the order of the program's model."""
    models = MODELS[program]
    if not (isinstance(name, str) and name in models):
        raise malformed_error(f"{where}: lens model", f"one of {', '.join(models)}", name)
    parameters = models[name]
    names = [*parameters.intrinsics.split(), *parameters.coefficients.split()]
    if len(values) != len(names):
        expected = f"{len(names)} parameters of {name} ({', '.join(names)})"
        raise malformed_error(where, expected, f"{len(values)}")
    values_by_name = dict(zip(names, values, strict=True))
    fx, fy = (values_by_name.get(name, values_by_name.get("f", 0.0)) for name in ("fx", "fy"))
    coefficients = {name: values_by_name[name] for name in parameters.coefficients.split()}
    order = {
        "plumb_bob": f"{_RADTAN} k3",
        "rational_polynomial": _RATIONAL,
        "equidistant": _FISHEYE,
    }
    return ForeignLens(
        where,
        size,
        (fx, fy, values_by_name["cx"], values_by_name["cy"]),
        parameters.model,
        [coefficients.get(name, 0.0) for name in order[parameters.model].split()],
    )


# ---------------------------------------------------------------------- one camera, or several

FoundLenses = tuple["list[ForeignLens]", "list[Transform]", "str | None"]
"""Lenses, the transforms from each lens into the next one, and the transforms' unit; None:
unknown."""

METRES_BY_FORMAT: Final = ""
"""Value in place of a unit: the format defines that lengths are in metres."""

MAX_CAMERAS: Final = 64
"""Largest number of cameras of a chain."""


def parse_camchain(text: str) -> FoundLenses:
    """Return the cameras of Kalibr's camchain, with the motion from each to the next."""
    data = as_mapping(load_yaml(text), "file", ["cam0"])
    names = [f"cam{index}" for index in range(sum(key.startswith("cam") for key in data))]
    if len(names) > MAX_CAMERAS:
        raise malformed_error("file", f"{MAX_CAMERAS} cameras at most", str(len(names)))
    lenses, motions = [], []
    for name, before in zip(names, ["", *names], strict=False):
        part = as_mapping(as_mapping(data, "file", names)[name], name, _KALIBR_PINHOLE_KEYS)
        lenses.append(_parse_pinhole("kalibr", part, name, "distortion_coeffs"))
        if before:
            where = f"{name}.T_cn_cnm1"
            rows = as_mapping(part, name, ["T_cn_cnm1"])["T_cn_cnm1"]
            motions.append(rigid_transform(name, before, as_matrix(rows, where, (4, 4)), where))
    return lenses, motions, METRES_BY_FORMAT


_KALIBR_PINHOLE_KEYS: Final = (
    "camera_model",
    "intrinsics",
    "distortion_model",
    "distortion_coeffs",
)


def _parse_pinhole(
    program: str, part: dict[str, Plain], where: str, coefficients: str
) -> ForeignLens:
    """Return a lens from Kalibr's keys; EuRoC differs in the key ``coefficients``."""
    if part["camera_model"] != "pinhole":
        raise malformed_error(f"{where}.camera_model", "pinhole", part["camera_model"])
    values = as_numbers(part["intrinsics"], f"{where}.intrinsics", 4)
    values += as_numbers(part[coefficients], f"{where}.{coefficients}")
    size = as_list(part["resolution"], "resolution", 2) if "resolution" in part else None
    return _make_lens(program, part["distortion_model"], values, where, size)


def parse_colmap(text: str) -> FoundLenses:
    """Return the cameras of ``cameras.txt``, which has no poses; so only one camera is allowed."""
    cameras = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise malformed_error("camera", "an id, a model, width, height and parameters", line)
        values = [as_number(word, f"camera {words[0]}") for word in words[4:]]
        lens = _make_lens("colmap", words[1], values, f"camera {words[0]}", words[2:4])
        fx, fy, cx, cy = lens.intrinsics
        cameras.append(lens._replace(intrinsics=(fx, fy, cx - 0.5, cy - 0.5)))
    return cameras, [], None


def parse_mrcal(text: str) -> FoundLenses:
    """Return the lens of a ``.cameramodel``: a Python dictionary, which is also YAML.

    Only the line with the inputs of mrcal's solver, bytes to the base 85, is no YAML.
    """
    text = re.sub(r"^ *'optimization_inputs': b'.*$", "", text, flags=re.MULTILINE)
    if len(text) > MAX_YAML_BYTES:
        raise malformed_error(
            "file", f"{MAX_YAML_BYTES} bytes at most, without the solver's inputs"
        )
    data = as_mapping(load_yaml(text), "file", ["lensmodel", "intrinsics", "imagersize"])
    values = as_numbers(data["intrinsics"], "intrinsics")
    size = as_list(data["imagersize"], "imagersize", 2)
    return [_make_lens("mrcal", data["lensmodel"], values, "camera", size)], [], None


def parse_ros_ini(text: str) -> FoundLenses:
    """Return the camera of ROS' ``.ini``: lines with titles, and lines with numbers below them."""
    section, title = "camera", ""
    sections: dict[str, list[Plain]] = {}
    for line in map(str.strip, text.splitlines()):
        if not line or line.startswith(("#", ";")):
            continue
        if line.startswith("["):
            if line != "[image]":
                section = line.strip("[]").strip()
        elif re.fullmatch(r"[a-z ]+", line):
            title = line
            if title in sections:
                raise malformed_error("file", "one camera", f"{title!r} twice")
            sections[title] = []
        else:
            sections.setdefault(title, []).extend(line.split())
    data = as_mapping(sections, "file", ["width", "height", "camera matrix", "distortion"])
    matrix = np.reshape(as_numbers(data["camera matrix"], "camera matrix", 9), (3, 3))
    coefficients = as_numbers(data["distortion"], "distortion")
    model: DistortionModel = "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
    size = [*data["width"], *data["height"]]
    lens = ForeignLens(section, size, _intrinsic_parameters(matrix), model, coefficients)
    return [lens], [], None


def _intrinsic_parameters(matrix: np.ndarray[Any, Any]) -> list[float]:
    """Return fx, fy, cx and cy of a (3, 3) matrix; raise MALFORMED if a lens has no such matrix."""
    intrinsics = [float(matrix[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2))]
    if (matrix != lens_matrix(*intrinsics)).any():
        raise malformed_error(
            "camera matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix.tolist()
        )
    return intrinsics


def parse_euroc(text: str) -> FoundLenses:
    """Return the camera of a ``sensor.yaml``; :func:`parse_sensor` reads its pose on the body."""
    keys = [*_KALIBR_PINHOLE_KEYS[:3], "distortion_coefficients"]
    lens = _parse_pinhole("euroc", as_mapping(load_yaml(text), "file", keys), "camera", keys[3])
    return [lens], [], None


def parse_basalt(text: str) -> FoundLenses:
    """Return the cameras of basalt's ``calibration.json``, metres, posed in the IMU's frame."""
    data = as_mapping(
        as_mapping(load_json(text), "file", ["value0"])["value0"], "value0", ["intrinsics"]
    )
    cameras = as_list(data["intrinsics"], "intrinsics")
    sizes = as_list(data["resolution"], "resolution", len(cameras)) if "resolution" in data else []
    lenses = []
    for index, camera in enumerate(cameras):
        where = f"cam{index}"
        part = as_mapping(camera, where, ["camera_type", "intrinsics"])
        parameters = MODELS["basalt"].get(str(part["camera_type"]), _LensParameters(_TWO_FOCALS))
        names = [*parameters.intrinsics.split(), *parameters.coefficients.split()]
        given = as_mapping(part["intrinsics"], where, names)
        values = [as_number(given[name], f"{where}.{name}") for name in names]
        size = as_list(sizes[index], f"{where}: resolution", 2) if sizes else None
        lenses.append(_make_lens("basalt", part["camera_type"], values, where, size))
    if len(lenses) < 2:
        return lenses, [], METRES_BY_FORMAT
    poses = as_list(
        as_mapping(data, "value0", ["T_imu_cam"])["T_imu_cam"], "T_imu_cam", len(lenses)
    )
    in_imu = [
        transform_of_pose(
            "imu",
            lens.name,
            numbers_by_key(pose, f"T_imu_{lens.name}", ["px", "py", "pz", *POSE[3:]]),
        )
        for lens, pose in zip(lenses, poses, strict=True)
    ]
    return lenses, [b.inverse() @ a for a, b in itertools.pairwise(in_imu)], METRES_BY_FORMAT


def parse_multical(text: str) -> FoundLenses:
    """Return the cameras of multical's ``calibration.json``; lengths are in the board's unit."""
    data = as_mapping(load_json(text), "file", ["cameras"])
    cameras = as_mapping(data["cameras"], "cameras")
    lenses = []
    for name, stated in cameras.items():
        part = as_mapping(stated, name, ["model", "K", "dist"])
        matrix = as_matrix(part["K"], f"{name}.K", (3, 3))
        flat_values = [
            value for row in as_list(part["dist"], f"{name}.dist") for value in _as_items(row)
        ]
        coefficients = as_numbers(flat_values, f"{name}.dist")
        size = (
            as_list(part["image_size"], f"{name}.image_size", 2) if "image_size" in part else None
        )
        lenses.append(
            _make_lens(
                "multical",
                part["model"],
                [*_intrinsic_parameters(matrix), *coefficients],
                name,
                size,
            )
        )
    if len(lenses) < 2:
        return lenses, [], None
    # the key "b_to_a" has the motion from a's frame into b's; a key with a single name has the pose
    # of the master camera, or of the rig
    camera_poses: dict[str, Transform] = {}
    for name, pose in as_mapping(
        as_mapping(data, "file", ["camera_poses"])["camera_poses"], "poses"
    ).items():
        part = as_mapping(pose, name, ["R", "T"])
        turn, shift = as_matrix(part["R"], name, (3, 3)), as_numbers(part["T"], f"{name}.T", 3)
        camera, rows = name.partition("_to_")[0], np.column_stack([turn, shift])
        camera_poses[camera] = rigid_transform(camera, "rig", [*rows, [0.0, 0.0, 0.0, 1.0]], name)
    missing = [lens.name for lens in lenses if lens.name not in camera_poses]
    if missing:
        raise malformed_error(
            "camera_poses", "a pose of each camera", f"none of {', '.join(missing)}"
        )
    order = [camera_poses[lens.name] for lens in lenses]
    return lenses, [b @ a.inverse() for a, b in itertools.pairwise(order)], None


def _as_items(value: Plain) -> list[Plain]:
    return value if isinstance(value, list) else [value]


# ---------------------------------------------------------------------- transforms


def parse_bare(text: str, target: str, source: str) -> UnscaledValue[Transform]:
    """Read the 16 numbers of a matrix, row by row, between spaces, commas or brackets."""
    lines = [line.partition("#")[0] for line in text.splitlines()]
    words = re.sub(r"[\[\],;]", " ", " ".join(lines)).split()
    if len(words) != 16:
        raise malformed_error("matrix", "16 numbers: four rows of four", f"{len(words)}")
    values = np.reshape([as_number(word, "matrix") for word in words], (4, 4))
    return UnscaledValue(rigid_transform(target, source, values, "matrix"))


def parse_zivid(text: str, target: str, source: str) -> UnscaledValue[Transform]:
    """Return Zivid's matrix, whose lengths are millimetres."""
    data = as_mapping(
        as_mapping(load_yaml(text), "file", ["FloatMatrix"])["FloatMatrix"], "Data", ["Data"]
    )
    rows = as_matrix(data["Data"], "matrix", (4, 4))
    return UnscaledValue(rigid_transform(target, source, rows, "matrix"), "mm")


def parse_sensor(text: str, target: str, source: str) -> Transform:
    """Return the pose of the sensor of EuRoC's ``sensor.yaml`` on the body."""
    part = as_mapping(as_mapping(load_yaml(text), "file", ["T_BS"])["T_BS"], "T_BS", ["data"])
    rows = np.reshape(as_numbers(part["data"], "T_BS", 16), (4, 4))
    return rigid_transform(target, source, rows, "T_BS")
