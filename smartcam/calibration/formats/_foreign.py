"""Read lenses from other programs' files that smartcam does not write.

Each function returns lenses as :class:`ForeignLens`, and transforms; ``_cameras.py`` makes cameras
of them. Pixels count from the centre of the upper left pixel; COLMAP counts
from its corner, which is half a pixel more.

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

from smartcam.calibration.formats._file_format import MAX_YAML_BYTES, Measured
from smartcam.calibration.formats._plain import (
    POSE,
    Plain,
    lens_matrix,
    load_json,
    load_yaml,
    malformed_error,
    mapping,
    matrix_of,
    number,
    numbers,
    placed,
    reals,
    rigid,
    sequence,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import DistortionModel


class ForeignLens(NamedTuple):
    """A lens in a file's own terms."""

    name: str
    size: Sequence[Plain] | None  # width and height, pixels; None if the file does not say it
    focal: Sequence[float]  # fx, fy, cx, cy, pixels
    model: DistortionModel
    coefficients: Sequence[float]


class _LensParameters(NamedTuple):
    """A program's lens model: the names of its parameters, in their order."""

    focal: str  # names of fx, fy, cx and cy among the parameters, in their order
    model: DistortionModel = "plumb_bob"
    coefficients: str = ""  # names of the coefficients, in the order of the parameters


_FXFY: Final = "fx fy cx cy"
_F: Final = "f cx cy"
_RADTAN: Final = "k1 k2 p1 p2"
_EIGHT: Final = "k1 k2 p1 p2 k3 k4 k5 k6"
_FOUR: Final = "k1 k2 k3 k4"

_OF_KALIBR: Final = {
    "radtan": _LensParameters(_FXFY, coefficients=_RADTAN),
    "equidistant": _LensParameters(_FXFY, "equidistant", _FOUR),
    "none": _LensParameters(_FXFY),
}

MODELS: Final[Mapping[str, Mapping[str, _LensParameters]]] = {
    "colmap": {
        "SIMPLE_PINHOLE": _LensParameters(_F),
        "PINHOLE": _LensParameters(_FXFY),
        "SIMPLE_RADIAL": _LensParameters(_F, coefficients="k1"),
        "RADIAL": _LensParameters(_F, coefficients="k1 k2"),
        "OPENCV": _LensParameters(_FXFY, coefficients=_RADTAN),
        "FULL_OPENCV": _LensParameters(_FXFY, "rational_polynomial", _EIGHT),
        "SIMPLE_RADIAL_FISHEYE": _LensParameters(_F, "equidistant", "k1"),
        "RADIAL_FISHEYE": _LensParameters(_F, "equidistant", "k1 k2"),
        "OPENCV_FISHEYE": _LensParameters(_FXFY, "equidistant", _FOUR),
    },
    "mrcal": {
        "LENSMODEL_PINHOLE": _LensParameters(_FXFY),
        "LENSMODEL_OPENCV4": _LensParameters(_FXFY, coefficients=_RADTAN),
        "LENSMODEL_OPENCV5": _LensParameters(_FXFY, coefficients=f"{_RADTAN} k3"),
        "LENSMODEL_OPENCV8": _LensParameters(_FXFY, "rational_polynomial", _EIGHT),
    },
    "kalibr": _OF_KALIBR,
    "basalt": {
        "pinhole": _LensParameters(_FXFY),
        "pinhole-radtan8": _LensParameters(_FXFY, "rational_polynomial", _EIGHT),
        "kb4": _LensParameters(_FXFY, "equidistant", _FOUR),
    },
    "euroc": {
        **_OF_KALIBR,
        "radial-tangential": _LensParameters(_FXFY, coefficients=_RADTAN),
    },
    "multical": {
        "standard": _LensParameters(_FXFY, coefficients=f"{_RADTAN} k3"),
        "rational": _LensParameters(_FXFY, "rational_polynomial", _EIGHT),
    },
}
"""Lens models of each program, by their names in its files."""


