"""The layout of a result container: which fields it holds, in which order, in which unit.

A container carries no types and no names (SC manual p. 33, published); the user says what he
configured on the camera::

    "passed: bool, x: real32 mm, code: string[20]"      exactly one record
    "(x: real32 mm, y: real32 mm)*"                     records to the end: a list
    "(x: real32 mm, y: real32 mm)[32]"                  exactly 32 records
    "n: int32, (x: real32 mm, y: real32 mm)[n]"         n records, unused ones behind them

One :class:`Layout` has many faces: values (:meth:`~Layout.parse`), bytes (:meth:`~Layout.build`),
numpy (:attr:`~Layout.dtype`, :meth:`~Layout.parse_table`), pydantic, JSON Schema and YAML. The
heavy ones are imported where they are first used.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_flag, check_integer, wrong_argument
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.layout._classes import read_class
from smartcam.layout._codec import Payload, Record, RecordCodec, check_names, named, record_class
from smartcam.layout._compiled import compile_text
from smartcam.layout._text import Field, misfit

if TYPE_CHECKING:
    import numpy as np
    from pydantic import BaseModel

    from smartcam.layout._codec import Rows
    from smartcam.layout._tables import TableCodec
    from smartcam.models import ByteOrder

__all__ = ["Field", "Layout", "Record"]


class Layout:
    """The fields of a result container; immutable, equal to every layout of the same text.

    Args:
        text: the layout text; new lines are white space, ``#`` begins a comment.
        lenient: take any byte but zero for a true bool; otherwise only 0xFF is true and only
            0x00 false, as the camera sends them.
        start: where the layout begins in ``text``; positions of mistakes count from the start of
            ``text`` nevertheless.

    Raises:
        LayoutError: a mistake in the text, with its position.
    """

    __slots__ = (
        *("_codecs", "_compiled", "_lenient", "_model", "_spec", "_text"),
        *("_fixed", "_is_list", "_record_word", "_sequence_index", "_to_end"),
        *("_frombuffer", "_tables", "_views"),
    )

    def __init__(self, text: str, *, lenient: bool = False, start: int = 0) -> None:
        if not isinstance(text, str):  # what is wrong in it is told with its place
            raise wrong_argument("layout", "a text", text)
        lenient, start = check_flag(lenient, "lenient"), check_integer(start, "start", 0, len(text))
        made = compile_text(text, start, lenient=lenient)
        self._compiled = made  # others find it as long as this one lives
        self._spec = made.spec
        self._text = made.text
        self._lenient = lenient
        self._codecs = made.codecs
        self._fixed = made.fixed
        self._to_end = made.to_end
        self._is_list = made.is_list
        self._record_word = made.record_word
        self._sequence_index = made.sequence_index
        # each layout has its own of these: a user may change a model, or the names of a dtype
        self._model: type[BaseModel] | None = None
        self._tables: dict[ByteOrder, TableCodec] = {}
        # where a table is the payload and nothing else: its dtype, and what makes it
        self._views: dict[ByteOrder, np.dtype[np.void]] = {}
        self._frombuffer: Any = None

    @classmethod
    def of(cls, described: Any, *, lenient: bool = False) -> Layout:
        """Return the layout that a class says.

        ``Annotated[float, "real32 mm"]`` is a field, ``bool`` one without more,
        ``Annotated[list[Part], "*"]`` a group of records that another class says, and comes last.
        ``interpret_as=`` takes such a class itself and gives its objects; :meth:`build` takes them.

        Args:
            described: a dataclass, a pydantic model or a NamedTuple; ``list[Part]`` for records to
                the end.
            lenient: as for the layout.

        Raises:
            LayoutError: a field has no layout text, one that is wrong (with the place), or one that
                does not go with its type.
        """
        return cls(read_class(described).text, lenient=lenient)

    # -- what it is --------------------------------------------------------------------------

    @property
    def text(self) -> str:
        """The canonical text: one line, single spaces, no comments."""
        return self._text

    @property
    def lenient(self) -> bool:
        """True if any byte but zero is a true bool."""
        return self._lenient

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields of a record."""
        return self._spec.fields

    @property
    def head(self) -> tuple[Field, ...]:
        """Fields in front of the group; empty where there is no group."""
        return self._spec.head

    @property
    def repeat(self) -> str | int | None:
        """Number of times that the record stands there.

        None: exactly once. ``"*"``: to the end. A number: that often. A name: as often as this
        field of the head says.
        """
        return self._spec.repeat

    @property
    def group(self) -> str | None:
        """Name of the group, None where it has none."""
        return self._spec.group

    @property
    def is_list(self) -> bool:
        """True if :meth:`parse` gives a plain list of records."""
        return self._is_list

    @property
    def sequence_field(self) -> Field | None:
        """The field marked with ``@sequence``, None without one."""
        index = self._sequence_index
        return None if index is None else (*self.head, *self.fields)[index]

    @property
    def head_size(self) -> int:
        """Bytes in front of the first record."""
        return self._codecs["little"][0].size

    @property
    def size(self) -> int:
        """Bytes of one record."""
        return self._codecs["little"][1].size

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Layout):
            return NotImplemented
        return self._text == other._text and self._lenient == other._lenient

    def __hash__(self) -> int:
        return hash((self._text, self._lenient))

    def __str__(self) -> str:
        return self._text

    def __repr__(self) -> str:
        return f"Layout({self._text!r}{', lenient=True' if self._lenient else ''})"

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(Layout, lenient=self._lenient), (self._text,)

    # -- values ------------------------------------------------------------------------------

    def parse(self, payload: Payload, byte_order: ByteOrder = "little") -> Any:
        """Return the values of a container; what they come as is the layout text's to say.

        Args:
            payload: the container's bytes behind the application id.
            byte_order: order of the bytes of a number, as the camera's status says.

        Returns:
            Without a group a :class:`Record`. With a group without a name, and nothing before it
            but a count or the sequence number, a list of records. Otherwise a record of the
            head's fields and one more, the list, named as the group is (``records`` without a
            name). A field with a unit is a float in SI.

        Raises:
            InterpretationError: the payload does not fit; field, offset, expected and got.
        """
        head, records = self._codecs[byte_order]
        if self._spec.repeat is None:
            self._count(payload, head, records)
            return records.read_one(payload)
        rows = self.wire_records(payload, byte_order)
        values = records.read(rows, payload, head.size, what="record")
        if self._is_list:
            return values
        names = (*(field.name for field in self.head), self._spec.group_field)
        units = (*(field.symbol for field in self.head), "")
        front = head.read_one(payload) if self.head else ()
        result: Record = Record.__new__(record_class(names, units), (*front, values))
        return result

    def parse_records(self, payload: Payload, byte_order: ByteOrder = "little") -> list[Record]:
        """Return the records alone, whatever stands before them; one where there is no group.

        Record ``i`` begins at byte ``head_size + i * size``.

        Raises:
            InterpretationError: as in :meth:`parse`.
        """
        head, records = self._codecs[byte_order]
        rows = self.wire_records(payload, byte_order)
        return records.read(rows, payload, head.size, what=self._record_word)

    def wire_records(self, payload: Payload, byte_order: ByteOrder = "little") -> Rows:
        """Return the values of the same records as they are on the wire, one by one.

        Units are the wire's, texts are bytes as the camera sent them, bools are numbers from 0 to
        255, which nothing has checked.

        Raises:
            InterpretationError: the payload's size does not fit.
        """
        head, records = self._codecs[byte_order]
        data = payload if type(payload) is bytes else bytes(payload)
        if self._to_end:
            try:
                return records.unpack_all(data)
            except struct.error:
                pass  # no whole records: the checks below say where
        return records.unpack(data, head.size, self._count(data, head, records))

    def parse_table(
        self, payload: Payload, byte_order: ByteOrder = "little"
    ) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return the records as a structured numpy array of one dimension, read-only.

        A zero-copy view of ``payload`` where nothing is to be converted: no unit, no bool, the
        machine's own byte order. Otherwise a copy: fields with a unit are float64 in SI, bools
        are ``?``, the byte order is the machine's. Texts are bytes as the camera sent them
        (``S20``), neither decoded nor cut at the first zero.

        Raises:
            InterpretationError: the payload does not fit, or a byte is no bool.
        """
        view = self._views.get(byte_order)
        if view is not None and type(payload) is bytes:  # which numpy makes read-only tables of
            try:
                rows: np.ndarray[tuple[int], np.dtype[np.void]] = self._frombuffer(payload, view)
            except ValueError:
                pass  # no whole records: the checks below say where
            else:
                if self._fixed is None or len(rows) == self._fixed:
                    return rows
        head, records = self._codecs[byte_order]
        count = self._count(payload, head, records)
        return self._table(byte_order).read(payload, head.size, count, what=self._record_word)

    def parse_tables(
        self, payloads: Sequence[bytes], byte_order: ByteOrder = "little"
    ) -> list[np.ndarray[tuple[int], np.dtype[np.void]]]:
        """Return the tables of several payloads, each as by :meth:`parse_table`."""
        view, make = self._views.get(byte_order), self._frombuffer
        if view is not None and self._fixed is None:
            try:
                return [make(payload, view) for payload in payloads]
            except ValueError:
                pass  # one of them is no whole records, or empty
        return [self.parse_table(payload, byte_order) for payload in payloads]

    def sequence(self, payload: Payload, byte_order: ByteOrder = "little") -> int | None:
        """Return the value of the ``@sequence`` field.

        Returns:
            The head's, or that of the first record; None without such a field, and without
            records where it is in the record.

        Raises:
            InterpretationError: the payload's size does not fit.
        """
        head, records = self._codecs[byte_order]
        count = self._count(payload, head, records)
        index, front = self._sequence_index, len(head.fields)
        if index is None:
            return None
        if index < front:
            return int(head.read_field(payload, 0, index))
        return int(records.read_field(payload, head.size, index - front)) if count else None

    def build(
        self,
        value: object,
        byte_order: ByteOrder = "little",
        *,
        slots: int | None = None,
        sequence: int | None = None,
    ) -> bytes:
        """Return the container's bytes for ``value``: what :meth:`parse` reads back.

        Args:
            value: what :meth:`parse` returns; a record may be a mapping, a :class:`Record`, a
                sequence of its values in order, or an object of a class (:meth:`of`). A mapping may
                leave out the count field.
                Values of fields with a unit are SI; integers are rounded to the wire's unit.
            byte_order: order of the bytes of a number.
            slots: pad with records of zeros up to this number, as the camera does.
            sequence: value of the ``@sequence`` field; goes before the one in ``value``. A list
                layout that has one in its head and is given none gets 0.

        Raises:
            ConfigurationError: a value does not fit its field, is missing or unknown.
        """
        head, codec = self._codecs[byte_order]
        forced = self._forced(sequence)
        if self._spec.repeat is None:
            if slots is not None:
                raise ConfigurationError("layout: slots= is for layouts with a group")
            return codec.write(codec.take(value, "", forced), "")
        front, records = self._split(value, forced)
        padding = self._padding(len(records), slots)
        parts = [head.write(front, "")] if self.head else []
        for number, record in enumerate(records):
            what = f"record {number}: "
            parts.append(codec.write(codec.take(record, what, forced), what))
        return b"".join((*parts, bytes(padding * codec.size)))

    # -- numpy, pydantic, files --------------------------------------------------------------

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One record as it is on the wire: packed, little endian, bools ``u1``, texts ``S20``."""
        return self.dtype_for("little")

    def dtype_for(self, byte_order: ByteOrder) -> np.dtype[np.void]:
        """Return the wire's dtype of one record in a byte order."""
        return self._table(byte_order).dtype

    @property
    def model(self) -> type[BaseModel]:
        """The pydantic model of what :meth:`parse` gives; units stand in the descriptions.

        A ``RootModel`` of a list for list layouts. A field whose name pydantic keeps for itself
        (``json``, ``copy``, ...) has that name as alias.
        """
        if self._model is None:
            from smartcam.layout._files import make_model

            self._model = make_model(self._spec)
        return self._model

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON Schema of what :meth:`parse` gives.

        NaN and infinity, which JSON has no word for, are null in smartcam's JSON.
        """
        return self.model.model_json_schema()

    def to_dict(self) -> dict[str, Any]:
        """Return the layout as plain data, which :meth:`from_dict` takes back."""
        from smartcam.layout._files import to_data

        return to_data(self._spec, lenient=self._lenient)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Layout:
        """Return the layout that plain data describes.

        Args:
            data: ``fields`` (each with ``name``, ``type`` and, where wanted, ``unit`` and
                ``sequence``), and where wanted ``head``, ``repeat``, ``group``, ``lenient``.

        Raises:
            ConfigurationError: unknown keys or values of the wrong type.
            LayoutError: what they say makes no layout.
        """
        from smartcam.layout._files import from_data

        text, lenient = from_data(data)
        return cls(text, lenient=lenient)

    def to_yaml(self) -> str:
        """Return the layout as YAML, which :meth:`from_yaml` takes back.

        Raises:
            MissingExtraError: PyYAML is not installed.
        """
        from smartcam.layout._files import dump_yaml

        return dump_yaml(self.to_dict())

    @classmethod
    def from_yaml(cls, text: str) -> Layout:
        """Return the layout of a YAML document: what :meth:`to_yaml` writes, or a layout text.

        Raises:
            ConfigurationError: unknown keys or values of the wrong type.
            LayoutError: the text is neither YAML nor a layout text, or makes no layout.
            MissingExtraError: PyYAML is not installed.
        """
        from smartcam.layout._files import load_yaml

        loaded = load_yaml(text)
        return cls.from_dict(loaded) if isinstance(loaded, Mapping) else cls(loaded)

    def _table(self, byte_order: ByteOrder) -> TableCodec:
        """Return the codec of tables; made where one is first asked for, because of numpy."""
        if byte_order not in self._tables:
            import numpy as np

            from smartcam.layout._tables import TableCodec

            codec = TableCodec(self._codecs[byte_order][1], byte_order)
            self._frombuffer = np.frombuffer
            if codec.is_view and not self._spec.head:
                self._views[byte_order] = codec.dtype
            self._tables[byte_order] = codec
        return self._tables[byte_order]

    # -- sizes -------------------------------------------------------------------------------

    def _count(self, payload: Payload, head: RecordCodec, codec: RecordCodec) -> int:
        """Return the number of records that are to be read, having checked the size."""
        got = len(payload)
        count, remainder = divmod(got - head.size, codec.size)
        fixed, repeat = self._fixed, self._spec.repeat
        if got < head.size:
            raise self._misfit(head, got, 0, None)
        if remainder or (fixed is not None and fixed != count):
            raise self._misfit(codec, got, head.size, fixed)
        if not isinstance(repeat, str) or repeat == "*":
            return count
        index = next(i for i, field in enumerate(head.fields) if field.name == repeat)
        told = int(head.read_field(payload, 0, index))
        if not 0 <= told <= count:
            more = f", as many records of {codec.size} bytes as the container holds"
            raise misfit(head.fields[index], head.offsets[index], f"0 to {count}", told, more=more)
        return told

    def _misfit(
        self, codec: RecordCodec, got: int, start: int, count: int | None
    ) -> InterpretationError:
        """Return the error for a payload of the wrong length: its cut field or surplus bytes.

        ``codec``: of the record (or the head) that does not fit. ``got``: bytes of the payload.
        ``start``: where the first record begins. ``count``: of records that must be there, None for
        any.
        """
        full = max(0, got - start) // codec.size
        at = start + codec.size * (full if count is None else min(full, count))
        if count is not None and full >= count:
            hint = "; for several records write ( ... )*" if self._spec.repeat is None else ""
            expected = start + count * codec.size
            return InterpretationError(
                f"container: expected {expected} bytes, got {got}: "
                f"{got - expected} too many from offset {at}{hint}",
                offset=at,
                expected=expected,
                got=got,
            )
        field, offset = codec.field_at(got - at)
        expected = at + codec.size if count is None else start + count * codec.size
        record = (
            "" if self._spec.repeat is None or codec.fields is self.head else f"record {full}: "
        )
        return InterpretationError(
            f"{record}{field.label} at offset {at + offset}: expected {field.size} bytes, "
            f"got {got - at - offset} (the container has {got} bytes, expected {expected})",
            field=field.name,
            offset=at + offset,
            expected=expected,
            got=got,
        )

    # -- building ----------------------------------------------------------------------------

    def _forced(self, sequence: int | None) -> dict[str, Any]:
        if sequence is None:
            return {}
        field = self.sequence_field
        if field is None:
            raise ConfigurationError(
                f"layout: expected a field with @sequence for sequence={sequence}, "
                f"got {self._text!r}"
            )
        return {field.name: sequence}

    def _split(self, value: object, forced: Mapping[str, Any]) -> tuple[list[Any], list[Any]]:
        """Return the head's values and the records."""
        count = self.repeat if self.repeat != "*" else None
        if self._spec.is_list:
            records = _list_of_records(value)
            given: dict[str, Any] = {field.name: 0 for field in self.head}
            given.update({name: forced[name] for name in given if name in forced})
            given.update({name: len(records) for name in given if name == count})
            return list(given.values()), records
        names = [*(field.name for field in self.head), self._spec.group_field]
        given = named(value, names, "")
        records = _list_of_records(given.get(names[-1], ()))  # a missing one is told below
        if isinstance(count, str):
            given.setdefault(count, len(records))
        given.update({name: forced[name] for name in names if name in forced})
        check_names(given, names, "")
        if isinstance(count, str) and given[count] != len(records):
            raise ConfigurationError(
                f"layout: count field {count!r}: expected {len(records)}, the number of records, "
                f"got {given[count]!r}"
            )
        return [given[name] for name in names[:-1]], records

    def _padding(self, count: int, slots: int | None) -> int:
        repeat = self._spec.repeat
        wanted = count if slots is None else slots
        if wanted < count:
            raise ConfigurationError(f"layout: expected at most {slots} records, got {count}")
        if isinstance(repeat, int) and wanted != repeat:
            raise ConfigurationError(
                f"layout: expected {repeat} records, got {count}; slots={repeat} pads with zeros"
            )
        return wanted - count


def _list_of_records(value: object) -> list[Any]:
    records: Any = value
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray, Record)):
        raise ConfigurationError(f"layout: expected a list of records, got {value!r:.200}")
    return list(records)
