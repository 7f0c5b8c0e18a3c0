"""Convert objects to plain data for files, and back: a class declares the form of each field.

The annotations of a :class:`Stored` dataclass say how pydantic checks a field's data, how the value
is made from the data, and how the value is written as plain data. A :class:`Form` holds all three.
An array, for example, has the form of nested lists of numbers::

    @dataclass(frozen=True, kw_only=True, eq=False)
    class CameraModel(Stored):
        size: Size
        matrix: Matrix3
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    NamedTuple,
    TypeAlias,
    get_args,
    get_type_hints,
)

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, TypeAdapter, ValidationError
from pydantic_core import core_schema

from smartcam.exceptions import CalibrationError
from smartcam.geometry._codes import Code, Remark
from smartcam.geometry._rotations import MAX_COORDINATE, Array
from smartcam.geometry._transforms import Transform

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Self

    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

Context: TypeAlias = MutableMapping[str, Any]
"""Values that are known while a file is read: the object's name in errors (``label``), and the
values of earlier keys that later keys need."""

Keys: TypeAlias = Mapping[str, str]
"""Key in a file for each field's name; the key is empty for a field made from other keys."""

ExtraKeys: TypeAlias = Mapping[str, tuple[Any, Callable[[Any], Any]]]
"""Additional keys of a file: for each key a type, and the function that computes its value from an
object."""


@dataclass(eq=False)
class Form:
    """The form in which the annotated value is stored in a file."""

    data_type: Any  # type with which pydantic checks the data
    read: Callable[[Any, Context], Any]  # makes the value from checked data and context
    write: Callable[[Any], Any]  # makes plain data of the value

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_after_validator_function(
            lambda value, info: self.read(value, info.context),
            handler.generate_schema(self.data_type),
            serialization=core_schema.plain_serializer_function_ser_schema(self.write),
        )


@dataclass(eq=False)
class AsList:
    """Stores a tuple of any length as a list of at least ``min_length`` items."""

    min_length: int = 0

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        items = handler.generate_schema(get_args(kind)[0])
        schema = core_schema.list_schema(items, min_length=self.min_length)
        return _schema_of_parts(schema, read=lambda values, _: tuple(values), write=list)


class AsMapping:
    """Stores a NamedTuple as a mapping."""

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        hints = get_type_hints(kind, include_extras=True)
        fields = {
            key: core_schema.typed_dict_field(handler.generate_schema(hint))
            for key, hint in hints.items()
        }
        return _schema_of_parts(
            core_schema.typed_dict_schema(fields, extra_behavior="forbid"),
            read=lambda values, _: kind(**values),
            write=lambda value: value._asdict(),
        )


def _schema_of_parts(
    parts: CoreSchema, read: Callable[[Any, Context], Any], write: Callable[[Any], Any]
) -> CoreSchema:
    """Return the schema of values made of parts, each of which has a form of its own."""
    return core_schema.with_info_after_validator_function(
        lambda values, info: read(values, info.context),
        parts,
        serialization=core_schema.wrap_serializer_function_ser_schema(
            lambda value, plain: plain(write(value)), schema=parts
        ),
    )