def _lens(
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
    wanted = models[name]
    names = [*wanted.focal.split(), *wanted.coefficients.split()]
    if len(values) != len(names):
        expected = f"{len(names)} parameters of {name} ({', '.join(names)})"
        raise malformed_error(where, expected, f"{len(values)}")
    given = dict(zip(names, values, strict=True))
    fx, fy = (given.get(name, given.get("f", 0.0)) for name in ("fx", "fy"))
    coefficients = {name: given[name] for name in wanted.coefficients.split()}
    order = {"plumb_bob": f"{_RADTAN} k3", "rational_polynomial": _EIGHT, "equidistant": _FOUR}
    return ForeignLens(
        where,
        size,
        (fx, fy, given["cx"], given["cy"]),
        wanted.model,
        [coefficients.get(name, 0.0) for name in order[wanted.model].split()],
    )


# ---------------------------------------------------------------------- one camera, or several

Found = tuple["list[ForeignLens]", "list[Transform]", "str | None"]
"""Lenses, the transforms from each into the next one, and the transforms' unit if it is known."""

BY_FORMAT: Final = ""
"""Unit of lengths that are metres by the definition of the format."""

MAX_CAMERAS: Final = 64
"""A chain has at most this many cameras."""


def parse_camchain(text: str) -> Found:
    """Return the cameras of Kalibr's camchain, with the motion from each to the next."""
    data = mapping(load_yaml(text), "file", ["cam0"])
    names = [f"cam{place}" for place in range(sum(key.startswith("cam") for key in data))]
    if len(names) > MAX_CAMERAS:
        raise malformed_error("file", f"{MAX_CAMERAS} cameras at most", str(len(names)))
    lenses, motions = [], []
    for name, before in zip(names, ["", *names], strict=False):
        part = mapping(mapping(data, "file", names)[name], name, _PINHOLE_OF_KALIBR)
        lenses.append(_pinhole("kalibr", part, name, "distortion_coeffs"))
        if before:
            where = f"{name}.T_cn_cnm1"
            rows = mapping(part, name, ["T_cn_cnm1"])["T_cn_cnm1"]
            motions.append(rigid(name, before, matrix_of(rows, where, (4, 4)), where))
    return lenses, motions, BY_FORMAT


_PINHOLE_OF_KALIBR: Final = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs")


def _pinhole(program: str, part: dict[str, Plain], where: str, coefficients: str) -> ForeignLens:
    """Return a lens from Kalibr's keys; EuRoC's are the same except for one."""
    if part["camera_model"] != "pinhole":
        raise malformed_error(f"{where}.camera_model", "pinhole", part["camera_model"])
    values = reals(part["intrinsics"], f"{where}.intrinsics", 4)
    values += reals(part[coefficients], f"{where}.{coefficients}")
    size = sequence(part["resolution"], "resolution", 2) if "resolution" in part else None
    return _lens(program, part["distortion_model"], values, where, size)


def parse_colmap(text: str) -> Found:
    """Return the cameras of ``cameras.txt``; it has no poses, so there may be only one camera."""
    cameras = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise malformed_error("camera", "an id, a model, width, height and parameters", line)
        values = [number(word, f"camera {words[0]}") for word in words[4:]]
        lens = _lens("colmap", words[1], values, f"camera {words[0]}", words[2:4])
        fx, fy, cx, cy = lens.focal
        cameras.append(lens._replace(focal=(fx, fy, cx - 0.5, cy - 0.5)))
    return cameras, [], None


def parse_mrcal(text: str) -> Found:
    """Return the lens of a ``.cameramodel``: a Python dictionary, which is also YAML.

    Only the line with the inputs of mrcal's solver, bytes to the base 85, is no YAML.
    """
    text = re.sub(r"^ *'optimization_inputs': b'.*$", "", text, flags=re.MULTILINE)
    if len(text) > MAX_YAML_BYTES:
        raise malformed_error("file", f"{MAX_YAML_BYTES} bytes at most beside the solver's inputs")
    data = mapping(load_yaml(text), "file", ["lensmodel", "intrinsics", "imagersize"])
    values = reals(data["intrinsics"], "intrinsics")
    size = sequence(data["imagersize"], "imagersize", 2)
    return [_lens("mrcal", data["lensmodel"], values, "camera", size)], [], None


def parse_ros_ini(text: str) -> Found:
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
    data = mapping(sections, "file", ["width", "height", "camera matrix", "distortion"])
    matrix = np.reshape(reals(data["camera matrix"], "camera matrix", 9), (3, 3))
    coefficients = reals(data["distortion"], "distortion")
    model: DistortionModel = "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
    size = [*data["width"], *data["height"]]
    return [ForeignLens(section, size, _focal(matrix), model, coefficients)], [], None


def _focal(matrix: np.ndarray[Any, Any]) -> list[float]:
    """Return fx, fy, cx and cy of a (3, 3) matrix; raise MALFORMED if it is no lens' matrix."""
    focal = [float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
    if (matrix != lens_matrix(*focal)).any():
        raise malformed_error(
            "camera matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix.tolist()
        )
    return focal


def parse_euroc(text: str) -> Found:
    """Return the camera of a ``sensor.yaml``; its pose on the body is read as a transform."""
    keys = [*_PINHOLE_OF_KALIBR[:3], "distortion_coefficients"]
    lens = _pinhole("euroc", mapping(load_yaml(text), "file", keys), "camera", keys[3])
    return [lens], [], None


def parse_basalt(text: str) -> Found:
    """Return the cameras of basalt's ``calibration.json``, metres, posed in the IMU's frame."""
    data = mapping(mapping(load_json(text), "file", ["value0"])["value0"], "value0", ["intrinsics"])
    cameras = sequence(data["intrinsics"], "intrinsics")
    sizes = sequence(data["resolution"], "resolution", len(cameras)) if "resolution" in data else []
    lenses = []
    for place, camera in enumerate(cameras):
        where = f"cam{place}"
        part = mapping(camera, where, ["camera_type", "intrinsics"])
        parameters = MODELS["basalt"].get(str(part["camera_type"]), _LensParameters(_FXFY))
        names = [*parameters.focal.split(), *parameters.coefficients.split()]
        given = mapping(part["intrinsics"], where, names)
        values = [number(given[name], f"{where}.{name}") for name in names]
        size = sequence(sizes[place], f"{where}: resolution", 2) if sizes else None
        lenses.append(_lens("basalt", part["camera_type"], values, where, size))
    if len(lenses) < 2:
        return lenses, [], BY_FORMAT
    poses = sequence(mapping(data, "value0", ["T_imu_cam"])["T_imu_cam"], "T_imu_cam", len(lenses))
    in_imu = [
        placed("imu", lens.name, numbers(pose, f"T_imu_{lens.name}", ["px", "py", "pz", *POSE[3:]]))
        for lens, pose in zip(lenses, poses, strict=True)
    ]
    return lenses, [b.inverse() @ a for a, b in itertools.pairwise(in_imu)], BY_FORMAT


def parse_multical(text: str) -> Found:
    """Return the cameras of multical's ``calibration.json``; lengths are in the board's unit."""
    data = mapping(load_json(text), "file", ["cameras"])
    cameras = mapping(data["cameras"], "cameras")
    lenses = []
    for name, stated in cameras.items():
        part = mapping(stated, name, ["model", "K", "dist"])
        matrix = matrix_of(part["K"], f"{name}.K", (3, 3))
        flat = [value for row in sequence(part["dist"], f"{name}.dist") for value in _flat(row)]
        coefficients = reals(flat, f"{name}.dist")
        size = (
            sequence(part["image_size"], f"{name}.image_size", 2) if "image_size" in part else None
        )
        lenses.append(
            _lens("multical", part["model"], [*_focal(matrix), *coefficients], name, size)
        )
    if len(lenses) < 2:
        return lenses, [], None
    # "b_to_a" is the motion from a's frame into b's; a single name is the master, or the pose of
    # the rig
    seen: dict[str, Transform] = {}
    for name, pose in mapping(
        mapping(data, "file", ["camera_poses"])["camera_poses"], "poses"
    ).items():
        part = mapping(pose, name, ["R", "T"])
        turn, shift = matrix_of(part["R"], name, (3, 3)), reals(part["T"], f"{name}.T", 3)
        camera, rows = name.partition("_to_")[0], np.column_stack([turn, shift])
        seen[camera] = rigid(camera, "rig", [*rows, [0.0, 0.0, 0.0, 1.0]], name)
    missing = [lens.name for lens in lenses if lens.name not in seen]
    if missing:
        raise malformed_error(
            "camera_poses", "a pose of each camera", f"none of {', '.join(missing)}"
        )
    order = [seen[lens.name] for lens in lenses]
    return lenses, [b @ a.inverse() for a, b in itertools.pairwise(order)], None


def _flat(value: Plain) -> list[Plain]:
    return value if isinstance(value, list) else [value]


# ---------------------------------------------------------------------- transforms


def parse_bare(text: str, target: str, source: str) -> Measured[Transform]:
    """Read the 16 numbers of a matrix, row by row; between them are spaces, commas or brackets."""
    lines = [line.partition("#")[0] for line in text.splitlines()]
    words = re.sub(r"[\[\],;]", " ", " ".join(lines)).split()
    if len(words) != 16:
        raise malformed_error("matrix", "16 numbers: four rows of four", f"{len(words)}")
    values = np.reshape([number(word, "matrix") for word in words], (4, 4))
    return Measured(rigid(target, source, values, "matrix"))


def parse_zivid(text: str, target: str, source: str) -> Measured[Transform]:
    """Return Zivid's matrix, whose lengths are millimetres."""
    data = mapping(
        mapping(load_yaml(text), "file", ["FloatMatrix"])["FloatMatrix"], "Data", ["Data"]
    )
    rows = matrix_of(data["Data"], "matrix", (4, 4))
    return Measured(rigid(target, source, rows, "matrix"), "mm")


def parse_sensor(text: str, target: str, source: str) -> Transform:
    """Return the pose of the sensor of EuRoC's ``sensor.yaml`` on the body."""
    part = mapping(mapping(load_yaml(text), "file", ["T_BS"])["T_BS"], "T_BS", ["data"])
    rows = np.reshape(reals(part["data"], "T_BS", 16), (4, 4))
    return rigid(target, source, rows, "T_BS")
