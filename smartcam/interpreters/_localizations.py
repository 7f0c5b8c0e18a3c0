"""Interpret results as localizations: parts that the camera found, with their poses."""

from __future__ import annotations

import functools
import itertools
import math
import operator
from itertools import repeat
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

from smartcam.exceptions import ConfigurationError
from smartcam.interpreters._base import PlainInterpreter
from smartcam.layout._inside import UNITS, misfit_error, split_rows
from smartcam.models import Header, Localization, Pose, PoseSigma, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from smartcam.interpreters._base import Context
    from smartcam.layout import Layout
    from smartcam.layout._inside import Field

_DEFAULTS: dict[str, Any] = {
    "feature_id": b"",
    "quality": 1.0,
    "photo_index": 0,
    "x": 0.0,
    "y": 0.0,
    "theta": 0.0,
}
"""Defaults of the fields that a layout may leave out, except ``z``.

Their order is as in the default layout.
"""

_QUANTITIES = {
    "quality": ("ratio",),
    "x": ("length", "pixels"),
    "y": ("length", "pixels"),
    "z": ("length", "pixels"),
    "theta": ("angle",),
    "sigma_x": ("length", "pixels"),
    "sigma_y": ("length", "pixels"),
    "sigma_theta": ("angle",),
}
"""Quantities that a field's unit may measure, by the field's name."""

_POSE = ("x", "y", "z", "theta")

_SIGMAS = ("sigma_x", "sigma_y", "sigma_theta")
"""Fields with the standard deviations of a pose; ``pose.sigma`` needs all three."""

_CORRELATIONS = ("correlation_xy", "correlation_xt", "correlation_yt")
"""Optional fields with correlations between a pose's errors; a missing one counts as 0."""

MAX_QUALITY = 1.0 + 1e-6
"""Largest quality: 1, with room for the rounding of a 32-bit float."""

MAX_CORRELATION = MAX_QUALITY
"""Largest absolute value of a correlation, with the same room."""

MAX_NAMES = 64
"""Largest number of feature names that are kept as texts. An application has a handful, but a peer
could send any number."""

# takes half the time of a NamedTuple's own constructor; cast, since a bare tuple is generic
_new_tuple = cast("Callable[..., Any]", tuple.__new__)  # pyright: ignore[reportUnknownMemberType]


