"""Define interpreters, which turn a result container's bytes into a value.

An interpreter keeps nothing between results and guesses nothing. The shortest one is a function
over a :class:`Reader`; an interpreter with a layout is a subclass of :class:`Interpreter`.
:func:`resolve` turns the user's ``interpret_as`` into an interpreter; interpreters are called only
by the functions whose names begin with ``run``.
"""

from __future__ import annotations

import functools
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NoReturn, TypeAlias, TypeVar

from smartcam._arguments import check_flag, excerpt
from smartcam._suggestions import closest, did_you_mean
from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.exceptions import (
    ConfigurationError,
    InterpretationError,
    LayoutError,
    PluginError,
    SmartCamError,
)
from smartcam.layout import Layout
from smartcam.layout._inside import TYPES, describes_layout, read_class
from smartcam.registry import INTERPRETERS

if TYPE_CHECKING:
    from smartcam.models import ByteOrder

T = TypeVar("T")

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(slots=True)
class Context:
    """The facts about a container that an interpreter may use, in addition to the bytes.

    Attributes:
        camera: name of the camera.
        application: id of the application that made the container.
        number: the client's own count of containers.
        received_at: time at which the container's last byte arrived, UTC.
        byte_order: order of the bytes of a number, from the camera's status.
        y_down: whether the camera's y axis points down; poses are then converted to y up.
        lenient: whether any byte except zero is a true bool.
        empty_slots: number of skipped records of zeros, which the interpreter counts.
    """

    camera: str = ""
    application: int = 0
    number: int = 0
    received_at: datetime = _EPOCH
    byte_order: ByteOrder = "little"
    y_down: bool = False
    lenient: bool = False
    empty_slots: int = 0


@functools.lru_cache(maxsize=64)
def _number_struct(code: str, byte_order: str) -> struct.Struct:
    return struct.Struct(("<" if byte_order == "little" else ">") + code)


class Reader:
    """Reads values from a container's bytes; every read that does not fit is an error.

    Args:
        data: the container's bytes after the application id.
        context: other facts about the container.
        layout: the user's layout, None without one.

    All offsets are bytes from the start of ``data``. Every method raises
    :class:`~smartcam.InterpretationError` with offset, expected and got if bytes are missing.
    """

    __slots__ = ("context", "data", "layout")

    def __init__(
        self,
        data: bytes | bytearray | memoryview,
        context: Context | None = None,
        layout: Layout | None = None,
    ) -> None:
        self.data: bytes = data if type(data) is bytes else bytes(data)
        self.context: Context = Context() if context is None else context
        self.layout: Layout | None = layout

    def __len__(self) -> int:
        return len(self.data)

    def get_bool(self, first_byte: int) -> bool:
        """Return a bool: 0xFF is true, 0x00 false; other bytes are errors unless ``lenient``."""
        raw = self._slice(first_byte, 1, "a bool")[0]
        if raw not in (0x00, 0xFF) and not self.context.lenient:
            raise InterpretationError(
                f"offset {first_byte}: expected 0x00 or 0xFF for a bool, got 0x{raw:02X}",
                offset=first_byte,
                expected="0x00 or 0xFF for a bool",
                got=f"0x{raw:02X}",
            )
        return raw != 0

    def get_int8(self, first_byte: int) -> int:
        """Return an integer of one byte with a sign."""
        return int(self._unpack(first_byte, "b", "an int8"))

    def get_int16(self, first_byte: int) -> int:
        """Return an integer of two bytes with a sign."""
        return int(self._unpack(first_byte, "h", "an int16"))

    def get_int32(self, first_byte: int) -> int:
        """Return an integer of four bytes with a sign."""
        return int(self._unpack(first_byte, "i", "an int32"))

    def get_int64(self, first_byte: int) -> int:
        """Return an integer of eight bytes with a sign."""
        return int(self._unpack(first_byte, "q", "an int64"))

    def get_uint8(self, first_byte: int) -> int:
        """Return an integer of one byte."""
        return int(self._unpack(first_byte, "B", "a uint8"))

    def get_uint16(self, first_byte: int) -> int:
        """Return an integer of two bytes."""
        return int(self._unpack(first_byte, "H", "a uint16"))

    def get_uint32(self, first_byte: int) -> int:
        """Return an integer of four bytes."""
        return int(self._unpack(first_byte, "I", "a uint32"))

    def get_uint64(self, first_byte: int) -> int:
        """Return an integer of eight bytes."""
        return int(self._unpack(first_byte, "Q", "a uint64"))

    def get_real32(self, first_byte: int) -> float:
        """Return an IEEE number of four bytes; it may be NaN or infinite."""
        return float(self._unpack(first_byte, "f", "a real32"))

    def get_real64(self, first_byte: int) -> float:
        """Return an IEEE number of eight bytes; it may be NaN or infinite."""
        return float(self._unpack(first_byte, "d", "a real64"))

    def get_string(self, first_byte: int, length: int) -> str:
        """Return a text of ``length`` bytes, cut at the first zero and decoded as UTF-8."""
        raw = self._slice(first_byte, length, "a string").partition(b"\0")[0]
        try:
            return raw.decode()
        except UnicodeDecodeError as exc:
            offset = first_byte + exc.start
            raise InterpretationError(
                f"offset {offset}: expected UTF-8 text, got 0x{raw[exc.start]:02X} ({exc.reason})",
                offset=offset,
                expected="UTF-8 text",
                got=f"0x{raw[exc.start]:02X}",
            ) from exc

    def get_bytes(self, first_byte: int, length: int) -> bytes:
        """Return ``length`` bytes as they are."""
        return self._slice(first_byte, length, "bytes")

    def records(self, size: int) -> range:
        """Return the offsets of records of ``size`` bytes, which fill the container.

        Raises:
            InterpretationError: bytes are left after the last whole record.
        """
        if size < 1:
            raise ValueError(f"expected a record of at least 1 byte, got {size}")
        remainder = len(self.data) % size
        if remainder:
            offset = len(self.data) - remainder
            raise InterpretationError(
                f"offset {offset}: expected whole records of {size} bytes, got {remainder} bytes "
                f"(the container has {len(self.data)})",
                offset=offset,
                expected=size,
                got=remainder,
            )
        return range(0, len(self.data), size)

    def _unpack(self, first_byte: int, code: str, label: str) -> Any:
        number = _number_struct(code, self.context.byte_order)
        return number.unpack(self._slice(first_byte, number.size, label))[0]

    def _slice(self, first_byte: int, length: int, label: str) -> bytes:
        end = first_byte + length
        if first_byte < 0 or length < 0 or end > len(self.data):
            available = max(0, len(self.data) - max(0, first_byte))
            raise InterpretationError(
                f"offset {first_byte}: expected {label} of {length} bytes, got {available} "
                f"(the container has {len(self.data)})",
                offset=first_byte,
                expected=length,
                got=available,
            )
        return self.data[first_byte:end]


