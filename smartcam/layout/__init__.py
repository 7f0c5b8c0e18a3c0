"""The layout of a result container: which fields it holds, in which order, in which unit.

A container carries no types and no names (SC manual p. 33, published), so the user describes the
fields that were configured on the camera::

    "passed: bool, x: real32 mm, code: string[20]"      exactly one record
    "(x: real32 mm, y: real32 mm)*"                     records to the end: a list
    "(x: real32 mm, y: real32 mm)[32]"                  exactly 32 records
    "n: int32, (x: real32 mm, y: real32 mm)[n]"         n records, then unused ones

One :class:`Layout` has many uses: values (:meth:`~Layout.parse`), bytes (:meth:`~Layout.build`),
numpy (:attr:`~Layout.dtype`, :meth:`~Layout.parse_table`), pydantic, JSON Schema and YAML. Heavy
libraries are imported when they are first used.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_flag, check_integer, wrong_argument
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.layout._classes import read_class
from smartcam.layout._codec import (
    Payload,
    Record,
    RecordCodec,
    check_names,
    record_class,
    split_rows,
    values_by_name,
)
from smartcam.layout._compiled import compile_text
from smartcam.layout._text import misfit_error

if TYPE_CHECKING:
    import numpy as np
    from pydantic import BaseModel

    from smartcam.layout._codec import Rows
    from smartcam.layout._tables import TableCodec
    from smartcam.layout._text import Field
    from smartcam.models import ByteOrder

__all__ = ["Layout", "Record"]


class Layout:
    """The fields of a result container; immutable, and equal to every layout with the same text.

    Args:
        text: the layout text; new lines are white space, ``#`` begins a comment.
        lenient: whether any byte except zero counts as True in a bool; otherwise only 0xFF is True
            and only 0x00 False, as the camera sends them.
        start: index at which the layout begins in ``text``; positions of mistakes still count from
            the start of ``text``.

    Raises:
        LayoutError: the text has a mistake; the error gives its position.
    """

    __slots__ = (
        *("_codecs", "_compiled", "_lenient", "_model", "_spec", "_text"),
        *("_fills_payload", "_fixed_count", "_is_list", "_record_word", "_sequence_index"),
        *("_frombuffer", "_tables", "_views"),
    )

    def __init__(self, text: str, *, lenient: bool = False, start: int = 0) -> None:
        if not isinstance(text, str):  # errors in the text are reported with their place in it
            raise wrong_argument("layout", "a text", text)
        lenient, start = check_flag(lenient, "lenient"), check_integer(start, "start", 0, len(text))
        compiled = compile_text(text, start, lenient=lenient)
        self._compiled = compiled  # the cache keeps this entry as long as a layout refers to it
        self._spec = compiled.spec
        self._text = compiled.text
        self._lenient = lenient
        self._codecs = compiled.codecs
        self._fixed_count = compiled.fixed_count
        self._fills_payload = compiled.fills_payload
        self._is_list = compiled.is_list
        self._record_word = compiled.record_word
        self._sequence_index = compiled.sequence_index
        # each layout has its own model and dtypes, since a user may change them
        self._model: type[BaseModel] | None = None
        self._tables: dict[ByteOrder, TableCodec] = {}
        # for tables that fill the payload: the dtype, and the function that makes a table
        self._views: dict[ByteOrder, np.dtype[np.void]] = {}
        self._frombuffer: Any = None

    @classmethod
    def of(cls, described: Any, *, lenient: bool = False) -> Layout:
        """Return the layout that a class describes.

        ``Annotated[float, "real32 mm"]`` is a field; ``bool`` is one by itself;
        ``Annotated[list[Part], "*"]`` is a group of records that another class describes, and must
        come last. ``interpret_as=`` accepts such a class and returns its objects; :meth:`build`
        accepts the objects.

        Args:
            described: a dataclass, a pydantic model or a NamedTuple; ``list[Part]`` for records to
                the end.
            lenient: as for :class:`Layout`.

        Raises:
            LayoutError: the layout text of a field is missing, is wrong (with the place), or does
                not match its type.
        """
        return cls(read_class(described).text, lenient=lenient)

    # -- properties -----------------------------------------------------------------------------

    @property
    def text(self) -> str:
        """The canonical text: one line, single spaces, no comments."""
        return self._text

    @property
    def lenient(self) -> bool:
        """True if any byte except zero counts as True in a bool."""
        return self._lenient

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields of a record."""
        return self._spec.fields

    @property
    def head(self) -> tuple[Field, ...]:
        """Fields before the group; empty if there is no group."""
        return self._spec.head

    @property
    def repeat(self) -> str | int | None:
        """Number of records.

        None: exactly one record. ``"*"``: the records up to the end. A number: exactly so many
        records. A name: as many records as the value of this field of the head.
        """
        return self._spec.repeat

    @property
    def group(self) -> str | None:
        """Name of the group; None if it has none."""
        return self._spec.group

    @property
    def is_list(self) -> bool:
        """True if :meth:`parse` gives a plain list of records."""
        return self._is_list

    @property
    def sequence_field(self) -> Field | None:
        """The field marked with ``@sequence``; None without one."""
        index = self._sequence_index
        return None if index is None else (*self.head, *self.fields)[index]

    @property
    def head_size(self) -> int:
        """Number of bytes before the first record."""
        return self._codecs["little"][0].size

    @property
    def size(self) -> int:
        """Number of bytes of one record."""
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
        """Return the values of a container, in the form that the layout text defines.

        Args:
            payload: the container's bytes after the application id.
            byte_order: byte order of numbers, as in the camera's status.

        Returns:
            Without a group, a :class:`Record`. With a group that has no name and only a count or
            the sequence number before it, a list of records. Otherwise, a record of the head's
            fields and the list, which has the name of the group (``records`` without a name). A
            field with a unit is a float in SI.

        Raises:
            InterpretationError: the payload does not fit; the error has field, offset, expected and
                got.
        """
        head, records = self._codecs[byte_order]
        if self._spec.repeat is None:
            self._count_records(payload, head, records)
            return records.read_one(payload)
        rows = self.wire_records(payload, byte_order)
        values = records.read(rows, payload, head.size, label="record")
        if self._is_list:
            return values
        head_values = head.read_one(payload) if self.head else ()
        result: Record = Record.__new__(self._value_class(), (*head_values, values))
        return result

    def parse_all(self, payloads: Sequence[bytes], byte_order: ByteOrder = "little") -> list[Any]:
        """Return the values of several payloads, each as from :meth:`parse`.

        Raises:
            InterpretationError: a payload does not fit; the error is that of the first one.
        """
        unpacked = self.wire_rows(payloads, byte_order)
        if unpacked is not None:
            rows, counts = unpacked
            try:
                records = self._codecs[byte_order][1].convert(rows)
            except (KeyError, UnicodeDecodeError):
                pass  # reading one payload after the other finds the place of the error
            else:
                if self._spec.repeat is None:
                    return list(records)
                lists = split_rows(records, counts)
                if self._is_list:
                    return lists
                value_class = self._value_class()
                return [Record.__new__(value_class, (items,)) for items in lists]
        return [self.parse(payload, byte_order) for payload in payloads]

    def wire_rows(
        self, payloads: Sequence[bytes], byte_order: ByteOrder = "little"
    ) -> tuple[Rows, list[int]] | None:
        """Return the rows of all payloads, as :meth:`wire_records` does, and the row counts.

        None if the layout has a head, or if the size of a payload does not fit.
        """
        codec = self._codecs[byte_order][1]
        size, fixed = codec.size, self._fixed_count
        if self._spec.head:
            return None
        counts = [len(payload) // size for payload in payloads]
        data = b"".join(payloads)
        if sum(counts) * size != len(data):
            return None
        if fixed is not None and counts.count(fixed) != len(counts):
            return None
        return codec.unpack_all(data), counts

    def parse_records(self, payload: Payload, byte_order: ByteOrder = "little") -> list[Record]:
        """Return only the records, without the head; one record if the layout has no group.

        Record ``i`` begins at byte ``head_size + i * size``.

        Raises:
            InterpretationError: as in :meth:`parse`.
        """
        head, records = self._codecs[byte_order]
        rows = self.wire_records(payload, byte_order)
        return records.read(rows, payload, head.size, label=self._record_word)

    def wire_records(self, payload: Payload, byte_order: ByteOrder = "little") -> Rows:
        """Return the unconverted values of each record of :meth:`parse_records`.

        Numbers have their unit on the wire, texts are bytes as the camera sent them, bools are
        unchecked numbers from 0 to 255.

        Raises:
            InterpretationError: the payload's size does not fit.
        """
        head, records = self._codecs[byte_order]
        data = payload if type(payload) is bytes else bytes(payload)
        if self._fills_payload:
            try:
                return records.unpack_all(data)
            except struct.error:
                pass  # not whole records: the checks below find the place
        return records.unpack(data, head.size, self._count_records(data, head, records))

    def parse_table(
        self, payload: Payload, byte_order: ByteOrder = "little"
    ) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return the records as a structured numpy array of one dimension, read-only.

        It is a zero-copy view of ``payload`` if nothing has to be converted: no unit, no bool, the
        machine's own byte order. Otherwise it is a copy: fields with a unit are float64 in SI,
        bools are ``?``, the byte order is the machine's. Texts are bytes as the camera sent them
        (``S20``), neither decoded nor cut at the first zero.

        Raises:
            InterpretationError: the payload does not fit, or a byte is no bool.
        """
        view = self._views.get(byte_order)
        if view is not None and type(payload) is bytes:  # numpy makes read-only tables of bytes
            try:
                rows: np.ndarray[tuple[int], np.dtype[np.void]] = self._frombuffer(payload, view)
            except ValueError:
                pass  # not whole records: the checks below find the place
            else:
                if self._fixed_count is None or len(rows) == self._fixed_count:
                    return rows
        head, records = self._codecs[byte_order]
        count = self._count_records(payload, head, records)
        return self._table(byte_order).read(payload, head.size, count, label=self._record_word)

    def parse_tables(
        self, payloads: Sequence[bytes], byte_order: ByteOrder = "little"
    ) -> list[np.ndarray[tuple[int], np.dtype[np.void]]]:
        """Return the tables of several payloads, each as from :meth:`parse_table`."""
        view, view_table = self._views.get(byte_order), self._frombuffer
        if view is not None and self._fixed_count is None:
            try:
                return [view_table(payload, view) for payload in payloads]
            except ValueError:
                pass  # a payload has no whole records, or is empty
        return [self.parse_table(payload, byte_order) for payload in payloads]

    def sequence(self, payload: Payload, byte_order: ByteOrder = "little") -> int | None:
        """Return the value of the ``@sequence`` field.

        Returns:
            The value in the head, or the value in the first record; None if the layout has no such
            field, or if the field is in the record and there are no records.

        Raises:
            InterpretationError: the payload's size does not fit.
        """
        head, records = self._codecs[byte_order]
        count = self._count_records(payload, head, records)
        index, head_length = self._sequence_index, len(head.fields)
        if index is None:
            return None
        if index < head_length:
            return int(head.read_field(payload, 0, index))
        return int(records.read_field(payload, head.size, index - head_length)) if count else None

    def build(
        self,
        value: object,
        byte_order: ByteOrder = "little",
        *,
        slots: int | None = None,
        sequence: int | None = None,
    ) -> bytes:
        """Return the bytes of a container with ``value``, which :meth:`parse` reads back.

        Args:
            value: a value as from :meth:`parse`; a record may be a mapping, a :class:`Record`, a
                sequence of its values in order, or an object of a class (:meth:`of`). A mapping may
                leave out the count field. Values of fields with a unit are in SI; integers are
                rounded to the wire's unit.
            byte_order: byte order of numbers.
            slots: number of records up to which records of zeros are appended, as the camera does.
            sequence: value of the ``@sequence`` field, which overrides the one in ``value``. If
                ``value`` is a list and the head has such a field, the default is 0.

        Raises:
            ConfigurationError: a value does not fit its field, or is missing or unknown.
        """
        head, codec = self._codecs[byte_order]
        forced = self._forced_values(sequence)
        if self._spec.repeat is None:
            if slots is not None:
                raise ConfigurationError("layout: slots= is for layouts with a group")
            return codec.write(codec.values_in_order(value, "", forced), "")
        head_values, records = self._split_value(value, forced)
        padding = self._count_padding(len(records), slots)
        parts = [head.write(head_values, "")] if self.head else []
        for number, record in enumerate(records):
            prefix = f"record {number}: "
            parts.append(codec.write(codec.values_in_order(record, prefix, forced), prefix))
        return b"".join((*parts, bytes(padding * codec.size)))

    # -- numpy, pydantic, files --------------------------------------------------------------

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Packed dtype of one record on the wire: little endian, bools ``u1``, texts ``S20``."""
        return self.dtype_for("little")

    def dtype_for(self, byte_order: ByteOrder) -> np.dtype[np.void]:
        """Return the dtype of one record on the wire in a byte order."""
        return self._table(byte_order).dtype

    @property
    def model(self) -> type[BaseModel]:
        """The pydantic model of the values from :meth:`parse`, with units in the descriptions.

        A ``RootModel`` of a list for list layouts. A field whose name pydantic reserves (``json``,
        ``copy``, ...) has that name as its alias.
        """
        if self._model is None:
            from smartcam.layout._files import make_model

            self._model = make_model(self._spec)
        return self._model

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON Schema of the values from :meth:`parse`.

        NaN and infinity, which JSON cannot express, are null in smartcam's JSON.
        """
        return self.model.model_json_schema()

    def to_dict(self) -> dict[str, Any]:
        """Return the layout as plain data, which :meth:`from_dict` reads."""
        from smartcam.layout._files import to_data

        return to_data(self._spec, lenient=self._lenient)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Layout:
        """Return the layout that plain data describes.

        Args:
            data: ``fields`` (each with ``name``, ``type`` and optionally ``unit`` and
                ``sequence``), and optionally ``head``, ``repeat``, ``group``, ``lenient``.

        Raises:
            ConfigurationError: the data have unknown keys, or values of the wrong type.
            LayoutError: the data describe no valid layout.
        """
        from smartcam.layout._files import from_data

        text, lenient = from_data(data)
        return cls(text, lenient=lenient)

    def to_yaml(self) -> str:
        """Return the layout as YAML, which :meth:`from_yaml` reads.

        Raises:
            MissingExtraError: PyYAML is not installed.
        """
        from smartcam.layout._files import dump_yaml

        return dump_yaml(self.to_dict())

    @classmethod
    def from_yaml(cls, text: str) -> Layout:
        """Return the layout in a YAML document from :meth:`to_yaml`, or with a layout text.

        Raises:
            ConfigurationError: the document has unknown keys, or values of the wrong type.
            LayoutError: the text is neither YAML nor a layout text, or describes no valid layout.
            MissingExtraError: PyYAML is not installed.
        """
        from smartcam.layout._files import load_yaml

        loaded = load_yaml(text)
        return cls.from_dict(loaded) if isinstance(loaded, Mapping) else cls(loaded)

    def _value_class(self) -> type[Record]:
        """Return the class of values that have the head's fields, and the list of records."""
        names = (*(field.name for field in self.head), self._spec.group_field)
        return record_class(names, (*(field.symbol for field in self.head), ""))

    def _table(self, byte_order: ByteOrder) -> TableCodec:
        """Return the codec of tables, which is created on first use since it needs numpy."""
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

    def _count_records(self, payload: Payload, head: RecordCodec, codec: RecordCodec) -> int:
        """Check the size of a payload, and return the number of records to read."""
        size = len(payload)
        count, remainder = divmod(size - head.size, codec.size)
        fixed, repeat = self._fixed_count, self._spec.repeat
        if size < head.size:
            raise self._size_error(head, size, 0, None)
        if remainder or (fixed is not None and fixed != count):
            raise self._size_error(codec, size, head.size, fixed)
        if not isinstance(repeat, str) or repeat == "*":
            return count
        index = next(i for i, field in enumerate(head.fields) if field.name == repeat)
        given = int(head.read_field(payload, 0, index))
        if not 0 <= given <= count:
            more = f", as many records of {codec.size} bytes as the container holds"
            raise misfit_error(
                head.fields[index], head.offsets[index], f"0 to {count}", given, more=more
            )
        return given

    def _size_error(
        self, codec: RecordCodec, size: int, start: int, count: int | None
    ) -> InterpretationError:
        """Return the error for a payload of a wrong size: a truncated field or surplus bytes.

        ``codec``: codec of the record (or the head) that does not fit. ``size``: number of bytes
        of the payload. ``start``: offset of the first record. ``count``: required number of
        records, or None for any.
        """
        whole_records = max(0, size - start) // codec.size
        at = start + codec.size * (whole_records if count is None else min(whole_records, count))
        if count is not None and whole_records >= count:
            hint = "; for several records write ( ... )*" if self._spec.repeat is None else ""
            expected = start + count * codec.size
            return InterpretationError(
                f"container: expected {expected} bytes, got {size}: "
                f"{size - expected} too many from offset {at}{hint}",
                offset=at,
                expected=expected,
                got=size,
            )
        field, offset = codec.field_at(size - at)
        expected = at + codec.size if count is None else start + count * codec.size
        record = (
            ""
            if self._spec.repeat is None or codec.fields is self.head
            else f"record {whole_records}: "
        )
        return InterpretationError(
            f"{record}{field.label} at offset {at + offset}: expected {field.size} bytes, "
            f"got {size - at - offset} (the container has {size} bytes, expected {expected})",
            field=field.name,
            offset=at + offset,
            expected=expected,
            got=size,
        )

    # -- building ----------------------------------------------------------------------------

    def _forced_values(self, sequence: int | None) -> dict[str, Any]:
        if sequence is None:
            return {}
        field = self.sequence_field
        if field is None:
            raise ConfigurationError(
                f"layout: expected a field with @sequence for sequence={sequence}, "
                f"got {self._text!r}"
            )
        return {field.name: sequence}

    def _split_value(self, value: object, forced: Mapping[str, Any]) -> tuple[list[Any], list[Any]]:
        """Split a value into the head's values and the records."""
        count = self.repeat if self.repeat != "*" else None
        if self._spec.is_list:
            records = _list_of_records(value)
            given: dict[str, Any] = {field.name: 0 for field in self.head}
            given.update({name: forced[name] for name in given if name in forced})
            given.update({name: len(records) for name in given if name == count})
            return list(given.values()), records
        names = [*(field.name for field in self.head), self._spec.group_field]
        given = values_by_name(value, names, "")
        records = _list_of_records(given.get(names[-1], ()))  # a missing group is reported below
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

    def _count_padding(self, count: int, slots: int | None) -> int:
        repeat = self._spec.repeat
        slot_count = count if slots is None else slots
        if slot_count < count:
            raise ConfigurationError(f"layout: expected at most {slots} records, got {count}")
        if isinstance(repeat, int) and slot_count != repeat:
            raise ConfigurationError(
                f"layout: expected {repeat} records, got {count}; slots={repeat} pads with zeros"
            )
        return slot_count - count


def _list_of_records(value: object) -> list[Any]:
    records: Any = value
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray, Record)):
        raise ConfigurationError(f"layout: expected a list of records, got {value!r:.200}")
    return list(records)
