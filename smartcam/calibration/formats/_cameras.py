"""Lenses and pairs in files of other programs: ROS' ``camera_info``, Kalibr's camchain, OpenCV's.

::

    write_cameras("camchain.yaml", "kalibr", CameraChain.of(calibration))
    camera = read_cameras("left.yaml", "camera_info").cameras[0]

All three count pixels from the middle of the upper left one, as smartcam does. Lengths are metres.
The number of coefficients that is written follows from the model, and so does what is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._files.store import replace_file
from smartcam.calibration._lens.model import COEFFICIENTS, CameraModel
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration.formats._file_format import Format, named
from smartcam.calibration.formats._opencv import HEAD
from smartcam.calibration.formats._plain import (
    Plain,
    known,
    load_yaml,
    malformed,
    mapping,
    matrix_rows,
    number,
    quoted,
    real,
    rigid,
    sequence,
)
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.calibration._geometry.frames import Transform
    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
    from smartcam.calibration._lens.model import DistortionModel

CameraForm: TypeAlias = Literal["camera_info", "kalibr", "opencv"]
"""Names of the formats."""

MAX_FILE: Final = 1 << 20
"""Bytes of a file at most; a chain of eight cameras has four thousand."""

MAX_CAMERAS: Final = 64
"""Cameras of a chain at most."""

MAX_SIDE: Final = 1_000_000
"""Pixels of an image's side at most."""

_KALIBR: Final[dict[DistortionModel, str]] = {"plumb_bob": "radtan", "equidistant": "equidistant"}
_RADTAN: Final = 4
"""k1, k2, p1, p2: Kalibr has no k3."""

_MATRICES: Final = (("M1", "D1"), ("M2", "D2"))
"""Names of both cameras' matrices in OpenCV's sample ``stereo_calib``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraChain:
    """Cameras, each where the one before it sees it.

    Attributes:
        cameras: the lenses, one or more.
        transforms: from each camera's frame into the next one's: ``T_1_0``, ``T_2_1``, ...
        names: of the cameras.
    """

    cameras: tuple[CameraModel, ...]
    transforms: tuple[Transform, ...] = ()
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if not 0 < len(self.cameras) == len(self.transforms) + 1 == len(self.names):
            raise CalibrationError(
                "chain of cameras: expected a name for each of them and a transform between each "
                f"two, got {len(self.cameras)} cameras, {len(self.names)} names and "
                f"{len(self.transforms)} transforms",
                code=Code.SHAPE,
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
        name: of the camera.
        rectification: (3, 3), from the camera's frame into the rectified one.
        projection: (3, 4), of the rectified image, pixels.
    """

    camera: CameraModel
    name: str
    rectification: Array
    projection: Array


def read_cameras(path: str | os.PathLike[str], form: CameraForm) -> CameraChain:
    """Return the cameras of a file.

    Args:
        path: the file.
        form: ``camera_info``, ``kalibr`` or ``opencv``.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``, ``NOT_RIGID`` or ``SHAPE``: the file is not
            what its format says, or has a lens of another model; ``UNKNOWN_FORMAT``.
        MissingExtraError: PyYAML is not installed.
        OSError: it cannot be read.
    """
    return known(FORMS, form, "format of cameras").read(path)


