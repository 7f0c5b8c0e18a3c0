"""Convert records of a layout from bytes to values and back, in plain Python.

There are two ways to read. The fast way unpacks all records with one ``struct.Struct``, turns the
rows into columns, converts the columns that need a conversion, and turns the columns back into
rows. The fast way cannot tell where an error is. If it fails, the slow way goes through the bytes
in order and finds the place.
"""

from __future__ import annotations

import bisect
import functools
import itertools
import math
import operator
import struct
from collections import namedtuple
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, SupportsIndex, TypeVar, overload

from smartcam.exceptions import ConfigurationError, hex_excerpt
from smartcam.layout._classes import values_of
from smartcam.layout._text import UNITS, misfit_error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import ClassVar, TypeAlias

    from smartcam.exceptions import InterpretationError
    from smartcam.layout._text import Field, Unit
    from smartcam.models import ByteOrder

    Convert: TypeAlias = Callable[[Any], Any]
    ConvertAll: TypeAlias = Callable[[Sequence[Any]], list[Any]]
    Rows: TypeAlias = Iterator[tuple[Any, ...]]

T = TypeVar("T")

Payload = bytes | bytearray | memoryview
"""Types that a container's data may have."""

_BOOLS = {0x00: False, 0xFF: True}

MIN_SHARED_TEXTS = 8
"""Least number of texts of a column for which equal texts are decoded only once."""


class Record(tuple[Any, ...]):
    """The values of one record, by name and by index.

    A tuple with the layout's field names as attributes: ``record.x``, ``record["x"]`` and
    ``record[0]`` are the same. A field's name overrides a method of tuples, so ``record.count``
    is the field if the layout has one. Equal to a plain tuple of the same values.
    """

    __slots__ = ()
    _fields: ClassVar[tuple[str, ...]] = ()
    _units: ClassVar[Mapping[str, str]] = {}  # SI units of the fields that have one

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

        count: Any
        index: Any

    @overload
    def __getitem__(self, key: SupportsIndex | str, /) -> Any: ...
    @overload
    def __getitem__(self, key: slice, /) -> tuple[Any, ...]: ...
    def __getitem__(self, key: SupportsIndex | slice | str, /) -> Any:
        """Return the value of a name or at an index, or a slice as a tuple.

        Raises:
            KeyError: no field has that name.
            IndexError: no field has that index.
        """
        if isinstance(key, str):
            if key not in self._fields:
                raise KeyError(f"{key!r} is not a field; fields are {', '.join(self._fields)}")
            key = self._fields.index(key)
        return super().__getitem__(key)

    def _asdict(self) -> dict[str, Any]:
        """Return the values by name, in the layout's order."""
        return dict(zip(self._fields, self, strict=True))

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self._asdict().items())
        return f"Record({values})"

    def _repr_html_(self) -> str:
        from smartcam._html import records_html

        return records_html(self)

    def __reduce__(self) -> tuple[Any, ...]:
        units = tuple(self._units.get(name, "") for name in self._fields)
        return _make_record, (self._fields, units, tuple(self))


# one class for each list of fields; a class that the cache has dropped is made again
@functools.lru_cache(maxsize=256)
def record_class(names: tuple[str, ...], units: tuple[str, ...]) -> type[Record]:
    """Return the record class with these field names and SI units, "" for none."""
    # a namedtuple's getters are written in C; its class must live until they are copied
    make: Any = namedtuple  # noqa: PYI024  names known at run time, so no checker can follow
    field_tuple = make("Fields", names)
    attributes: dict[str, Any] = {name: vars(field_tuple)[name] for name in names}
    return type(
        "Record",
        (Record,),
        {
            **attributes,
            "__slots__": (),
            "__module__": __name__,
            "__match_args__": names,
            "_fields": names,
            "_units": {name: unit for name, unit in zip(names, units, strict=True) if unit},
        },
    )


