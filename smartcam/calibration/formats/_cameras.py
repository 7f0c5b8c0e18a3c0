"""Read and write files of lenses and camera pairs: ROS' ``camera_info``, Kalibr's, OpenCV's.

Parsers of Kalibr's files, and of formats that can only be read, are in ``_foreign.py``.

::

    write_cameras("camchain.yaml", "kalibr", CameraChain.of(calibration))
    camera = read_cameras("left.yaml", "camera_info").cameras[0]

Pixels count from the centre of the upper left pixel, and lengths are converted to metres. The model
of the lens decides how many coefficients are written and read.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._files.store import replace_file
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration.formats import _foreign as foreign
from smartcam.calibration.formats._file_format import MAX_FILE_BYTES, Format, UnscaledValue
from smartcam.calibration.formats._opencv import HEAD, load_storage, storage_matrix
from smartcam.calibration.formats._plain import (
    Plain,
    as_list,
    as_mapping,
    as_whole_number,
    flow_list,
    lens_matrix,
    load_yaml,
    look_up,
    malformed_error,
    matrix_rows,
    quote,
    rigid_transform,
    stored_matrix,
)
from smartcam.geometry import CameraModel
from smartcam.geometry._inside import COEFFICIENT_COUNTS, Code, check_size

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
    from smartcam.calibration._units import LengthUnit
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array, DistortionModel

CameraForm: TypeAlias = Literal[
    "camera_info", "kalibr", "opencv", "ros_ini", "euroc", "mrcal", "colmap", "basalt", "multical"
]
"""Names of the formats."""

MAX_CAMERA_FILE_BYTES: Final = 1 << 20
"""Largest number of bytes of a file; a chain of eight cameras has four thousand."""

_KALIBR: Final[dict[DistortionModel, str]] = {"plumb_bob": "radtan", "equidistant": "equidistant"}
_RADTAN_COUNT: Final = 4
"""Number of Kalibr's coefficients: k1, k2, p1, p2; there is no k3."""

_MATRICES: Final = (("M1", "D1"), ("M2", "D2"))
"""Names of both cameras' matrices in OpenCV's sample ``stereo_calib``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraChain:
    """Cameras, each with its pose relative to the camera before.

    Attributes:
        cameras: the lenses, one or more.
        transforms: motions from each camera's frame into the next one's: ``T_1_0``, ``T_2_1``, ...
        names: names of the cameras.
    """

    cameras: tuple[CameraModel, ...]
    transforms: tuple[Transform, ...] = ()
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 0 < len(self.cameras) == len(self.transforms) + 1 == len(self.names):
            raise Code.SHAPE.error(
                "chain of cameras: expected a name for each of them and a transform between each "
                f"two, got {len(self.cameras)} cameras, {len(self.names)} names and "
                f"{len(self.transforms)} transforms"
            )

    @classmethod
    def of(cls, calibration: IntrinsicCalibration | StereoCalibration) -> CameraChain:
        """Return the chain of a calibration: ``camera``, or ``left`` and ``right``."""
        if isinstance(calibration, StereoCalibration):
            return cls(
                cameras=(calibration.left, calibration.right),
                transforms=(calibration.transform,),
                names=(calibration.transform.source, calibration.transform.target),
            )
        return cls(cameras=(calibration.camera,), names=("camera",))


class CameraInfo(NamedTuple):
    """One camera in ROS' ``camera_info``.

    Attributes:
        camera: the lens.
        name: name of the camera.
        rectification: (3, 3), rotation from the camera's frame into the rectified one.
        projection: (3, 4), projection of the rectified image, pixels.
    """

    camera: CameraModel
    name: str
    rectification: Array
    projection: Array


def read_cameras(
    path: str | os.PathLike[str],
    form: CameraForm,
    *,
    size: tuple[int, int] | None = None,
    unit: LengthUnit | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
) -> CameraChain:
    """Return the cameras of a file.

    Args:
        path: the file.
        form: ``camera_info`` and ``ros_ini`` (ROS), ``kalibr``, ``opencv`` (YAML or XML),
            ``euroc`` (``sensor.yaml``), ``mrcal`` (``.cameramodel``), ``colmap``
            (``cameras.txt``), ``basalt`` or ``multical`` (``calibration.json``).
        size: width and height of the cameras' images, pixels, for a file without the size, such as
            OpenCV's ``intrinsics.yml``; if a file has the size, it must be the same.
        unit: unit of the lengths between cameras; None for the unit that the file or its format
            names. Files of OpenCV and multical name none.
        extrinsics: the second file of OpenCV's sample ``stereo_calib``, with R and T.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``, ``NOT_RIGID`` or ``SHAPE``: the file does
            not have its format, or has a lens of another model; ``WRONG_SIZE``: the file has no
            size of the images, or another one; ``UNIT_UNKNOWN``; ``UNKNOWN_FORMAT``.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    file_format = look_up(FORMS, form, "format of cameras")
    if size is not None:
        check_size(size, "read_cameras")
    if extrinsics is None:
        return file_format.read(path, size, unit=unit)
    if form != "opencv":
        raise _unsupported_error(form, "one file", "extrinsics as well")
    with Path(extrinsics).open("rb") as stream:
        extrinsics_text = stream.read(MAX_CAMERA_FILE_BYTES + 1).decode("utf-8", "replace")
    return file_format.read(path, size, extrinsics_text, unit=unit)