class Stored:
    """A dataclass whose annotations say how its fields are stored in a file."""

    _label: ClassVar[str] = "data"
    """Name of the value in errors."""

    _keys: ClassVar[Keys] = {}

    _extra_keys: ClassVar[ExtraKeys] = {}
    """Keys that are written before the keys of the fields."""

    _context_keys: ClassVar[frozenset[str]] = frozenset({"target"})
    """Keys whose values are put in the context, where the forms of later keys find them."""

    _optional_keys: ClassVar[frozenset[str]] = frozenset()
    """Keys that may be missing in a file; the fields then get their defaults."""

    def to_data(self) -> dict[str, Any]:
        """Return the object as data for JSON, None for NaN; :meth:`from_data` reads these data."""
        kind: Any = type(self)
        data: dict[str, Any] = _adapter(kind).dump_python(self, warnings=False)
        return data

    @classmethod
    def from_data(cls, data: Mapping[str, Any], **known: Any) -> Self:
        """Return the object that :meth:`to_data` wrote, bit for bit.

        Args:
            data: contents of a file.
            known: values that the file does not have, such as the ``target`` of a view.

        Raises:
            CalibrationError: SHAPE: the data have another structure; NOT_FINITE or NOT_RIGID:
                numbers that are not possible.
        """
        value: Self = _validate(cls, data, cls._label, **known)
        return value

    @classmethod
    def __get_pydantic_core_schema__(cls, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        hints = get_type_hints(cls, include_extras=True)
        attributes = [field.name for field in dataclasses.fields(kind)]
        names: dict[str, str] = {cls._keys.get(name, name): name for name in attributes}
        names.pop("", None)
        types = {key: hint for key, (hint, _) in cls._extra_keys.items()}
        types |= {key: hints[name] for key, name in names.items()}

        def field(key: str) -> core_schema.TypedDictField:
            schema = handler.generate_schema(types[key])
            if key in cls._context_keys:
                schema = core_schema.with_info_after_validator_function(_share(key), schema)
            return core_schema.typed_dict_field(schema, required=key not in cls._optional_keys)

        def write(instance: Stored) -> dict[str, Any]:
            extra_data = {key: value(instance) for key, (_, value) in cls._extra_keys.items()}
            return extra_data | {key: getattr(instance, name) for key, name in names.items()}

        def read(values: dict[str, Any], context: Context) -> Stored:
            return cls._read({names.get(key, key): value for key, value in values.items()}, context)

        fields = {key: field(key) for key in types}
        fields_schema = core_schema.typed_dict_schema(fields, extra_behavior="forbid")
        return _schema_of_parts(fields_schema, read, write)

    @classmethod
    def _read(cls, fields: dict[str, Any], context: Context) -> Self:
        """Return an object made from the values of its fields and of ``_extra_keys``.

        Raises SHAPE: the fields contradict each other.
        """
        instance = cls(
            **{name: value for name, value in fields.items() if name not in cls._extra_keys}
        )
        instance._check(fields, context["label"])
        return instance

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        """Raise SHAPE if fields contradict each other or the values of ``_extra_keys``."""


def _share(key: str) -> Callable[[Any, core_schema.ValidationInfo[Context]], Any]:
    def share(value: Any, info: core_schema.ValidationInfo[Context]) -> Any:
        info.context[key] = value
        return value

    return share


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _validate(kind: Any, data: Any, label: str, **known: Any) -> Any:
    try:
        return _adapter(kind).validate_python(data, context={"label": label, **known})
    except ValidationError as exc:
        first_error = exc.errors()[0]
        error = first_error.get("ctx", {}).get("error")
        if isinstance(error, CalibrationError):
            raise error from None
        location = ".".join(map(str, first_error["loc"]))
        raise invalid_data_error(
            label, f"{location}: {first_error['msg']}", first_error["input"]
        ) from exc


def invalid_data_error(label: str, text: str, actual: object) -> CalibrationError:
    """Return the error for stored data that are not valid."""
    return Code.SHAPE.error(f"stored {label}: {text}", got=actual)


def check_counts(fields: Mapping[str, Any], names: Iterable[str], count: int, label: str) -> None:
    """Raise SHAPE if a field does not have ``count`` items."""
    for name in names:
        if len(fields[name]) != count:
            raise invalid_data_error(label, f"{name}: expected {count}", len(fields[name]))


def check_shape(values: Array, shape: tuple[int, ...], label: str, name: str) -> None:
    """Raise SHAPE if a field's array does not have the given shape."""
    if values.shape != shape:
        raise invalid_data_error(label, f"{name}: expected shape {shape}", values.shape)


# ---------------------------------------------------------------------- numbers


def _check_bound(value: float) -> float:
    if abs(value) > MAX_COORDINATE:
        raise ValueError(f"expected a number up to {MAX_COORDINATE:g}")
    return value


Number = Annotated[FiniteFloat, AfterValidator(_check_bound)]
"""A number of a file; its limit keeps products of a few numbers finite."""

NonNegative = Annotated[Number, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
Pair = tuple[Number, Number]
Triple = tuple[Number, Number, Number]
NullableTriple = tuple[Number | None, Number | None, Number | None]


def _none_to_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _nan_to_none(value: float) -> float | None:
    return None if math.isnan(value) else value


NumberOrNaN = Annotated[
    float, Form(Number | None, lambda value, _: _none_to_nan(value), _nan_to_none)
]
"""A number that may be NaN, which is stored as null."""

PairOrNaN = Annotated[
    tuple[float, float],
    Form(
        tuple[Number | None, Number | None],
        read=lambda values, _: (_none_to_nan(values[0]), _none_to_nan(values[1])),
        write=lambda values: [*map(_nan_to_none, values)],
    ),
]


def row(data_type: Any, make: Callable[[Any], Any] = tuple) -> Form:
    """Return the form of a tuple of fixed length, stored as a list; ``make`` builds the value."""
    return Form(data_type, read=lambda values, _: make(values), write=list)


Size = Annotated[tuple[int, int], row(tuple[int, int])]
"""Width and height, pixels."""

# ---------------------------------------------------------------------- arrays


def as_array(values: Any, _: Context | None = None) -> Array:
    """Return nested lists as an array, NaN for None; an empty array if rows differ in length."""
    try:
        return np.array(values, dtype=np.float64)
    except ValueError:
        return np.zeros(0)


def _to_lists(values: Array) -> Any:
    return values.tolist()


def _to_nullable_lists(values: Array) -> Any:
    """Return an array as nested lists, None for NaN."""
    if not np.isnan(values).any():
        return values.tolist()
    if values.ndim > 1:
        return [_to_nullable_lists(row) for row in values]
    return [*map(_nan_to_none, values.tolist())]


Vector2 = Annotated[Array, Form(Pair, as_array, _to_lists)]
Vector3 = Annotated[Array, Form(Triple, as_array, _to_lists)]
Matrix3 = Annotated[Array, Form(tuple[Triple, Triple, Triple], as_array, _to_lists)]
Matrix43 = Annotated[Array, Form(tuple[Triple, Triple, Triple, Triple], as_array, _to_lists)]


def matrix(count: int | None = None) -> Form:
    """Return the form of a matrix of ``count`` rows; its class checks the number of columns."""
    data_type = Annotated[list[list[Number]], Field(min_length=count or 0, max_length=count)]
    return Form(data_type, as_array, _to_lists)


def rows(data_type: Any, *shape: int, min_length: int = 0, nulls: bool = False) -> Form:
    """Return the form of an array (N, ``*shape``) that is stored as a list.

    ``data_type``: type with which pydantic checks an item. ``min_length``: of the list.
    ``nulls``: whether values may be NaN, which is stored as null.
    """
    return Form(
        Annotated[list[data_type], Field(min_length=min_length)],
        read=lambda values, _: as_array(values).reshape(-1, *shape),
        write=_to_nullable_lists if nulls else _to_lists,
    )


SheetOffsets = Annotated[Array, rows(Triple, 3)]
"""Offsets of a target's points from their nominal places, metres."""

# ---------------------------------------------------------------------- remarks and motions

_REMARK = Form(
    Annotated[Remark, AsMapping()],
    read=lambda remark, _: remark,
    write=lambda remark: {"code": remark.code.value, "text": remark.text},
)
Remarks = Annotated[tuple[Annotated[Remark, _REMARK], ...], AsList()]


class _Motion(NamedTuple):
    rotation: Matrix3
    translation: Vector3


def motion(frames: Callable[[Context], tuple[str, str]]) -> Form:
    """Return the form of a transform stored without its frames' names, which ``frames`` gives."""
    return Form(
        Annotated[_Motion, AsMapping()],
        read=lambda values, context: Transform(*frames(context), *values),
        write=motion_to_data,
    )


def motion_to_data(transform: Transform) -> dict[str, Any]:
    """Return a rigid motion as data for JSON, without its frames."""
    motion = _Motion(transform.rotation, transform.translation)
    return {name: values.tolist() for name, values in motion._asdict().items()}


def motion_from_data(data: Mapping[str, Any], target: str, source: str) -> Transform:
    """Return the motion that :func:`motion_to_data` wrote; raise SHAPE or NOT_RIGID."""
    return Transform(target, source, *_validate(Annotated[_Motion, AsMapping()], data, "motion"))
