"""Parse files of other programs into plain data, up to a size, and without guessing types.

Scalars stay texts, as they are in the file. YAML gives texts many meanings (a time, a number to the
base 60, ``1e-05`` as a string), and programs differ in the meanings that they support.
:func:`as_number` and :func:`as_flag` read only the forms that all programs share. Anything else
raises a CalibrationError, ``MALFORMED`` if no other code is named.
"""

from __future__ import annotations

import json
import math
import re
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

import numpy as np

from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code
from smartcam.layout._inside import BadYamlError, compose

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.geometry._inside import Array

T = TypeVar("T")

Plain: TypeAlias = Any
"""A text, or nested lists and mappings of texts; whoever uses the value checks its type."""

POSE: tuple[str, ...] = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Names of the numbers of :func:`pose_numbers` in most formats."""

MAX_DEPTH = 16
"""Largest depth of nested lists in a file; poses need a depth of five."""

MAX_NUMBER = 1e9
"""Largest number of a pose, in metres or any other unit: no robot is farther away, and the square
of this number is still finite."""

MAX_SIDE = 1_000_000
"""Largest side of an image, pixels, and largest number of rows or columns of a matrix."""

_MAX_NAME = 255
_MAX_SHOWN = 64
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,4})?")
_NOT_FINITE = re.compile(r"[-+]?\.?(?:nan|inf|infinity)", re.IGNORECASE)
_NAME = re.compile(r"[\w/][\w./+-]*")
_FLAGS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_MAX_PRINTED_DEVIATION = 1e-4
"""Largest deviation from a rotation of a matrix that was printed with few digits."""
_MAX_EXACT_DEVIATION = 1e-6
"""Largest deviation from a rotation of a matrix that is not corrected; :class:`Transform` has the
same bound."""


def malformed_error(label: str, expected: str, actual: object = None) -> CalibrationError:
    """Return the error for a text that does not have its format; ``actual`` is shortened."""
    shown = None if actual is None else _shorten(actual)
    text = f"{label}: expected {expected}" + ("" if shown is None else f", got {shown}")
    return Code.MALFORMED.error(text, expected, shown)


def add_place(where: str, error: CalibrationError) -> CalibrationError:
    """Return the error with a place in the file added to its text."""
    return CalibrationError(
        f"{where}: {error}", code=error.code, expected=error.expected, got=error.got
    )


def look_up(table: Mapping[str, T], name: str, label: str = "format") -> T:
    """Return a table's value for a name; raise ``UNKNOWN_FORMAT`` if there is none."""
    if not isinstance(name, str) or name not in table:
        raise Code.UNKNOWN_FORMAT.error(
            f"no {label} is called {name!r}; expected one of {', '.join(table)}", list(table), name
        )
    return table[name]


def _shorten(value: object) -> str:
    """Return a short text for a value from a file, however large it is."""
    if isinstance(value, (dict, list)):
        kind = "mapping" if isinstance(value, dict) else "list"
        return f"a {kind} of {len(cast('Sequence[object]', value))}"
    text = repr(value[: _MAX_SHOWN + 1] if isinstance(value, str) else value)
    return text if len(text) <= _MAX_SHOWN + 2 else f"{text[:_MAX_SHOWN]}..."


# ---------------------------------------------------------------------- reading


def load_json(text: str) -> Plain:
    """Parse JSON, with numbers as texts; raise MALFORMED if it is not valid or too deep."""
    try:
        return json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
    except (ValueError, RecursionError) as exc:
        raise malformed_error("file", f"JSON ({exc})") from exc


def load_yaml(text: str) -> Plain:
    """Parse YAML, also OpenCV's; scalars become texts, and tags are dropped.

    Raises ``MALFORMED`` if it is no valid YAML, has aliases or a repeated key, or is too deep;
    MissingExtraError: PyYAML is not installed.
    """
    if text.startswith("%YAML:"):  # OpenCV's spelling of a directive
        text = text.partition("\n")[2]
    try:
        root = compose(text, label="reading YAML")
        return None if root is None else _as_plain(root, set(), 0)
    except BadYamlError as exc:
        raise malformed_error("file", f"YAML ({_shorten(str(exc))})") from exc