def write_cameras(path: str | os.PathLike[str], form: CameraForm, chain: CameraChain) -> None:
    """Write cameras to a file, whole or not at all.

    Args:
        path: the file.
        form: ``camera_info`` for one camera, ``opencv`` for one or two, ``kalibr``.
        chain: the cameras.

    Raises:
        CalibrationError: ``SHAPE``: the format cannot hold this number of cameras, or such a lens;
            ``UNKNOWN_FORMAT``; ``NOT_WRITTEN``: the file cannot be written.
    """
    look_up(FORMS, form, "format of cameras").write(path, chain)


def write_camera_info(
    path: str | os.PathLike[str],
    camera: CameraModel,
    *,
    name: str = "camera",
    rectification: Array | None = None,
    projection: Array | None = None,
) -> None:
    """Write ROS' ``camera_info`` of one camera, whole or not at all.

    Args:
        path: the file.
        camera: the lens.
        name: name of the camera.
        rectification: (3, 3), as from :meth:`StereoCalibration.rectify`; None for no rectification.
        projection: (3, 4), pixels and, for the right camera, pixels times metres; None for the
            projection of the lens without its distortion.

    Raises:
        CalibrationError: ``NOT_WRITTEN``: the file cannot be written.
    """
    text = compose_camera_info(camera, name, rectification, projection)
    replace_file(Path(path), text.encode())


# ---------------------------------------------------------------------- ROS


def compose_camera_info(
    camera: CameraModel,
    name: str = "camera",
    rectification: Array | None = None,
    projection: Array | None = None,
) -> str:
    """Return the YAML of ROS' ``camera_info``; see :func:`write_camera_info`.

    ``cols`` of the coefficients is their number, five or eight. Source: ROS,
    ``camera_calibration_parsers`` (published); image_pipeline #278: some readers misread eight
    coefficients, since they expect five.
    """
    undistorted = np.column_stack([camera.matrix, np.zeros(3)])
    return (
        f"image_width: {camera.size[0]}\n"
        f"image_height: {camera.size[1]}\n"
        f"camera_name: {quote(name)}\n"
        + _ros_matrix("camera_matrix", camera.matrix)
        + f"distortion_model: {camera.distortion_model}\n"
        + _ros_matrix("distortion_coefficients", camera.distortion[None])
        + _ros_matrix("rectification_matrix", np.eye(3) if rectification is None else rectification)
        + _ros_matrix("projection_matrix", undistorted if projection is None else projection)
    )


def _ros_matrix(name: str, matrix: Array) -> str:
    return (
        f"{name}:\n  rows: {matrix.shape[0]}\n  cols: {matrix.shape[1]}\n"
        f"  data: {flow_list(matrix.ravel())}\n"
    )


def parse_camera_info(text: str, size: tuple[int, int] | None = None) -> CameraInfo:
    """Return the camera of a ``camera_info``; four coefficients of ``plumb_bob`` mean k3 = 0.

    Raises ``MALFORMED``, ``NOT_FINITE``, ``SHAPE``; MissingExtraError: PyYAML is not installed.
    """
    needed = ["camera_matrix", "distortion_model", "distortion_coefficients"]
    data = as_mapping(load_yaml(text), "file", needed)
    matrix = stored_matrix(data["camera_matrix"], "camera_matrix", (3, 3))
    rectification, projection = np.eye(3), np.column_stack([matrix, np.zeros(3)])
    if "rectification_matrix" in data:
        rectification = stored_matrix(data["rectification_matrix"], "rectification_matrix", (3, 3))
    if "projection_matrix" in data:
        projection = stored_matrix(data["projection_matrix"], "projection_matrix", (3, 4))
    coefficients = stored_matrix(data["distortion_coefficients"], "distortion_coefficients").ravel()
    model = _parse_model(data["distortion_model"], coefficients)
    stated = [data[key] for key in ("image_width", "image_height") if key in data]
    camera = _make_camera(_choose_size(stated, size), matrix, coefficients, model)
    name = data.get("camera_name", "camera")
    if not isinstance(name, str):
        raise malformed_error("camera_name", "a text", name)
    return CameraInfo(camera, name, rectification, projection)