class Interpreter(ABC):
    """Turns a container's bytes into a value; keeps nothing between two containers.

    Args:
        layout: layout of the container's fields; default :attr:`default_layout`.

    Raises:
        ConfigurationError: the interpreter does not take the layout, or needs one.
    """

    default_layout: ClassVar[str | None] = None
    """Text of the layout that is used if the user gives no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "optional"
    """``none``: a layout is refused; ``optional``: one may be given; ``required``: one must be."""

    def __init__(self, layout: Layout | None = None) -> None:
        name = type(self).__name__.removesuffix("Interpreter").lower()
        if layout is not None and self.layout_use == "none":
            raise ConfigurationError(f"interpreter {name}: expected no layout, got '{layout}'")
        if layout is None and self.default_layout is not None:
            layout = Layout(self.default_layout)
        if layout is None and self.layout_use == "required":
            raise ConfigurationError(
                f"interpreter {name}: expected a layout, got none; "
                f'write one after the name, as in "{name}: x: real32 mm, y: real32 mm"'
            )
        self.layout: Layout | None = layout

    @abstractmethod
    def interpret(self, reader: Reader) -> object:
        """Return the value of a container.

        Raises:
            InterpretationError: the bytes do not fit.
        """

    def sequence(self, reader: Reader) -> int | None:
        """Return the value of the layout's ``@sequence`` field, None without one.

        Raises:
            InterpretationError: the container's size does not fit the layout.
        """
        if self.layout is None or self.layout.sequence_field is None:
            return None
        return self.layout.sequence(reader.data, reader.context.byte_order)


class PlainInterpreter(Interpreter):
    """An interpreter that reads bytes without a :class:`Reader`.

    It must not keep the context, since the client reuses one object for all containers.
    """

    def __init_subclass__(cls) -> None:
        """Use the default :meth:`read_all` if only :meth:`read` is overridden."""
        read_depth, read_all_depth = (
            next(index for index, base in enumerate(cls.__mro__) if name in vars(base))
            for name in ("read", "read_all")
        )
        if read_depth < read_all_depth:
            cls.read_all = PlainInterpreter.read_all  # type: ignore[method-assign]

    @abstractmethod
    def read(self, data: bytes, context: Context) -> object:
        """Return the value of a container.

        Raises:
            InterpretationError: the bytes do not fit.
        """

    def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
        """Return the values of several containers that came together, each as from :meth:`read`.

        Override this method to read faster. If it raises, the containers are read again, one by
        one.
        """
        values: list[object] = []
        for data in containers:
            values.append(self.read(data, context))
            context.number += 1
        return values

    def interpret(self, reader: Reader) -> object:
        """Return the value that :meth:`read` returns."""
        return self.read(reader.data, reader.context)


Function: TypeAlias = Callable[[Reader], object]
"""The shortest interpreter: a function of a reader; ``reader.layout`` is the user's layout."""