def write_cameras(path: str | os.PathLike[str], form: CameraForm, chain: CameraChain) -> None:
    """Write cameras to a file, whole or not at all.

    Args:
        path: the file.
        form: ``camera_info`` for one camera, ``opencv`` for one or two, ``kalibr``.
        chain: the cameras.

    Raises:
        CalibrationError: ``SHAPE``: the format cannot hold so many cameras, or such a lens;
            ``UNKNOWN_FORMAT``;
            ``NOT_WRITTEN``: it cannot be written.
    """
    known(FORMS, form, "format of cameras").write(path, chain)


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
        name: of the camera.
        rectification: (3, 3), as :meth:`StereoCalibration.rectify` has it; None: none.
        projection: (3, 4), pixels and, for the right camera, pixels times metres; None: the lens
            without its distortion.

    Raises:
        CalibrationError: ``NOT_WRITTEN``: it cannot be written.
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

    Source: ROS, ``camera_calibration_parsers`` (published). ``cols`` of the coefficients is their
    number; readers that expect five misread files of eight (image_pipeline #278).
    """
    straight = np.column_stack([camera.matrix, np.zeros(3)])
    return (
        f"image_width: {camera.size[0]}\n"
        f"image_height: {camera.size[1]}\n"
        f"camera_name: {quoted(name)}\n"
        + _ros_matrix("camera_matrix", camera.matrix)
        + f"distortion_model: {camera.distortion_model}\n"
        + _ros_matrix("distortion_coefficients", camera.distortion[None])
        + _ros_matrix("rectification_matrix", np.eye(3) if rectification is None else rectification)
        + _ros_matrix("projection_matrix", straight if projection is None else projection)
    )


def _ros_matrix(name: str, matrix: Array) -> str:
    return (
        f"{name}:\n  rows: {matrix.shape[0]}\n  cols: {matrix.shape[1]}\n"
        f"  data: {_flow(matrix.ravel())}\n"
    )


def parse_camera_info(text: str) -> CameraInfo:
    """Return the camera of a ``camera_info``; four coefficients of ``plumb_bob`` mean k3 = 0.

    Raises ``MALFORMED``, ``NOT_FINITE``, ``SHAPE``; MissingExtraError: PyYAML is not installed.
    """
    needed = ["camera_matrix", "distortion_model", "distortion_coefficients"]
    data = mapping(load_yaml(text), "file", ["image_width", "image_height", *needed])
    matrix = _matrix(data["camera_matrix"], "camera_matrix", (3, 3))
    rectification, projection = np.eye(3), np.column_stack([matrix, np.zeros(3)])
    if "rectification_matrix" in data:
        rectification = _matrix(data["rectification_matrix"], "rectification_matrix", (3, 3))
    if "projection_matrix" in data:
        projection = _matrix(data["projection_matrix"], "projection_matrix", (3, 4))
    coefficients = _matrix(data["distortion_coefficients"], "distortion_coefficients").ravel()
    model = _model(data["distortion_model"], coefficients)
    camera = _camera(_size(data), matrix, coefficients, model)
    name = data.get("camera_name", "camera")
    if not isinstance(name, str):
        raise malformed("camera_name", "a text", name)
    return CameraInfo(camera, name, rectification, projection)


def _compose_one(chain: CameraChain) -> str:
    if len(chain.cameras) != 1:
        raise _cannot("camera_info", "one camera", f"{len(chain.cameras)}")
    return compose_camera_info(chain.cameras[0], chain.names[0])


def _parse_one(text: str) -> CameraChain:
    info = parse_camera_info(text)
    return CameraChain(cameras=(info.camera,), names=(info.name,))


# ---------------------------------------------------------------------- Kalibr


def compose_camchain(chain: CameraChain) -> str:
    """Return the YAML of Kalibr's camchain; the cameras are ``cam0``, ``cam1``, ...

    Source: Kalibr's wiki, "YAML formats" (published): ``T_cn_cnm1`` leads from the camera before.

    Raises:
        CalibrationError: ``SHAPE``: a lens with k3, or of a model that Kalibr does not have.
    """
    text = ""
    for number_, (camera, name) in enumerate(zip(chain.cameras, chain.names, strict=True)):
        text += (
            f"cam{number_}:\n"
            "  camera_model: pinhole\n"
            f"  intrinsics: {_flow(camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]])}\n"
            f"  distortion_model: {_KALIBR.get(camera.distortion_model, '')}\n"
            f"  distortion_coeffs: {_flow(_of_kalibr(camera))}\n"
        )
        if number_:
            motion = chain.transforms[number_ - 1]
            text += "  T_cn_cnm1:\n"
            text += "".join(f"  - {_flow(row)}\n" for row in matrix_rows(motion))
        text += f"  resolution: [{camera.size[0]}, {camera.size[1]}]\n"
        text += f"  rostopic: {quoted(f'/{name}/image_raw')}\n"
    return text


def _of_kalibr(camera: CameraModel) -> Array:
    """Return the coefficients that Kalibr has."""
    if camera.distortion_model not in _KALIBR:
        raise _cannot("kalibr", " or ".join(_KALIBR), camera.distortion_model)
    if camera.distortion[_RADTAN:].any():
        raise _cannot("kalibr", "k3 = 0 (calibrate with fixed=['k3'])", f"{camera.distortion[4]:g}")
    return camera.distortion[:_RADTAN]


def parse_camchain(text: str) -> CameraChain:
    """Return the cameras of a camchain.

    Raises ``MALFORMED``, ``NOT_FINITE``, ``NOT_RIGID``, ``SHAPE``; MissingExtraError: no PyYAML.
    """
    data = mapping(load_yaml(text), "file", ["cam0"])
    count = sum(key.startswith("cam") for key in data)
    if count > MAX_CAMERAS:
        raise malformed("file", f"{MAX_CAMERAS} cameras at most", str(count))
    needed = ["camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution"]
    names = tuple(f"cam{place}" for place in range(count))
    parts = [mapping(mapping(data, "file", names)[name], name, needed) for name in names]
    return CameraChain(
        cameras=tuple(_kalibr_camera(part, name) for part, name in zip(parts, names, strict=True)),
        transforms=tuple(
            _kalibr_transform(part, after, before)
            for part, before, after in zip(parts[1:], names[:-1], names[1:], strict=True)
        ),
        names=names,
    )


def _kalibr_camera(part: dict[str, Plain], name: str) -> CameraModel:
    if part["camera_model"] != "pinhole":
        raise malformed(f"{name}.camera_model", "pinhole", part["camera_model"])
    models: dict[str, DistortionModel] = {said: model for model, said in _KALIBR.items()}
    said = part["distortion_model"]
    if not (isinstance(said, str) and said in models):
        raise malformed(f"{name}.distortion_model", " or ".join(models), said)
    fx, fy, cx, cy = _numbers(part["intrinsics"], f"{name}.intrinsics", 4)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = np.array(_numbers(part["distortion_coeffs"], f"{name}.distortion_coeffs", 4))
    width, height = sequence(part["resolution"], f"{name}.resolution", 2)
    size = _side(width, f"{name}.resolution"), _side(height, f"{name}.resolution")
    return _camera(size, matrix, coefficients, models[said])


def _kalibr_transform(part: dict[str, Plain], target: str, source: str) -> Transform:
    where = f"{target}.T_cn_cnm1"
    rows = sequence(mapping(part, target, ["T_cn_cnm1"])["T_cn_cnm1"], where, 4)
    return rigid(target, source, [_numbers(row, where, 4) for row in rows], where)


# ---------------------------------------------------------------------- OpenCV


def compose_opencv(chain: CameraChain) -> str:
    """Return YAML for ``cv2.FileStorage``: ``camera_matrix`` of one camera, M1, D1, ... of two.

    Source: OpenCV's samples ``calibration`` and ``stereo_calib`` (published): R and T lead from the
    first camera to the second.

    Raises:
        CalibrationError: ``SHAPE``: more than two cameras, of different sizes or models.
    """
    first = chain.cameras[0]
    head = (
        f"{HEAD}image_width: {first.size[0]}\nimage_height: {first.size[1]}\n"
        f"distortion_model: {quoted(first.distortion_model)}\n"
        f"fisheye_model: {int(first.distortion_model == 'equidistant')}\n"
    )
    if len(chain.cameras) == 1:
        return (
            head
            + _opencv_matrix("camera_matrix", first.matrix)
            + _opencv_matrix("distortion_coefficients", first.distortion[:, None])
        )
    if len(chain.cameras) > len(_MATRICES):
        raise _cannot("opencv", "one camera or two", f"{len(chain.cameras)}")
    for camera in chain.cameras:
        if (tuple(camera.size), camera.distortion_model) != (
            tuple(first.size),
            first.distortion_model,
        ):
            raise _cannot(
                "opencv",
                f"cameras of {first.size} pixels and {first.distortion_model}",
                f"{camera.size} and {camera.distortion_model}",
            )
    motion = chain.transforms[0]
    return (
        head
        + "".join(
            _opencv_matrix(matrix, camera.matrix)
            + _opencv_matrix(coefficients, camera.distortion[None])
            for camera, (matrix, coefficients) in zip(chain.cameras, _MATRICES, strict=True)
        )
        + _opencv_matrix("R", motion.rotation)
        + _opencv_matrix("T", motion.translation[:, None])
    )


def _opencv_matrix(name: str, matrix: Array) -> str:
    return (
        f"{name}: !!opencv-matrix\n   rows: {matrix.shape[0]}\n   cols: {matrix.shape[1]}\n"
        f"   dt: d\n   data: {_flow(matrix.ravel())}\n"
    )


def parse_opencv(text: str) -> CameraChain:
    """Return the cameras of a file of OpenCV's calibration samples.

    Where it does not name the model, four or five coefficients are ``plumb_bob``, eight are
    ``rational_polynomial``, and four with ``fisheye_model: 1`` are ``equidistant``.

    Raises:
        CalibrationError: ``MALFORMED``, ``NOT_FINITE``, ``NOT_RIGID``, ``SHAPE``.
        MissingExtraError: PyYAML is not installed.
    """
    data = mapping(load_yaml(text), "file", ["image_width", "image_height"])
    size = _size(data)
    if "camera_matrix" in data or "M1" not in data:
        keys = ("camera_matrix", "distortion_coefficients")
        return CameraChain(cameras=(_opencv_camera(data, size, keys),), names=("camera",))
    cameras = [_opencv_camera(data, size, keys) for keys in _MATRICES]
    mapping(data, "file", ["R", "T"])
    rotation = _matrix(data["R"], "R", (3, 3))
    shift = _matrix(data["T"], "T").ravel()
    if len(shift) != 3:
        raise malformed("T", "3 numbers", str(len(shift)))
    rows = [*np.column_stack([rotation, shift]).tolist(), [0.0, 0.0, 0.0, 1.0]]
    motion = rigid("right", "left", rows, "R")
    return CameraChain(cameras=tuple(cameras), transforms=(motion,), names=("left", "right"))


def _opencv_camera(
    data: dict[str, Plain], size: tuple[int, int], keys: Sequence[str]
) -> CameraModel:
    mapping(data, "file", keys)
    matrix = _matrix(data[keys[0]], keys[0], (3, 3))
    coefficients = _matrix(data[keys[1]], keys[1]).ravel()
    said = data.get("distortion_model")
    if said is None:
        by_count: dict[int, DistortionModel] = {8: "rational_polynomial"}
        fisheye = data.get("fisheye_model") == "1"
        said = "equidistant" if fisheye else by_count.get(len(coefficients), "plumb_bob")
    return _camera(size, matrix, coefficients, _model(said, coefficients))


# ---------------------------------------------------------------------- all


def _form(
    name: CameraForm, compose: Callable[[CameraChain], str], parse: Callable[[str], CameraChain]
) -> Format[CameraChain]:
    return Format(title=name, suffix=".yaml", parse=named(parse), compose=compose, most=MAX_FILE)


FORMS: Final[Mapping[str, Format[CameraChain]]] = {
    "camera_info": _form("camera_info", _compose_one, _parse_one),
    "kalibr": _form("kalibr", compose_camchain, parse_camchain),
    "opencv": _form("opencv", compose_opencv, parse_opencv),
}
"""The formats by their names."""


def _cannot(form: str, expected: str, got: str) -> CalibrationError:
    return CalibrationError(
        f"{form}: expected {expected}, which is all it can hold, got {got}",
        code=Code.SHAPE,
        expected=expected,
        got=got,
    )


def _flow(values: Sequence[float] | Array) -> str:
    return "[ {} ]".format(", ".join(real(float(value)) for value in values))


def _numbers(value: Plain, where: str, count: int) -> list[float]:
    return [number(one, where) for one in sequence(value, where, count)]


def _matrix(value: Plain, where: str, shape: tuple[int, int] | None = None) -> Array:
    """Return a matrix of rows, cols and data; None: of any shape."""
    data = mapping(value, where, ["rows", "cols", "data"])
    rows, cols = (_side(data[key], f"{where}.{key}", least=0) for key in ("rows", "cols"))
    if shape not in {None, (rows, cols)}:
        raise malformed(where, f"{shape} rows and cols", f"{rows}, {cols}")
    values = [number(one, where) for one in sequence(data["data"], where)]
    if len(values) != rows * cols:
        raise malformed(where, f"{rows * cols} numbers for {rows} x {cols}", str(len(values)))
    return np.array(values, dtype=np.float64).reshape(rows, cols)


def _side(value: Plain, where: str, least: int = 1) -> int:
    if not (isinstance(value, str) and value.isdecimal() and len(value) < 8):
        raise malformed(where, "a whole number", value)
    if not least <= int(value) <= MAX_SIDE:
        raise malformed(where, f"{least} to {MAX_SIDE}", value)
    return int(value)


def _size(data: dict[str, Plain]) -> tuple[int, int]:
    return _side(data["image_width"], "image_width"), _side(data["image_height"], "image_height")


def _model(said: Plain, coefficients: Array) -> DistortionModel:
    for model in COEFFICIENTS:
        if model == said:
            return model
    if not len(coefficients) and said in {"", "none"}:
        return "plumb_bob"
    raise malformed("distortion_model", ", ".join(COEFFICIENTS), said)


def _camera(
    size: tuple[int, int], matrix: Array, coefficients: Array, model: DistortionModel
) -> CameraModel:
    """Return a lens; missing coefficients at the end are 0, and so must be those too many."""
    count = COEFFICIENTS[model]
    short = {"plumb_bob": {0, 4}}.get(model, {0})
    if len(coefficients) in short:
        coefficients = np.concatenate([coefficients, np.zeros(count - len(coefficients))])
    if len(coefficients) > count and not coefficients[count:].any():
        coefficients = coefficients[:count]
    return CameraModel(size=size, matrix=matrix, distortion=coefficients, distortion_model=model)