def _compose_single(chain: CameraChain) -> str:
    if len(chain.cameras) != 1:
        raise _unsupported_error("camera_info", "one camera", f"{len(chain.cameras)}")
    return compose_camera_info(chain.cameras[0], chain.names[0])


def _parse_single(text: str, size: tuple[int, int] | None = None) -> CameraChain:
    info = parse_camera_info(text, size)
    return CameraChain(cameras=(info.camera,), names=(info.name,))


# ---------------------------------------------------------------------- Kalibr


def compose_camchain(chain: CameraChain) -> str:
    """Return the YAML of Kalibr's camchain; the cameras are ``cam0``, ``cam1``, ...

    Source: Kalibr's wiki, "YAML formats" (published): ``T_cn_cnm1`` leads from the previous camera
    into this one.

    Raises:
        CalibrationError: ``SHAPE``: a lens has k3, or a model that Kalibr does not have.
    """
    text = ""
    for index, (camera, name) in enumerate(zip(chain.cameras, chain.names, strict=True)):
        text += (
            f"cam{index}:\n"
            "  camera_model: pinhole\n"
            f"  intrinsics: {flow_list(camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])}\n"
            f"  distortion_model: {_KALIBR.get(camera.distortion_model, '')}\n"
            f"  distortion_coeffs: {flow_list(_kalibr_coefficients(camera))}\n"
        )
        if index:
            motion = chain.transforms[index - 1]
            text += "  T_cn_cnm1:\n"
            text += "".join(f"  - {flow_list(row)}\n" for row in matrix_rows(motion))
        text += f"  resolution: [{camera.size[0]}, {camera.size[1]}]\n"
        text += f"  rostopic: {quote(f'/{name}/image_raw')}\n"
    return text


def _kalibr_coefficients(camera: CameraModel) -> Array:
    """Return the coefficients of a lens in Kalibr's model."""
    if camera.distortion_model not in _KALIBR:
        raise _unsupported_error("kalibr", " or ".join(_KALIBR), camera.distortion_model)
    if camera.distortion[_RADTAN_COUNT:].any():
        raise _unsupported_error(
            "kalibr", "k3 = 0 (calibrate with fixed=['k3'])", f"{camera.distortion[4]:g}"
        )
    return camera.distortion[:_RADTAN_COUNT]


# ---------------------------------------------------------------------- OpenCV


def compose_opencv(chain: CameraChain) -> str:
    """Return YAML for ``cv2.FileStorage``: ``camera_matrix`` for one camera, M1, D1, ... for two.

    Source: OpenCV's samples ``calibration`` and ``stereo_calib`` (published): R and T lead from the
    first camera to the second.

    Raises:
        CalibrationError: ``SHAPE``: there are more than two cameras, or they have different sizes
            or models.
    """
    first = chain.cameras[0]
    head = (
        f"{HEAD}image_width: {first.size[0]}\nimage_height: {first.size[1]}\n"
        f"distortion_model: {quote(first.distortion_model)}\n"
        f"fisheye_model: {int(first.distortion_model == 'equidistant')}\n"
        'unit: "m"\n'
    )
    if len(chain.cameras) == 1:
        return (
            head
            + storage_matrix("camera_matrix", first.matrix)
            + storage_matrix("distortion_coefficients", first.distortion[:, None])
        )
    if len(chain.cameras) > len(_MATRICES):
        raise _unsupported_error("opencv", "one camera or two", f"{len(chain.cameras)}")
    first_kind, *others = (
        f"{camera.size} pixels and {camera.distortion_model}" for camera in chain.cameras
    )
    if any(other != first_kind for other in others):
        raise _unsupported_error("opencv", f"cameras of {first_kind}", others[0])
    motion = chain.transforms[0]
    return (
        head
        + "".join(
            storage_matrix(matrix, camera.matrix)
            + storage_matrix(coefficients, camera.distortion[None])
            for camera, (matrix, coefficients) in zip(chain.cameras, _MATRICES, strict=True)
        )
        + storage_matrix("R", motion.rotation)
        + storage_matrix("T", motion.translation[:, None])
    )