Spec: TypeAlias = str | Layout | Interpreter | type[Interpreter] | type[Any] | Function | None
"""Values of ``interpret_as`` for one application."""

AnySpec: TypeAlias = str | Layout | Interpreter | type[Interpreter] | Mapping[int, Any] | None
"""Values of ``interpret_as`` that do not show a type checker the type of a result's value."""

TypedSpec: TypeAlias = Callable[[Reader], T] | type[T]
"""Values of ``interpret_as`` that show the type of a result's value."""


class _FunctionInterpreter(Interpreter):
    """An interpreter around a plain function."""

    def __init__(self, function: Function, layout: Layout | None = None) -> None:
        super().__init__(layout)
        self._function = function

    def interpret(self, reader: Reader) -> object:
        """Return the value that the function returns."""
        return self._function(reader)

    def __repr__(self) -> str:
        return f"<interpreter {getattr(self._function, '__name__', self._function)}>"


class _ClassInterpreter(PlainInterpreter):
    """Returns objects of a class that declares a layout."""

    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def __init__(self, described: Any, *, lenient: bool) -> None:
        text, self._make = read_class(described)
        super().__init__(Layout(text, lenient=lenient))
        self._described = described

    def read(self, data: bytes, context: Context) -> Any:
        """Return an object, or the list of them."""
        return self._make(self.layout.parse(data, context.byte_order))

    def read_all(self, containers: Sequence[bytes], context: Context) -> list[Any]:
        """Return an object, or the list of them, for each container."""
        return list(map(self._make, self.layout.parse_all(containers, context.byte_order)))

    def __repr__(self) -> str:
        return f"<interpreter {getattr(self._described, '__name__', self._described)}>"


def run(interpreter: Interpreter, reader: Reader) -> object:
    """Run an interpreter, and return the value of a container.

    Any error of an interpreter becomes an InterpretationError, so a mistake in a plug-in is an
    outcome like any other.

    Raises:
        InterpretationError: the bytes do not fit, or the interpreter failed; then the cause is
            chained.
    """
    if reader.layout is None:
        reader.layout = interpreter.layout
    try:
        return interpreter.interpret(reader)
    except InterpretationError:
        raise
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:
        raise _interpretation_error(exc, reader.data) from exc


def run_sequence(interpreter: Interpreter, reader: Reader) -> int | None:
    """Return the container's sequence number, or None; raise the errors of :func:`run`."""
    try:
        return interpreter.sequence(reader)
    except InterpretationError:
        raise
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:
        raise _interpretation_error(exc, reader.data) from exc


def as_plain_interpreter(interpreter: Interpreter) -> PlainInterpreter | None:
    """Return the interpreter if :func:`run_plain` can run it, None if it needs a Reader."""
    if not isinstance(interpreter, PlainInterpreter):
        return None
    overridden = type(interpreter).interpret is not PlainInterpreter.interpret
    return None if overridden else interpreter


def run_plain(interpreter: PlainInterpreter, data: bytes, context: Context) -> object:
    """Run a plain interpreter on a container; raise the errors of :func:`run`."""
    try:
        return interpreter.read(data, context)
    except InterpretationError:
        raise
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:
        raise _interpretation_error(exc, data) from exc


def _interpretation_error(exc: BaseException, data: bytes) -> InterpretationError:
    return InterpretationError(
        f"the interpreter failed with {text_of(exc)} (the container has {len(data)} bytes)",
        got=text_of(exc),
    )