def _make_record(names: tuple[str, ...], units: tuple[str, ...], values: tuple[Any, ...]) -> Record:
    return Record.__new__(record_class(names, units), values)


class RecordCodec:
    """Reads and writes records with one list of fields, in one byte order.

    Args:
        fields: the fields, without padding between them.
        byte_order: byte order of numbers.
        lenient: whether any byte except zero counts as True in a bool.

    Attributes:
        size: size of a record, bytes.
        unpack_all: function that returns the unconverted values of all records of a payload; it
            raises ``struct.error`` unless they fill the payload.
    """

    def __init__(self, fields: tuple[Field, ...], byte_order: ByteOrder, *, lenient: bool) -> None:
        self.fields = fields
        self.lenient = lenient
        self.offsets: list[int] = _offsets(fields)
        self.make: functools.partial[Any] = functools.partial(
            Record.__new__,
            record_class(tuple(f.name for f in fields), tuple(f.symbol for f in fields)),
        )
        order = "<" if byte_order == "little" else ">"
        codes = (f"{field.length or ''}{field.wire.code}" for field in fields)
        self._struct = struct.Struct(order + "".join(codes))
        self._field_structs = [
            struct.Struct(f"{order}{f.length or ''}{f.wire.code}") for f in fields
        ]
        self._converters = [
            (index, *converters)
            for index, field in enumerate(fields)
            if (converters := _converters(field, lenient=lenient)) is not None
        ]
        self.size: int = self._struct.size
        # only for bytes: CPython 3.11 crashes if the garbage collector finds an iterator over a
        # memoryview that was not read to its end
        self.unpack_all: Callable[[bytes], Rows] = self._struct.iter_unpack

    def unpack(self, payload: bytes, offset: int, count: int) -> Rows:
        """Return the unconverted values of ``count`` records; the caller has checked the size."""
        return self.unpack_all(payload[offset : offset + count * self.size])

    def read(self, rows: Rows, payload: Payload, offset: int, *, label: str = "") -> list[Record]:
        """Return the records with the unconverted values ``rows``.

        ``rows`` come from :meth:`unpack` or :attr:`unpack_all`; the first is at ``offset``.
        ``label`` names a record in errors. Raises InterpretationError if a byte is no bool, or a
        text is not UTF-8.
        """
        try:
            return self.convert(rows)
        except (KeyError, UnicodeDecodeError) as exc:
            raise self.conversion_error(payload, offset, label) from exc

    def convert(self, rows: Rows) -> list[Record]:
        """Return the records with the unconverted values ``rows``.

        Raises KeyError if a byte is no bool, UnicodeDecodeError if a text is not UTF-8.
        """
        if not self._converters:
            return list(map(self.make, rows))
        columns: list[Sequence[Any]] = list(zip(*rows, strict=True))
        if not columns:
            return []
        for index, _, convert in self._converters:
            columns[index] = convert(columns[index])
        return list(map(self.make, zip(*columns, strict=True)))

    def read_one(self, payload: Payload) -> Record:
        """Return the first record; the caller has checked that there is one.

        Raises the errors of :meth:`read`.
        """
        values: Sequence[Any] = self._struct.unpack_from(payload)
        if self._converters:
            values = list(values)
            try:
                for index, convert, _ in self._converters:
                    values[index] = convert(values[index])
            except (KeyError, UnicodeDecodeError) as exc:
                raise self.conversion_error(payload, 0, "") from exc
        record: Record = self.make(values)
        return record

    def read_field(self, payload: Payload, offset: int, index: int) -> Any:
        """Return the unconverted value of one field of the record at ``offset``."""
        return self._field_structs[index].unpack_from(payload, offset + self.offsets[index])[0]

    def write(self, values: Sequence[Any], label: str) -> bytes:
        """Return the bytes of one record; ``values`` are in the order of the fields.

        Raises ConfigurationError if a value does not fit its field; ``label`` names the record.
        """
        wire: list[Any] = []
        for field, value in zip(self.fields, values, strict=True):
            try:
                wire.append(_to_wire(field, value))
            except (ArithmeticError, TypeError, ValueError) as exc:
                raise ConfigurationError(
                    f"layout: {label}{field.label}: expected {_describe_values(field)}, "
                    f"got {_short_repr(value)}"
                ) from exc
        return self._struct.pack(*wire)

    def values_in_order(self, value: object, label: str, forced: Mapping[str, Any]) -> list[Any]:
        """Return the values of one record, in the order of the fields.

        ``value``: mapping, record, or sequence of the values in order. ``label`` names a record in
        errors. ``forced``: values of some fields that override values of ``value``. Raises
        ConfigurationError if a field is missing or unknown, or if there are too few or too many
        values.
        """
        names = [field.name for field in self.fields]
        given = values_by_name(value, names, label)
        given.update({name: forced[name] for name in names if name in forced})
        check_names(given, names, label)
        return [given[name] for name in names]

    def field_at(self, position: int) -> tuple[Field, int]:
        """Return the field that holds byte ``position`` of a record, and its offset."""
        index = bisect.bisect_right(self.offsets, position) - 1
        return self.fields[index], self.offsets[index]

    def conversion_error(self, payload: Payload, offset: int, label: str) -> InterpretationError:
        """Return the error for the first value that cannot be converted; there must be one."""
        for number, start in enumerate(range(offset, len(payload), self.size)):
            for index, convert, _ in self._converters:
                value = self.read_field(payload, start, index)
                try:
                    convert(value)
                except (KeyError, UnicodeDecodeError) as exc:
                    value_offset = start + self.offsets[index]
                    prefix = f"{label} {number}: " if label else ""
                    if isinstance(exc, UnicodeDecodeError):
                        excerpt = f"{hex_excerpt(value)} ({exc.reason})"
                        return misfit_error(
                            self.fields[index],
                            value_offset + exc.start,
                            "UTF-8 text",
                            excerpt,
                            prefix,
                        )
                    expected, excerpt = "0x00 or 0xFF for a bool", f"0x{value:02X}"
                    return misfit_error(self.fields[index], value_offset, expected, excerpt, prefix)
        raise AssertionError("the fast way failed and the slow way did not")