def parse_opencv(
    text: str, size: tuple[int, int] | None = None, extrinsics: str = ""
) -> UnscaledValue[CameraChain]:
    """Return the cameras of a file of OpenCV's calibration samples and tutorials, YAML or XML.

    Names are read in any case, with or without ``_``. If the file does not name the model, the
    model is ``equidistant`` if the file has ``fisheye_model: 1``, ``rational_polynomial`` if there
    are eight coefficients or one beyond the fifth is not 0, and else ``plumb_bob``. ``extrinsics``:
    the text of the file with R and T.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``, ``NOT_RIGID``, ``SHAPE``, ``WRONG_SIZE``.
        MissingExtraError: PyYAML is not installed.
    """
    data = _normalize_names(load_storage(text))
    if extrinsics:
        data = {**_normalize_names(load_storage(extrinsics)), **data}
    endings = next(
        (
            endings_of_pair
            for endings_of_pair in _NAME_ENDINGS
            if _first_value(data, _MATRIX_NAMES, endings_of_pair[0])
        ),
        None,
    )
    stated = [data[key] for key in ("imagewidth", "imageheight") if key in data]
    image_size = _first_value(data, ("imagesize", "size"), "", [])
    size = _choose_size(stated or as_list(image_size, "image_size"), size)
    if endings is None:
        camera = _opencv_camera(data, size, "")
        return UnscaledValue(CameraChain(cameras=(camera,), names=("camera",)), "m")
    cameras = tuple(_opencv_camera(data, size, ending) for ending in endings)
    if not {"r", "t"} <= data.keys():
        raise malformed_error(
            "file",
            "R and T from the first camera to the second; where they are in a file of their own, "
            'as OpenCV\'s extrinsics.yml, give it as extrinsics="extrinsics.yml"',
            ", ".join(data),
        )
    rotation, shift = stored_matrix(data["r"], "R", (3, 3)), stored_matrix(data["t"], "T").ravel()
    if len(shift) != 3:
        raise malformed_error("T", "3 numbers", str(len(shift)))
    rows = [*np.column_stack([rotation, shift]), [0.0, 0.0, 0.0, 1.0]]
    motion = rigid_transform("right", "left", rows, "R")
    chain = CameraChain(cameras=cameras, transforms=(motion,), names=("left", "right"))
    return UnscaledValue(chain, data.get("unit"))


_MATRIX_NAMES: Final = ("cameramatrix", "intrinsicmatrix", "k", "m")
_DISTORTION_NAMES: Final = (
    "distortioncoefficients",
    "distcoeffs",
    "distcoeff",
    "distcoefs",
    "distortion",
    "d",
)
_NAME_ENDINGS: Final = (("1", "2"), ("left", "right"), ("l", "r"))
"""Endings of the names of matrices and coefficients that distinguish two cameras."""


def _normalize_names(data: Plain) -> dict[str, Plain]:
    """Return a mapping whose names are changed to lower case, without ``_``."""
    normal: dict[str, Plain] = {}
    for name, value in as_mapping(data, "file").items():
        key = name.lower().replace("_", "")
        if key in normal:
            raise malformed_error("file", "each name once", name)
        normal[key] = value
    return normal


def _first_value(
    data: dict[str, Plain], names: Sequence[str], ending: str, other: Plain = None
) -> Plain:
    """Return the value of the first name that the mapping has, or ``other``."""
    return next((data[f"{name}{ending}"] for name in names if f"{name}{ending}" in data), other)


def _opencv_camera(data: dict[str, Plain], size: tuple[int, int], ending: str) -> CameraModel:
    for names in (_MATRIX_NAMES, _DISTORTION_NAMES):
        if _first_value(data, names, ending) is None:
            expected = (
                f"{names[0]}{ending} (or {', '.join(f'{name}{ending}' for name in names[1:])})"
            )
            raise malformed_error("file", expected, ", ".join(data))
    matrix = stored_matrix(
        _first_value(data, _MATRIX_NAMES, ending), f"camera matrix {ending}".rstrip(), (3, 3)
    )
    coefficients = stored_matrix(
        _first_value(data, _DISTORTION_NAMES, ending), f"coefficients {ending}".rstrip()
    ).ravel()
    name = data.get("distortionmodel")
    if name is None:
        is_rational = len(coefficients) == 8 or coefficients[5:].any()
        name = "rational_polynomial" if is_rational else "plumb_bob"
        if data.get("fisheyemodel") == "1":
            name = "equidistant"
    return _make_camera(size, matrix, coefficients, _parse_model(name, coefficients))


# ---------------------------------------------------------------------- table of formats