class LocalizationsInterpreter(PlainInterpreter):
    """Reads one :class:`~smartcam.Localization` for each found part: feature, quality, pose.

    Args:
        layout: ``x`` and ``y`` must be in its records. Without ``feature_id`` it is ``""``,
            without ``quality`` 1.0 (the camera reported the part as found), without
            ``photo_index``, ``z`` or ``theta`` 0. ``sigma_x``, ``sigma_y`` and ``sigma_theta``,
            and the optional ``correlation_xy``, ``correlation_xt`` and ``correlation_yt``
            become ``pose.sigma``. Other fields are ignored. Lengths without a unit are metres,
            angles radians; ``px`` stays pixels.

    Raises:
        ConfigurationError: ``x`` or ``y`` is missing, or a field has a type or a unit that it
            cannot have.
    """

    default_layout: ClassVar[str | None] = (
        "(feature_id: string[50], quality: real32, photo_index: int32, "
        "x: real32, y: real32, theta: real32)*"
    )
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def __init__(self, layout: Layout | None = None) -> None:
        super().__init__(layout)
        names = {field.name for field in self.layout.fields}
        for name in ("x", "y"):
            if name not in names:
                raise ConfigurationError(
                    f"interpreter localizations: expected a field {name!r} in the layout, "
                    f"got '{self.layout}'"
                )
        field_use = _field_use(self.layout.fields)
        self._defaults = repeat(field_use.defaults) if field_use.defaults else None
        self._reorder = field_use.reorder
        self._z_index = field_use.z_index
        self._scales = field_use.scales
        self._checks_unused = field_use.checks_unused
        self._sigmas = field_use.sigmas
        self._is_unusual = (
            field_use.z_index is not None or field_use.checks_unused or field_use.sigmas is not None
        )
        self._empty_record = bytes(self.layout.size)
        self._names: dict[bytes, str] = {}  # names of features, by their bytes on the wire

    def read(self, data: bytes, context: Context) -> list[Localization]:
        """Return the parts in the camera's order.

        A record of zero bytes is an unused slot of the camera's array (HALCON script manual p. 11,
        published): it is skipped and counted in ``context.empty_slots``.

        Raises:
            InterpretationError: the bytes do not fit the layout, a pose has NaN or infinity, or a
                quality is not between 0 and 1.
        """
        header = _new_tuple(Header, (context.number, context.received_at, context.camera))
        sin, cos, new = math.sin, math.cos, _new_tuple
        scales, y_down, max_quality, names = self._scales, context.y_down, MAX_QUALITY, self._names
        rows: Iterable[Any] = self.layout.wire_records(data, context.byte_order)
        if self._defaults is not None:
            rows = map(operator.concat, rows, self._defaults)
        if self._reorder is not None:
            rows = map(self._reorder, rows)
        z_values = self._wire_z_values(data, context) if self._z_index is not None else None
        total, skipped, z = 0.0, 0, 0.0
        parts: list[Localization] = []
        try:
            for text, quality, photo_index, x, y, theta in rows:
                if z_values is not None:
                    z = next(z_values)
                if not x and self._is_empty(data, len(parts) + skipped):
                    skipped += 1
                    continue
                if scales is not None:
                    quality, x, y, theta, z = _to_si((quality, x, y, theta, z), scales)
                if not 0.0 <= quality <= max_quality:
                    self._check_numbers(data, context)
                if y_down:
                    y, theta = 0.0 - y, 0.0 - theta  # avoids minus zero
                total += x + y + theta + z
                half = 0.5 * theta
                orientation = new(Quaternion, (0.0, 0.0, sin(half), cos(half)))
                pose = new(Pose, (header, new(Position, (x, y, z)), orientation))
                feature_id = names.get(text)
                if feature_id is None:
                    feature_id = self._feature_name(text)
                parts.append(new(Localization, (feature_id, quality, photo_index, pose)))
        except ValueError:  # a text that is not UTF-8, the sine of infinity
            self._check_numbers(data, context)
            raise
        if not math.isfinite(total):  # but large, valid numbers may sum up to infinity
            self._check_numbers(data, context)
        elif self._checks_unused:
            self.layout.parse_records(data, context.byte_order)
        if skipped:
            context.empty_slots += skipped
        return parts if self._sigmas is None else self._add_sigmas(parts, data, context)

    def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
        """Return the parts of each container; read them by columns if the layout allows it."""
        unpacked = (
            None if self._is_unusual else self.layout.wire_rows(containers, context.byte_order)
        )
        parts = None if unpacked is None else self._read_columns(*unpacked, context)
        if unpacked is None or parts is None:
            return super().read_all(containers, context)
        context.number += len(containers)
        return split_rows(parts, unpacked[1])

    def _read_columns(
        self, rows: Iterable[Any], counts: list[int], context: Context
    ) -> list[Localization] | None:
        """Return the parts of all containers; None if a part is empty or invalid, or none came.

        ``counts``: number of rows of each container.
        """
        if self._defaults is not None:
            rows = map(operator.concat, rows, self._defaults)
        if self._reorder is not None:
            rows = map(self._reorder, rows)
        columns: list[Sequence[Any]] = list(zip(*rows, strict=True))
        if not columns:
            return None
        texts, quality, photo_index, x, y, theta = columns
        if not all(x):
            return None
        if self._scales is not None:
            scales = zip((quality, x, y, theta), *self._scales, strict=False)
            quality, x, y, theta = (
                [value * factor / divisor for value in column] for column, factor, divisor in scales
            )
        if context.y_down:
            # a difference, since a negation would give minus zero
            y, theta = ([0.0 - value for value in column] for column in (y, theta))
        total = sum(quality) + sum(x) + sum(y) + sum(theta)  # not finite if one is not
        if not math.isfinite(total) or min(quality) < 0.0 or max(quality) > MAX_QUALITY:
            return None
        feature_ids: list[str | None] = list(map(self._names.get, texts))
        if None in feature_ids:
            feature_ids = list(map(self._feature_name, texts))
        new, zeros, half = _new_tuple, repeat(0.0), [0.5 * angle for angle in theta]
        numbers = range(context.number, context.number + len(counts))
        header_values = zip(
            numbers, repeat(context.received_at), repeat(context.camera), strict=False
        )
        headers: Iterable[Any] = map(new, repeat(Header), header_values)
        if counts.count(1) != len(counts):
            headers = itertools.chain.from_iterable(map(repeat, headers, counts))
        positions = map(new, repeat(Position), zip(x, y, zeros, strict=False))
        quaternions = zip(zeros, zeros, map(math.sin, half), map(math.cos, half), strict=False)
        orientations = map(new, repeat(Quaternion), quaternions)
        poses = map(new, repeat(Pose), zip(headers, positions, orientations, strict=True))
        part_values = zip(feature_ids, quality, photo_index, poses, strict=True)
        return list(map(new, repeat(Localization), part_values))

    def _feature_name(self, text: bytes) -> str:
        """Return the name of a feature; the first names are kept."""
        name = self._names.get(text)
        if name is None:
            name = text.partition(b"\0")[0].decode()
            if len(self._names) < MAX_NAMES:
                self._names[text] = name
        return name

    def _add_sigmas(
        self, localizations: list[Localization], data: bytes, context: Context
    ) -> list[Localization]:
        """Return the localizations, with standard deviations in the poses where they are valid."""
        use = cast("_SigmaUse", self._sigmas)
        rows = self.layout.wire_records(data, context.byte_order)
        used_rows = [row for number, row in enumerate(rows) if not self._is_empty(data, number)]
        result: list[Localization] = []
        for part, row in zip(localizations, used_rows, strict=True):
            x, y, theta = (row[index] * scale for index, scale in use.sigmas)
            xy, xt, yt = (0.0 if index is None else row[index] for index in use.correlations)
            if context.y_down:
                xy, xt = -xy, -xt
            sigma = PoseSigma(x, y, theta, xy, xt, yt)
            is_known = min(x, y, theta) >= 0 and math.isfinite(x + y + theta)
            if is_known and max(abs(xy), abs(xt), abs(yt)) <= MAX_CORRELATION:
                result.append(part._replace(pose=part.pose.with_sigma(sigma)))
            else:
                result.append(part)
        return result

    def _wire_z_values(self, data: bytes, context: Context) -> Iterator[float]:
        """Return the values of ``z`` as they are on the wire."""
        rows = self.layout.wire_records(data, context.byte_order)
        return map(operator.itemgetter(self._z_index), rows)

    def _is_empty(self, data: bytes, number: int) -> bool:
        begin = self.layout.head_size + number * self.layout.size
        return data[begin : begin + self.layout.size] == self._empty_record

    def _check_numbers(self, data: bytes, context: Context) -> None:
        """Raise InterpretationError for the first invalid number, text or bool.

        NaN and infinity in a pose are invalid, as is a quality that is not between 0 and 1.
        """
        offset = self.layout.head_size
        for number, record in enumerate(self.layout.parse_records(data, context.byte_order)):
            for field, value in zip(self.layout.fields, record, strict=True):
                expected = _expectation(field, value)
                if expected and not self._is_empty(data, number):
                    raise misfit_error(field, offset, expected, value)
                offset += field.size


