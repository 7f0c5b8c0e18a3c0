"""Convert a result into values for a robot, one list for each part."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from smartcam.calibration._inside import ROBOTS
from smartcam.calibration.formats import pose_to
from smartcam.exceptions import InterpretationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import matrix_from_quaternion
from smartcam.interpreters import Interpreter, resolve
from smartcam.layout._inside import UNITS
from smartcam.models import Localization

if TYPE_CHECKING:
    from smartcam.gateway._settings import GatewaySettings
    from smartcam.layout import Layout
    from smartcam.layout._inside import Field

PartValues = list[float | str]


class Converter:
    """Converts results: poses to the robot's convention, other values to the robot's units.

    Args:
        settings: the pose convention, the units, and which values follow a pose.
        spec: ``interpret_as`` of the camera, whose layout shows which values are lengths.
    """

    def __init__(self, settings: GatewaySettings, spec: object) -> None:
        self._settings, self._style = settings, settings.style
        self._convention = ROBOTS[self._style.pose]
        self._layouts = _layouts(spec)
        self._length_factor = {"m": 1.0, "mm": 1000.0}[self._style.length]
        self._angle_factor_of_style = {"rad": 1.0, "deg": 180.0 / math.pi}[self._style.angle]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of a part's values: those of a pose, or those of a layout without a pose."""
        layout = next(iter(self._layouts.values()), None)
        if layout is None or {"x", "y"} <= {field.name for field in layout.fields}:
            return (*self._convention.numbers, *self._settings.also)
        return tuple(field.name for field in layout.fields)

    def convert(self, value: object, application: int) -> list[PartValues]:
        """Return the values of each part of a result.

        Raises:
            InterpretationError: the value holds neither localizations nor records.
        """
        if type(value).__module__ == "numpy":
            value = _records_of(value)
        single = isinstance(value, (Localization, Mapping)) or hasattr(value, "_asdict")
        items = [value] if single else value
        if not isinstance(items, Sequence) or isinstance(items, (str, bytes, bytearray)):
            raise InterpretationError(
                f"the result is {type(value).__name__}, which has no parts: expected localizations "
                "or records; interpret_as says how results are read"
            )
        layout = self._layouts.get(application) or self._layouts.get(None)
        fields = {field.name: field for field in layout.fields} if layout else {}
        return [self._values(item, fields) for item in cast("Sequence[object]", items)]

    def _values(self, item: object, fields: Mapping[str, Field]) -> PartValues:
        if isinstance(item, Localization):
            return self._pose_values(item)
        if hasattr(item, "_asdict"):
            item = cast("Any", item)._asdict()
        if not isinstance(item, Mapping):
            raise InterpretationError(
                f"a part is {type(item).__name__}: expected a localization or a record"
            )
        record = cast("Mapping[str, object]", item)
        return [self._convert_unit(value, fields.get(name)) for name, value in record.items()]

    def _pose_values(self, part: Localization) -> PartValues:
        x, y, z, w = part.pose.orientation
        if self._settings.tool_flip:
            x, y, z, w = w, z, -y, -x  # the quaternion times (1, 0, 0, 0): half a turn about x
        pose = Transform(
            "robot",
            "part",
            matrix_from_quaternion([x, y, z, w]),
            np.array(part.pose.position, dtype=np.float64),
        )
        numbers = pose_to(self._style.pose, pose)
        position = [
            self._length_factor * number / self._convention.units_per_metre
            for number in numbers[:3]
        ]
        orientation = [number * self._angle_factor for number in numbers[3:]]
        return [*position, *orientation, *(getattr(part, name) for name in self._settings.also)]

    @property
    def _angle_factor(self) -> float:
        """Factor from the convention's angles to those of the style; 1 for quaternions."""
        if "q1" in self._convention.numbers:
            return 1.0
        per_radian = 1.0 if self._style.pose == "ur" else 180.0 / math.pi
        return self._angle_factor_of_style / per_radian

    def _convert_unit(self, value: object, field: Field | None) -> float | str:
        quantity = UNITS[field.unit].quantity if field is not None and field.unit else ""
        factor = {"length": self._length_factor, "angle": self._angle_factor_of_style}.get(quantity)
        if isinstance(value, (bool, int, float)):
            return value * factor if factor is not None else value
        return str(value)


def _layouts(spec: object) -> dict[int | None, Layout]:
    """Return the layouts in ``interpret_as`` by application; the key None means all others."""
    if spec is None:
        return {}
    by_application = spec if isinstance(spec, Mapping) else {None: spec}
    layouts: dict[int | None, Layout] = {}
    for application, one_spec in cast("Mapping[int | None, Any]", by_application).items():
        interpreter = resolve(one_spec)
        if isinstance(interpreter, Interpreter) and interpreter.layout is not None:
            layouts[application] = interpreter.layout
    return layouts


def _records_of(table: Any) -> object:
    """Return the rows of a numpy table as mappings; return other arrays unchanged."""
    names = getattr(table.dtype, "names", None)
    if not names:
        return cast("object", table)
    return [dict(zip(names, row, strict=True)) for row in table.reshape(-1).tolist()]