def _camera_format(
    name: CameraForm,
    parse: Callable[..., CameraChain | UnscaledValue[CameraChain]],
    compose: Callable[[CameraChain], str] | None = None,
) -> Format[CameraChain]:
    return Format(
        title=name, suffix=".yaml", parse=parse, compose=compose, max_bytes=MAX_CAMERA_FILE_BYTES
    )


def _foreign_format(
    name: CameraForm,
    parse: Callable[[str], foreign.FoundLenses],
    compose: Callable[[CameraChain], str] | None = None,
) -> Format[CameraChain]:
    """Return a format for a parser that returns lenses in the units of the file."""

    def parse_chain(
        text: str, given_size: tuple[int, int] | None = None
    ) -> CameraChain | UnscaledValue[CameraChain]:
        lenses, transforms, unit = parse(text)
        if not 1 <= len(lenses) <= foreign.MAX_CAMERAS:
            raise malformed_error("file", f"1 to {foreign.MAX_CAMERAS} cameras", str(len(lenses)))
        if len(transforms) != len(lenses) - 1:
            raise malformed_error("file", "one camera, since it has no poses", str(len(lenses)))
        cameras = []
        for lens in lenses:
            matrix, size = lens_matrix(*lens.intrinsics), _choose_size(lens.size or [], given_size)
            cameras.append(_make_camera(size, matrix, np.array(lens.coefficients), lens.model))
        names = tuple(lens.name for lens in lenses)
        chain = CameraChain(cameras=tuple(cameras), transforms=tuple(transforms), names=names)
        return chain if unit == foreign.METRES_BY_FORMAT else UnscaledValue(chain, unit)

    return _camera_format(name, parse_chain, compose)


FORMS: Final[Mapping[str, Format[CameraChain]]] = {
    "camera_info": _camera_format("camera_info", _parse_single, _compose_single),
    "kalibr": _foreign_format("kalibr", foreign.parse_camchain, compose_camchain),
    "opencv": _camera_format("opencv", parse_opencv, compose_opencv),
    "ros_ini": _foreign_format("ros_ini", foreign.parse_ros_ini),
    "euroc": _foreign_format("euroc", foreign.parse_euroc),
    "mrcal": dataclasses.replace(
        _foreign_format("mrcal", foreign.parse_mrcal), max_bytes=MAX_FILE_BYTES
    ),
    "colmap": _foreign_format("colmap", foreign.parse_colmap),
    "basalt": _foreign_format("basalt", foreign.parse_basalt),
    "multical": _foreign_format("multical", foreign.parse_multical),
}
"""Formats of cameras by their names."""


def _unsupported_error(form: str, expected: str, actual: str) -> CalibrationError:
    return Code.SHAPE.error_with_value(
        f"{form}: expected {expected}, since the format can hold no more", expected, actual
    )


def _choose_size(stated: Sequence[Plain], given_size: tuple[int, int] | None) -> tuple[int, int]:
    """Return width and height, pixels: the file's, or those that the user gives."""
    if not stated:
        if given_size is None:
            raise Code.WRONG_SIZE.error(
                "file: expected width and height of the images, which the file lacks; give them "
                "as size=(width, height), pixels",
                "size=(width, height)",
            )
        return int(given_size[0]), int(given_size[1])
    width, height = (
        as_whole_number(length, "size of the images") for length in as_list([*stated], "size", 2)
    )
    if given_size is not None and (width, height) != tuple(given_size):
        raise Code.WRONG_SIZE.error(
            f"size: the file says {width} x {height}, got {given_size[0]} x {given_size[1]}",
            (width, height),
            tuple(given_size),
        )
    return width, height


def _parse_model(name: Plain, coefficients: Array) -> DistortionModel:
    for model in COEFFICIENT_COUNTS:
        if model == name:
            return model
    if not len(coefficients) and name in {"", "none"}:
        return "plumb_bob"
    raise malformed_error("distortion_model", ", ".join(COEFFICIENT_COUNTS), name)


def _make_camera(
    size: tuple[int, int], matrix: Array, coefficients: Array, model: DistortionModel
) -> CameraModel:
    """Return a lens; missing coefficients at the end are 0, and surplus coefficients must be 0."""
    count = COEFFICIENT_COUNTS[model]
    short_counts = {"plumb_bob": {0, 4}}.get(model, {0})
    if len(coefficients) in short_counts:
        coefficients = np.concatenate([coefficients, np.zeros(count - len(coefficients))])
    if len(coefficients) > count and not coefficients[count:].any():
        coefficients = coefficients[:count]
    return CameraModel(size=size, matrix=matrix, distortion=coefficients, distortion_model=model)