def _as_plain(node: Any, seen: set[int], depth: int) -> Plain:
    line = f"line {node.start_mark.line + 1}"
    if node.id == "scalar":
        return str(node.value)
    if id(node) in seen or depth >= MAX_DEPTH:
        raise malformed_error(line, f"no alias, and at most {MAX_DEPTH} lists in lists")
    seen.add(id(node))
    if node.id == "sequence":
        return [_as_plain(item, seen, depth + 1) for item in node.value]
    plain: dict[str, Plain] = {}
    for key, value in node.value:
        name = str(key.value) if key.id == "scalar" else ""
        if not name or name in plain:
            raise malformed_error(line, "keys that are texts, each once", name)
        plain[name] = _as_plain(value, seen, depth + 1)
    return plain


def as_mapping(value: Plain, where: str, keys: Sequence[str] = ()) -> dict[str, Plain]:
    """Return a value that must be a mapping with these keys; other keys are allowed."""
    if not isinstance(value, dict):
        raise malformed_error(where, "a mapping", value)
    fields = cast("dict[str, Plain]", value)
    missing = [key for key in keys if key not in fields]
    if missing:
        raise malformed_error(where, f"the keys {', '.join(keys)}", ", ".join(fields) or "none")
    return fields


def as_list(value: Plain, where: str, count: int | None = None) -> list[Plain]:
    """Return a value that must be a list, of ``count`` items unless None."""
    items: list[Plain] | None = value if isinstance(value, list) else None
    if items is None or count not in {None, len(items)}:
        raise malformed_error(where, "a list" if count is None else f"a list of {count}", value)
    return items


def as_number(value: Plain, where: str) -> float:
    """Return a number of at most :data:`MAX_NUMBER`.

    Raises ``MALFORMED``, or ``NOT_FINITE`` for NaN, infinity and larger numbers.
    """
    text = value if isinstance(value, str) else ""
    parsed = math.nan if _NOT_FINITE.fullmatch(text) else None
    if len(text) <= _MAX_SHOWN and _NUMBER.fullmatch(text):
        parsed = float(text)
    if parsed is None:
        raise malformed_error(where, "a number", value)
    if not abs(parsed) <= MAX_NUMBER:
        raise Code.NOT_FINITE.error(
            f"{where}: expected a number of at most {MAX_NUMBER:g}, got {_shorten(text)}",
            MAX_NUMBER,
            text,
        )
    return parsed


def as_numbers(value: Plain, where: str, count: int | None = None) -> list[float]:
    """Return the numbers of a value that must be a list, of ``count`` items unless None."""
    return [as_number(item, where) for item in as_list(value, where, count)]


def as_matrix(value: Plain, where: str, shape: tuple[int, int]) -> Array:
    """Return a matrix that is stored as a list of rows."""
    rows = as_list(value, where, shape[0])
    return np.array([as_numbers(line, where, shape[1]) for line in rows]).reshape(shape)


def stored_matrix(value: Plain, where: str, shape: tuple[int, int] | None = None) -> Array:
    """Read a matrix from ``rows``, ``cols`` and ``data``; ``shape``: None for any shape."""
    data = as_mapping(value, where, ["rows", "cols", "data"])
    rows, cols = (as_whole_number(data[key], f"{where}.{key}", 0) for key in ("rows", "cols"))
    if shape is not None and shape != (rows, cols):
        raise malformed_error(where, f"{shape[0]} rows and {shape[1]} cols", f"{rows} {cols}")
    return np.array(as_numbers(data["data"], where, rows * cols)).reshape(rows, cols)


def as_whole_number(value: Plain, where: str, least: int = 1) -> int:
    """Return a whole number of pixels, rows or columns."""
    if not (isinstance(value, str) and value.isdecimal() and len(value) < 8):
        raise malformed_error(where, "a whole number", value)
    if not least <= int(value) <= MAX_SIDE:
        raise malformed_error(where, f"{least} to {MAX_SIDE}", value)
    return int(value)


