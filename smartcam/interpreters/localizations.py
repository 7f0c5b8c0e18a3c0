"""``localizations``: the parts that the camera found, with their poses."""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any, ClassVar, cast

from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.interpreters.base import Interpreter
from smartcam.layout.text import UNITS
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.interpreters.base import Reader
    from smartcam.layout import Field, Layout, Record

__all__ = ["Localizations"]

_DEFAULTS: dict[str, Any] = {
    "feature_id": "",
    "quality": 1.0,
    "photo_index": 0,
    "x": 0.0,
    "y": 0.0,
    "z": 0.0,
    "theta": 0.0,
}
"""The fields that are used, in the order of use, and their values where the layout has none."""

_QUANTITIES = {
    "quality": ("ratio",),
    "x": ("length", "pixels"),
    "y": ("length", "pixels"),
    "z": ("length", "pixels"),
    "theta": ("angle",),
}
"""What a unit of a real field may measure."""

_POSE = ("x", "y", "z", "theta")


# half the time of the NamedTuples' own; the cast because a bare tuple is generic
_new_tuple = cast("Callable[..., Any]", tuple.__new__)  # pyright: ignore[reportUnknownMemberType]


class Localizations(Interpreter):
    """Gives a list of :class:`~smartcam.Localization`.

    Args:
        layout: ``x`` and ``y`` must be in its records. Without ``feature_id`` it is ``""``,
            without ``quality`` 1.0 (the camera reported the part as found), without
            ``photo_index``, ``z`` or ``theta`` 0. Other fields are ignored. Lengths without a
            unit are metres, angles radians; ``px`` stays pixels.

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
        fields = {field.name: field for field in self.layout.fields}
        for name in ("x", "y"):
            if name not in fields:
                raise ConfigurationError(
                    f"interpreter localizations: expected a field {name!r} in the layout, "
                    f"got '{self.layout}'"
                )
        for field in fields.values():
            _check(field)
        names = [*fields, *_DEFAULTS]
        places = [names.index(name) for name in _DEFAULTS]
        self._pick = operator.itemgetter(*places)  # of a record and the defaults behind it
        self._integers = any(
            name in fields and fields[name].unit is None and fields[name].wire.is_integer
            for name in _QUANTITIES
        )
        self._empty = bytes(self.layout.size)

    def interpret(self, reader: Reader) -> list[Localization]:
        """Return the parts in the camera's order.

        A record of zero bytes is an unused slot of the camera's array (HALCON script manual p. 11,
        published): it is skipped and counted in ``reader.context.empty_slots``.

        Raises:
            InterpretationError: the bytes do not fit the layout, or a pose has NaN or infinity.
        """
        layout, context, data = self.layout, reader.context, reader.data
        header = Header(context.number, context.received_at, context.camera)
        pick, defaults, empty = self._pick, tuple(_DEFAULTS.values()), self._empty
        isfinite, sin, cos, size = math.isfinite, math.sin, math.cos, layout.size
        new = _new_tuple
        offset = layout.head_size - size
        found: list[Localization] = []
        for record in layout.parse_records(data, context.byte_order):
            offset += size
            if data[offset : offset + size] == empty:
                context.empty_slots += 1
                continue
            feature_id, quality, photo_index, x, y, z, theta = pick((*record, *defaults))
            if not isfinite(x + y + z + theta):
                self._check_finite(record, offset)
            if self._integers:
                quality, x, y, z, theta = map(float, (quality, x, y, z, theta))
            if context.y_down:
                y, theta = 0.0 - y, 0.0 - theta  # and no minus zero
            half = 0.5 * theta
            orientation = new(Quaternion, (0.0, 0.0, sin(half), cos(half)))
            pose = new(Pose, (header, new(Position, (x, y, z)), orientation))
            found.append(new(Localization, (feature_id, quality, photo_index, pose)))
        return found

    def _check_finite(self, record: Record, start: int) -> None:
        """Raise for the first NaN or infinity of a pose; large numbers may sum up to one."""
        offset = start
        for field, value in zip(self.layout.fields, record, strict=True):
            if field.name in _POSE and not math.isfinite(value):
                raise InterpretationError(
                    f"{field.label} at offset {offset}: expected a finite number, got {value}",
                    field=field.name,
                    offset=offset,
                    expected="a finite number",
                    got=value,
                )
            offset += field.size


def _check(field: Field) -> None:
    """Raise where a field has a type or a unit that its name cannot have."""
    wire = field.wire
    if field.name in _QUANTITIES:
        quantities = _QUANTITIES[field.name]
        fits = wire.is_number
        fits = fits and (field.unit is None or UNITS[field.unit].quantity in quantities)
        units = [name for name, unit in UNITS.items() if unit.quantity in quantities]
        expected = f"a number without a unit or in {', '.join(units)}"
    elif field.name == "photo_index":
        fits, expected = wire.is_integer and field.unit is None, "an integer without a unit"
    elif field.name == "feature_id":
        fits, expected = field.type == "string", "a string"
    else:
        return
    if not fits:
        raise ConfigurationError(f"interpreter localizations: {field.label}: expected {expected}")