def split_rows(items: list[T], counts: list[int]) -> list[list[T]]:
    """Split the items of several payloads into one list for each payload, by its item count."""
    if counts.count(1) == len(counts):
        return [[item] for item in items]
    remaining = iter(items)
    return [list(itertools.islice(remaining, count)) for count in counts]


def values_by_name(value: object, names: Sequence[str], label: str) -> dict[str, Any]:
    """Return the values of a mapping, a record, an object of a class or a sequence, by name.

    Raises ConfigurationError if ``value`` is none of these, or a sequence of another length.
    """
    values: Any = value
    if isinstance(value, Mapping):
        return dict(values)
    if isinstance(value, Record):
        return dict(values._asdict())
    fields = values_of(value)
    if fields is not None:
        return fields
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray)):
        raise ConfigurationError(
            f"layout: {label}expected a mapping or a sequence of values, got {_short_repr(value)}"
        )
    if len(values) != len(names):
        raise ConfigurationError(
            f"layout: {label}expected {len(names)} values ({', '.join(names)}), got {len(values)}"
        )
    return dict(zip(names, values, strict=True))


def check_names(given: Mapping[str, Any], names: Sequence[str], label: str) -> None:
    """Raise ConfigurationError unless ``given`` has exactly these names."""
    if set(given) == set(names):
        return
    missing = [name for name in names if name not in given]
    unknown = [str(name) for name in given if name not in names]
    raise ConfigurationError(
        f"layout: {label}expected the fields {', '.join(names)}"
        + (f"; missing: {', '.join(missing)}" if missing else "")
        + (f"; unknown: {', '.join(unknown)}" if unknown else "")
    )