def lens_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return a lens' (3, 3) matrix."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def numbers_by_key(value: Plain, where: str, keys: Sequence[str]) -> list[float]:
    """Return the numbers of a mapping in the order of ``keys``; other keys are an error.

    ``where``: name of the mapping in the error.
    """
    fields = as_mapping(value, where, keys)
    if len(fields) != len(keys):
        raise malformed_error(where, f"the keys {', '.join(keys)} alone", ", ".join(fields))
    return [as_number(fields[key], f"{where}.{key}") for key in keys]


def as_flag(value: Plain, where: str) -> bool:
    """Return a truth value."""
    truth = _FLAGS.get(value.lower()) if isinstance(value, str) else None
    if truth is None:
        raise malformed_error(where, "true or false", value)
    return truth


def frame_name(value: Plain, where: str) -> str:
    """Return a frame's name that every format can hold.

    Raises ``BAD_NAME`` if the name is not valid or too long, or has letters with a meaning in files
    or on a command line.
    """
    if not (isinstance(value, str) and len(value) <= _MAX_NAME and _NAME.fullmatch(value)):
        raise Code.BAD_NAME.error_with_value(
            f"{where}: expected a frame's name of letters, digits and _ . / + -",
            _NAME.pattern,
            _shorten(value),
        )
    return value


def rigid_transform(
    target: str, source: str, rows: Sequence[Sequence[float]] | Array, where: str
) -> Transform:
    """Return the transform of a (4, 4) matrix, whose rotation may be printed with few decimals.

    Raises ``MALFORMED`` for a wrong last row; ``NOT_RIGID`` if the matrix has no rotation.
    """
    matrix = np.array(rows, dtype=np.float64)
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=_MAX_EXACT_DEVIATION):
        raise malformed_error(
            where, "a last row 0 0 0 1", " ".join(f"{value:g}" for value in matrix[3])
        )
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if _MAX_EXACT_DEVIATION <= error < _MAX_PRINTED_DEVIATION:
        rotation = _nearest_rotation(rotation)
    return Transform(target, source, rotation, matrix[:3, 3])


def _nearest_rotation(matrix: Array) -> Array:
    left, _, right = np.linalg.svd(matrix)
    # a reflection cannot be corrected: it is refused
    return np.asarray(left @ right, dtype=np.float64)


def transform_of_pose(target: str, source: str, pose: Sequence[float]) -> Transform:
    """Return the transform from the numbers of :data:`POSE`."""
    return Transform.from_quaternion(target, source, pose[:3], pose[3:])


def pose_numbers(transform: Transform) -> list[float]:
    """Return a transform as the numbers of :data:`POSE`, metres."""
    return [*transform.translation.tolist(), *transform.quaternion.tolist()]


def matrix_rows(transform: Transform) -> list[list[float]]:
    """Return the (4, 4) matrix of a transform, metres, row by row."""
    rows = np.column_stack([transform.rotation, transform.translation]).tolist()
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


# ---------------------------------------------------------------------- writing


def quote(text: str) -> str:
    """Return a text in the quotes of YAML and JSON."""
    return '"{}"'.format(text.replace("\\", "\\\\").replace('"', '\\"'))


def format_real(value: float) -> str:
    """Return a real number in the form of YAML 1.1: with a point, also before an exponent."""
    mantissa, exponent_mark, exponent = repr(float(value)).partition("e")
    if not exponent_mark:
        return mantissa
    sign = "" if exponent.startswith("-") else "+"
    return f"{mantissa if '.' in mantissa else f'{mantissa}.0'}e{sign}{exponent.lstrip('+')}"


def flow_list(values: Sequence[float] | Array) -> str:
    """Return a YAML list of numbers in one line."""
    return "[ {} ]".format(", ".join(format_real(float(value)) for value in values))


def block_mapping(values: Mapping[str, float], indent: str = "") -> str:
    """Return a YAML mapping of numbers, one per line."""
    return "".join(f"{indent}{name}: {format_real(value)}\n" for name, value in values.items())