def _expectation(field: Field, value: float) -> str:
    """Return a description of the valid numbers if a number is invalid; "" if it is valid."""
    if field.name in _POSE and not math.isfinite(value):
        return "a finite number"
    if field.name == "quality" and not 0.0 <= value <= MAX_QUALITY:
        percent = field.unit is None and 1.0 < value <= 100.0
        return "0 to 1" + (" (its unit may be percent)" if percent else "")
    return ""


class _FieldUse(NamedTuple):
    """The use of each field of a record.

    Attributes:
        defaults: defaults of the fields that the record lacks, which are appended to its values.
        reorder: function that puts the values into the order of use; None if they are in order.
        z_index: index of ``z``; None: the record has no ``z``, as is usual.
        scales: factors that convert the values to SI; None if they are in SI.
        checks_unused: whether unused texts and bools have to be checked, too.
        sigmas: fields with the standard deviations of the pose; None: the record has none.
    """

    defaults: tuple[Any, ...]
    reorder: Callable[[Any], Any] | None
    z_index: int | None
    scales: _Scales | None
    checks_unused: bool
    sigmas: _SigmaUse | None


class _SigmaUse(NamedTuple):
    """The fields of a record with its pose's standard deviations and their correlations."""

    sigmas: tuple[tuple[int, float], ...]  # indices of the fields in _SIGMAS, and factors for SI
    # indices of the fields in _CORRELATIONS; None: the field is missing
    correlations: tuple[int | None, ...]