def resolve(spec: Spec, *, lenient: bool = False) -> Interpreter:
    """Return the interpreter that ``spec`` stands for.

    Args:
        spec: None (``raw``), a name (``"localizations"``), a layout text, a name with a layout
            (``"table: x: real32 mm"``), a :class:`~smartcam.Layout`, an interpreter, its class,
            a function of a :class:`Reader`, or a class that declares a layout
            (:meth:`smartcam.Layout.of`).
        lenient: whether any byte except zero is a true bool.

    Raises:
        PluginError: the name is unknown, or its plug-in cannot be loaded.
        LayoutError: a mistake in the layout text; the position counts from the start of ``spec``.
        ConfigurationError: the interpreter needs a layout, or takes none.
    """
    lenient = check_flag(lenient, "lenient")
    if spec is None:
        name, layout = "raw", None
    elif isinstance(spec, str):
        name, layout = _split_text(spec, lenient=lenient)
    elif isinstance(spec, Layout):
        name = "record"
        layout = Layout(spec.text, lenient=True) if lenient and not spec.lenient else spec
    elif describes_layout(spec):
        return _ClassInterpreter(spec, lenient=lenient)
    else:
        return _make_interpreter(
            getattr(spec, "__name__", None) or excerpt(spec), spec, None, lenient=lenient
        )
    return _make_interpreter(name, INTERPRETERS.load(name), layout, lenient=lenient)


def _split_text(spec: str, *, lenient: bool) -> tuple[str, Layout | None]:
    """Return the interpreter's name and the layout of a text."""
    head, colon, tail = spec.partition(":")
    name = head.strip()
    if not colon and "(" not in spec:
        return name, None
    if colon and name in INTERPRETERS and not _is_type(tail):
        return name, Layout(spec, lenient=lenient, start=len(head) + 1)
    _check_name(spec, name, tail)
    return "record", Layout(spec, lenient=lenient)


MISSPELLED_SCORE = 0.8
"""Score of a group's name above which it counts as the misspelled name of an interpreter."""

_FIRST_WORD = re.compile(r"\s*([^\W\d]\w*)\s*(:?)")


def _is_type(tail: str) -> bool:
    """Return True if ``tail`` begins with a field's type, as in ``table: int32``."""
    word = _FIRST_WORD.match(tail)
    return word is not None and word[1] in TYPES and not word[2]


def _check_name(spec: str, name: str, tail: str) -> None:
    """Raise PluginError if a layout text begins with a misspelled name of an interpreter."""
    word = _FIRST_WORD.match(tail)
    another_colon = word is not None and word[2] and word[1] not in TYPES
    if re.fullmatch(r"[\w.-]+", name) and (another_colon or not name.isidentifier()):
        _raise_unknown_name(spec, name)
    # "localization: (...)*" is a valid layout text with a named group, but surely a mistake
    if tail.lstrip().startswith("(") and name != "records":
        known = [info.name for info in INTERPRETERS.available()]
        suggestion = closest(name, known, least=MISSPELLED_SCORE)
        if suggestion:
            raise PluginError(
                f"interpreter {excerpt(name)} is unknown, did you mean {suggestion!r}? "
                f"known are {', '.join(known)} (if it is a group's name in a layout, pass "
                f"Layout({excerpt(spec)}))",
                name=name,
            )


def _raise_unknown_name(spec: str, name: str) -> NoReturn:
    """Raise PluginError: ``spec`` neither names an interpreter nor is a layout text."""
    layout_text_error = ""
    try:
        Layout(spec)
    except LayoutError as exc:
        layout_text_error = f"; nor is it a layout text: {exc}"
    known = [info.name for info in INTERPRETERS.available()]
    raise PluginError(
        f"interpreter {excerpt(name)} is unknown; known are {', '.join(known)}"
        f"{did_you_mean(name, known)}{layout_text_error}",
        name=name,
    )


def _make_interpreter(
    name: str, loaded: object, layout: Layout | None, *, lenient: bool
) -> Interpreter:
    if isinstance(loaded, Interpreter):
        if layout is not None:
            raise ConfigurationError(f"interpreter {name}: expected no layout, got '{layout}'")
        return loaded
    if isinstance(loaded, type) and issubclass(loaded, Interpreter):
        if layout is None and lenient and loaded.default_layout is not None:
            layout = Layout(loaded.default_layout, lenient=True)
        try:
            return loaded(layout)
        except SmartCamError:
            raise
        except (Exception, SystemExit) as exc:
            raise PluginError(f"interpreter {name}: cannot be made: {exc!r}", name=name) from exc
    if not isinstance(loaded, type) and callable(loaded):
        return _FunctionInterpreter(loaded, layout)
    raise PluginError(
        f"interpreter {name}: expected a function of a Reader, a subclass of Interpreter, "
        "or a dataclass, model or NamedTuple whose fields are annotated with their layout, "
        f"got {excerpt(loaded)}",
        name=name,
    )