def _offsets(fields: tuple[Field, ...]) -> list[int]:
    offsets: list[int] = []
    at = 0
    for field in fields:
        offsets.append(at)
        at += field.size
    return offsets


def _converters(field: Field, *, lenient: bool) -> tuple[Convert, ConvertAll] | None:
    """Return the converter of a single wire value, and the converter of a column of values.

    Return None if values stay as they are. A comprehension over a column takes a third of the time
    of a function call for each value.
    """
    if field.type == "string":
        return _decode_text, _decode_texts
    if field.type == "bool":
        return _with_column(bool if lenient else _BOOLS.__getitem__)
    if field.unit is None:
        return None
    _, _, multiply, divide = UNITS[field.unit]
    if multiply == divide == 1.0:
        return _with_column(float) if field.wire.is_integer else None
    if multiply == 1.0:
        return lambda v: v / divide, lambda column: [v / divide for v in column]
    return lambda v: v * multiply / divide, lambda column: [v * multiply / divide for v in column]


def _with_column(convert: Convert) -> tuple[Convert, ConvertAll]:
    return convert, lambda column: list(map(convert, column))


def _decode_text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode()


def _decode_texts(column: Sequence[bytes]) -> list[str]:
    """Return the texts of a column; decode each text only once if many are equal."""
    if len(column) >= MIN_SHARED_TEXTS:
        distinct = set(column)
        if 2 * len(distinct) <= len(column):
            known = {raw: _decode_text(raw) for raw in distinct}
            return list(map(known.__getitem__, column))
    return [raw.partition(b"\0")[0].decode() for raw in column]


def _to_wire(field: Field, value: Any) -> Any:
    """Return the value for ``struct`` to pack; raise ValueError, TypeError or ArithmeticError."""
    if field.type == "bool":
        if value not in (True, False):
            raise ValueError("not a bool")
        return 0xFF if value else 0x00
    if field.type == "string":
        return _text_to_wire(field, value)
    if isinstance(value, (str, bytes, bytearray)):
        raise TypeError("not a number")
    if field.unit is not None:
        value = _from_si(UNITS[field.unit], float(value))
    if not field.wire.is_integer:
        value = float(value)
        struct.pack(f"<{field.wire.code}", value)  # struct checks the range
        return value
    number = _to_integer(value, rounded=field.unit is not None)
    if not (field.wire.low or 0) <= number <= (field.wire.high or 0):
        raise ValueError("out of range")
    return number


def _from_si(unit: Unit, si: float) -> float:
    """Return the number whose SI value is ``si``, or nearest to ``si``."""
    value = si * unit.divide / unit.multiply
    if math.isinf(value) and math.isfinite(si):
        raise OverflowError("out of range")
    for neighbour in (value, math.nextafter(value, math.inf), math.nextafter(value, -math.inf)):
        if neighbour * unit.multiply / unit.divide == si:
            return neighbour
    return value


def _to_integer(value: Any, *, rounded: bool) -> int:
    if isinstance(value, float):
        if not rounded and not value.is_integer():
            raise ValueError("not a whole number")
        return round(value)
    return operator.index(value)


def _text_to_wire(field: Field, value: Any) -> bytes:
    if not isinstance(value, str) or "\0" in value:
        raise TypeError("not a text")
    raw = value.encode()
    if len(raw) > field.size:
        raise ValueError("too long")
    return raw


def _describe_values(field: Field) -> str:
    wire = field.wire
    if field.type == "bool":
        return "True or False"
    if field.type == "string":
        return f"a text of at most {field.length} bytes in UTF-8, without a zero character"
    text = "a number in range" if not wire.is_integer else f"{wire.low} to {wire.high}"
    return text if field.unit is None else f"{text} on the wire ({UNITS[field.unit].si} here)"


def _short_repr(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 64 else f"{text[:64]} ..."