@functools.lru_cache(maxsize=64)
def _field_use(layout: tuple[Field, ...]) -> _FieldUse:
    """Return the use of each field of a layout's record.

    Raises:
        ConfigurationError: a field has a type or a unit that its name cannot have.
    """
    fields = {field.name: field for field in layout}
    for field in layout:
        _check_field(field)
    missing_names = [name for name in _DEFAULTS if name not in fields]
    names = [*fields, *missing_names]
    indices = [names.index(name) for name in _DEFAULTS]
    return _FieldUse(
        tuple(_DEFAULTS[name] for name in missing_names),
        None if indices == [*range(len(names))] else operator.itemgetter(*indices),
        [*fields].index("z") if "z" in fields else None,
        _scales(fields),
        any(field.type in {"string", "bool"} and field.name != "feature_id" for field in layout),
        _sigma_use(fields),
    )


def _sigma_use(fields: dict[str, Field]) -> _SigmaUse | None:
    names = [*fields]
    if not set(_SIGMAS) <= set(names):
        return None
    units = [UNITS[unit] if (unit := fields[name].unit) else None for name in _SIGMAS]
    scales = [unit.multiply / unit.divide if unit else 1.0 for unit in units]
    return _SigmaUse(
        tuple((names.index(name), scale) for name, scale in zip(_SIGMAS, scales, strict=True)),
        tuple(names.index(name) if name in fields else None for name in _CORRELATIONS),
    )


class _Scales(NamedTuple):
    """Factors and divisors for SI: ``value * multiply / divide`` for quality, x, y, theta and z."""

    multiply: tuple[float, ...]
    divide: tuple[float, ...]


def _scales(fields: dict[str, Field]) -> _Scales | None:
    """Return the scales; None if the values on the wire are floats in SI."""
    used = [fields.get(name) for name in ("quality", "x", "y", "theta", "z")]
    units = [UNITS[field.unit] if field and field.unit else None for field in used]
    multiply = tuple(unit.multiply if unit else 1.0 for unit in units)
    divide = tuple(unit.divide if unit else 1.0 for unit in units)
    has_integers = any(field is not None and field.wire.is_integer for field in used)
    return _Scales(multiply, divide) if has_integers or {*multiply, *divide} != {1.0} else None


def _to_si(values: Iterable[float], scales: _Scales) -> Iterable[float]:
    """Return floats in SI; integers become floats."""
    return map(operator.truediv, map(operator.mul, values, scales.multiply), scales.divide)


def _check_field(field: Field) -> None:
    """Raise if a field has a type or a unit that its name cannot have."""
    wire = field.wire
    if field.name in _QUANTITIES:
        quantities = _QUANTITIES[field.name]
        is_valid = wire.is_number
        is_valid = is_valid and (field.unit is None or UNITS[field.unit].quantity in quantities)
        units = [name for name, unit in UNITS.items() if unit.quantity in quantities]
        expected = f"a number without a unit or in {', '.join(units)}"
    elif field.name in _CORRELATIONS:
        is_valid, expected = wire.is_number and field.unit is None, "a number without a unit"
    elif field.name == "photo_index":
        is_valid, expected = wire.is_integer and field.unit is None, "an integer without a unit"
    elif field.name == "feature_id":
        is_valid, expected = field.type == "string", "a string"
    else:
        return
    if not is_valid:
        raise ConfigurationError(f"interpreter localizations: {field.label}: expected {expected}")
