"""The suite for authors of interpreters: subclass, give containers and values, inherit the tests.

::

    class TestWeights(InterpreterSuite):
        spec = weights
        name = "weights"
        samples = (
            ContainerSample(struct.pack("<10sf", b"bolt", 0.25), {"bolt": 0.25}),
            ContainerSample(b"", {}),
        )

An interpreter is called as the client calls it, except that the client turns any error of an
interpreter into an InterpretationError; here any other error is a mistake.
"""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import gc
import json
import math
import pickle
import re
import struct
import sys
from dataclasses import dataclass, fields, is_dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, ClassVar, cast

import pytest

from smartcam.exceptions import ConfigurationError, InterpretationError, PluginError
from smartcam.interpreters import Context, Interpreter, PlainInterpreter, Reader, resolve
from smartcam.layout import Layout
from smartcam.models import Pose, jsonable
from smartcam.registry import INTERPRETERS
from smartcam.testing._suites.in_words import ExplainedChecks

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hypothesis.strategies import DataObject

    from smartcam.interpreters._inside import Spec

MAX_ERROR_LENGTH = 500
"""Largest number of characters of an error's text. It may show 64 bytes of a container."""

MAX_OFFSETS = 256
"""Largest number of offsets in a container at which one variation is tried."""

TRAILING_BYTES = (b"\0", b"\xff", b"\0" * 3, b"A" * 4, b"\0" * 50, b"A" * 500)
"""Bytes that may follow a container."""

NON_FINITE_NUMBERS = tuple(
    struct.pack(order + code, number)
    for order in "<>"
    for code in "fd"
    for number in (math.nan, math.inf, -math.inf)
)
"""Bytes of numbers that are not valid, in each size and order."""

LAYOUTS = ("x: int8", "x: real32 mm, y: real32 mm, theta: real32 deg", "(name: string[3])*")
"""Layouts that a user may write after an interpreter's name."""

_RECEIVED_AT = datetime(2024, 2, 29, 23, 59, 30, tzinfo=UTC)
_ADDRESS = re.compile(r"<.* at 0x[0-9A-Fa-f]+>")


@dataclass(frozen=True)
class ContainerSample:
    """A container and its value.

    Attributes:
        data: bytes of the container after the application id, with little-endian numbers.
        value: value that the interpreter returns; for an array its ``tolist()`` suffices.
        layout: text that the user writes after the interpreter's name, None without one.
        big: bytes of the container with big-endian numbers, equal to ``data`` if it has no
            numbers. It may be left out if the interpreter has a layout, which says where the
            numbers are.
        sequence: sequence number of the container.
        name: name of the sample for people.
    """

    data: bytes
    value: object
    layout: str | None = None
    big: bytes | None = None
    sequence: int | None = None
    name: str = ""


class InterpreterSuite(ExplainedChecks):
    """The tests that every interpreter has to pass.

    Attributes:
        spec: the interpreter as a value of ``interpret_as``: a function, a class or a name.
        samples: containers and their values; at least one for each layout of interest.
        name: name of its entry point, "" without one.
    """

    spec: ClassVar[Spec]
    samples: ClassVar[Sequence[ContainerSample]] = ()
    name: ClassVar[str] = ""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Run a check with each sample; pytest calls it.

        Raises:
            pytest.UsageError: ``spec`` or ``samples`` is missing.
        """
        if "sample" not in metafunc.fixturenames:
            return
        suite = type(self)
        for name in ("spec", "samples"):
            if not getattr(suite, name, None):
                raise pytest.UsageError(f"{suite.__name__}.{name}: expected one, got none")
        labels = [each.name or each.layout or f"sample {i}" for i, each in enumerate(self.samples)]
        metafunc.parametrize("sample", self.samples, ids=labels)

    def make(self, layout: str | None = None) -> Interpreter:
        """Return a new interpreter, with the text that a user would write after its name.

        Raises:
            ConfigurationError: the interpreter takes no layout, needs one, or not this one.
        """
        spec = type(self).spec  # read from the object, a function would become a method
        if layout is None:
            return resolve(spec)
        if isinstance(spec, str):
            return resolve(f"{spec}: {layout}")
        if isinstance(spec, type) and issubclass(spec, Interpreter):
            return spec(Layout(layout))
        interpreter = resolve(spec)
        if interpreter is spec:
            raise ConfigurationError("an interpreter that is made already takes no layout")
        interpreter.layout = Layout(layout)
        return interpreter

    # ------------------------------------------------------------------ values

    def test_value_is_as_expected(self, sample: ContainerSample) -> None:
        """Check the value, and that the same bytes give it a second time."""
        interpreter = self.make(sample.layout)
        for _ in range(2):
            value = interpret(interpreter, sample.data)
            assert _equals_expected(value, sample.value), (
                f"expected {sample.value!r}, got {value!r}"
            )

    def test_sequence_number_is_as_expected(self, sample: ContainerSample) -> None:
        """Check that the number is the value of the layout's field, or None, or an error."""
        interpreter = self.make(sample.layout)
        reader = _reader(interpreter, sample.data)
        sequence = interpreter.sequence(reader)
        assert sequence == sample.sequence, f"expected number {sample.sequence}, got {sequence}"
        for data in (*_prefixes(sample.data), *(sample.data + more for more in TRAILING_BYTES)):
            try:
                number = interpreter.sequence(_reader(interpreter, data))
            except InterpretationError as error:
                check_error(error, data)
            else:
                assert number is None or isinstance(number, int), f"{data!r}: number {number!r}"

    def test_value_is_the_same_each_time(self, sample: ContainerSample) -> None:
        """Check this after other containers, and with a new interpreter; values share nothing."""
        interpreter = self.make(sample.layout)
        first = interpret(interpreter, sample.data)
        between = [each.data for each in self.samples if each.layout == sample.layout]
        for data in (*between, sample.data[:-1], sample.data + b"\0", b""):
            interpret_or_none(interpreter, data)
            again = interpret(interpreter, sample.data)
            assert _is_identical(again, first), f"first {first!r}, after {data!r} {again!r}"
            shared = [
                part
                for part in _mutable_parts(first)
                if id(part) in set(map(id, _mutable_parts(again)))
            ]
            assert not shared, f"two values share {shared[0]!r}"
        other = interpret(self.make(sample.layout), sample.data)
        assert _is_identical(other, first), f"first {first!r}, of another interpreter {other!r}"

    def test_nothing_is_kept(self, sample: ContainerSample) -> None:
        """Check that the interpreter keeps neither bytes nor other state, nor changes the bytes."""
        interpreter = self.make(sample.layout)
        interpret_or_none(interpreter, sample.data)  # facts learned at the first call may be kept
        data = bytes(bytearray(sample.data))
        state, before = repr(vars(interpreter)), sys.getrefcount(data)
        for _ in range(3):
            interpret_or_none(interpreter, data)
        assert data == sample.data, f"the container was changed to {data!r}"
        now = repr(vars(interpreter))
        assert now == state, f"the interpreter was changed from {state} to {now}"
        if sys.getrefcount(data) != before:
            gc.collect()
        assert sys.getrefcount(data) <= before or len(data) < 2, "the container's bytes are kept"

    def test_value_can_be_written_as_json(self, sample: ContainerSample) -> None:
        """Check the value's JSON, which ``--json`` and monitoring tools write."""
        value = interpret(self.make(sample.layout), sample.data)
        text = json.dumps(jsonable(value), allow_nan=False)
        address = _ADDRESS.search(text)
        assert address is None, f"{value!r} has no JSON: it contains {address and address[0]!r}"

    def test_big_endian_gives_the_same_value(self, sample: ContainerSample) -> None:
        """Check both byte orders; the camera's status tells the order, in ``reader.context``."""
        interpreter = self.make(sample.layout)
        big = sample.big
        if big is None:
            if interpreter.layout is None:
                pytest.skip(
                    "ContainerSample(big=...) is missing: the container with big-endian numbers"
                )
            big = _swap_byte_order(interpreter.layout, sample.data)
        value = interpret(interpreter, big, byte_order="big")
        assert _equals_expected(value, sample.value), (
            f"{big!r}: expected {sample.value!r}, got {value!r}"
        )

    # ------------------------------------------------------------------ bytes that do not fit

    def test_cut_container_gives_value_or_error(self, sample: ContainerSample) -> None:
        """Check each length: it gives a value, or an InterpretationError with the expectation."""
        interpreter = self.make(sample.layout)
        for data in (b"", *_prefixes(sample.data)):
            check_outcome(interpreter, data)

    def test_longer_container_gives_value_or_error(self, sample: ContainerSample) -> None:
        """Check that bytes after a container cause no other kind of error either."""
        interpreter = self.make(sample.layout)
        for more in TRAILING_BYTES:
            check_outcome(interpreter, sample.data + more)
            check_outcome(interpreter, sample.data + sample.data + more)

    def test_any_bytes_give_value_or_error(self, sample: ContainerSample) -> None:
        """Check any bytes, since the user may have named the wrong interpreter."""
        from smartcam.testing._suites import strategies

        interpreter = self.make(sample.layout)
        contents = strategies.noise([sample.data for sample in self.samples])
        orders = strategies.st.sampled_from(["little", "big"])

        def check(data: DataObject) -> None:
            check_outcome(interpreter, data.draw(contents), byte_order=data.draw(orders))

        strategies.run_with_examples(check)

    def test_poses_are_of_finite_numbers(self, sample: ContainerSample) -> None:
        """Check NaN and infinity at any offset: a pose with such numbers must be an error."""
        interpreter = self.make(sample.layout)
        size = len(sample.data)
        for number in NON_FINITE_NUMBERS:
            last = size - len(number)
            for offset in range(0, last + 1, 1 + size // MAX_OFFSETS):
                data = sample.data[:offset] + number + sample.data[offset + len(number) :]
                for order in ("little", "big"):
                    check_outcome(interpreter, data, byte_order=order)

    def test_any_context_is_accepted(self, sample: ContainerSample) -> None:
        """Check unusual names, numbers and options of the client."""
        interpreter = self.make(sample.layout)
        for options in (
            {
                "camera": "é " * 100,
                "application": -1,
                "number": 1 << 40,
                "received_at": _RECEIVED_AT,
            },
            {"application": (1 << 32) - 1, "y_down": True},
            {"lenient": True},
        ):
            for data in (sample.data, sample.data[:-1], b"\x01" * len(sample.data)):
                check_outcome(interpreter, data, **options)

    # ------------------------------------------------------------------ bursts, layouts, plug-ins

    def test_containers_of_a_burst_are_read_as_one_by_one(self, sample: ContainerSample) -> None:
        """Check that a PlainInterpreter's ``read_all`` and ``interpret`` do what ``read`` does."""
        interpreter = self.make(sample.layout)
        if not isinstance(interpreter, PlainInterpreter):
            return  # the client reads them one by one
        burst = [each.data for each in self.samples if each.layout == sample.layout] * 2
        context = Context(camera="burst", number=5, received_at=_RECEIVED_AT)
        values = interpreter.read_all(burst, context)
        assert len(values) == len(burst), f"{len(burst)} containers gave {len(values)} values"
        empty = 0
        for number, (data, value) in enumerate(zip(burst, values, strict=True), 5):
            single = Context(camera="burst", number=number, received_at=_RECEIVED_AT)
            read = interpreter.read(data, single)
            assert _is_identical(value, read), f"read() gives {read!r}, read_all() {value!r}"
            by_reader = interpreter.interpret(
                Reader(data, Context("burst", 0, number, _RECEIVED_AT))
            )
            assert _is_identical(by_reader, read), (
                f"read() gives {read!r}, interpret() {by_reader!r}"
            )
            empty += single.empty_slots
        assert context.empty_slots == empty, f"empty_slots: {context.empty_slots}, not {empty}"

    def test_layout_is_taken_or_refused(self, sample: ContainerSample) -> None:
        """Check that any layout, or none, gives an interpreter or a ConfigurationError."""
        for layout in (None, *LAYOUTS):
            try:
                interpreter = self.make(layout)
            except ConfigurationError:
                continue
            assert isinstance(interpreter, Interpreter), f"{layout}: {interpreter!r}"
            check_outcome(interpreter, sample.data)

    def test_entry_point_gives_the_interpreter(self, sample: ContainerSample) -> None:
        """Check that ``interpret_as="name"`` finds the interpreter: its package is installed."""
        if not self.name:
            pytest.skip(f"{type(self).__name__}.name is empty: it has no entry point")
        try:
            loaded = INTERPRETERS.load(self.name)
        except PluginError as error:
            message = f"{error}. Is the package installed (pip install -e .), and is {self.name!r}"
            raise AssertionError(f"{message} the name under smartcam.interpreters?") from error
        spec = type(self).spec
        assert isinstance(spec, str) or loaded is spec, f"{self.name!r} gives {loaded!r:.200}"
        text = self.name if sample.layout is None else f"{self.name}: {sample.layout}"
        value = interpret(resolve(text), sample.data)
        assert _equals_expected(value, sample.value), (
            f"{text!r}: expected {sample.value!r}, got {value!r}"
        )


def _reader(interpreter: Interpreter, data: bytes, **context: Any) -> Reader:
    return Reader(data, Context(**context), interpreter.layout)


def interpret(interpreter: Interpreter, data: bytes, **context: Any) -> object:
    """Return an interpreter's value; errors are not changed."""
    return interpreter.interpret(_reader(interpreter, data, **context))


def interpret_or_none(interpreter: Interpreter, data: bytes) -> object:
    """Return an interpreter's value, None if it raises an InterpretationError."""
    try:
        return interpret(interpreter, data)
    except InterpretationError:
        return None


def check_outcome(interpreter: Interpreter, data: bytes, **context: Any) -> None:
    """Check that bytes give a sensible value, or the right kind of error.

    Raises:
        AssertionError: the bytes give neither.
    """
    where = f"{len(data)} bytes {data[:64]!r}, {context}"
    try:
        value = interpret(interpreter, data, **context)
    except InterpretationError as error:
        check_error(error, data)
        return
    except Exception as error:
        message = f"{where}: expected a value or an InterpretationError, got {error!r}"
        raise AssertionError(message) from error
    for pose in _poses(value):
        numbers = (*pose.position, *pose.orientation)
        assert all(map(math.isfinite, numbers)), f"{where}: a pose that is not finite: {pose}"


def check_error(error: InterpretationError, data: bytes) -> None:
    """Check that an error is short, says what was expected at which offset, and can be pickled.

    Raises:
        AssertionError: the error fails.
    """
    where = f"{len(data)} bytes {data[:64]!r}: {error!r:.300}"
    assert str(error), f"{where}: it says nothing"
    assert len(str(error)) <= MAX_ERROR_LENGTH, f"{where}: a text of {len(str(error))} characters"
    assert error.field or error.expected is not None, f"{where}: neither field nor expected"
    assert error.offset >= 0, f"{where}: offset {error.offset}"
    try:
        copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
    except Exception as exc:
        raise AssertionError(f"{where}: it does not survive pickle: {exc!r}") from exc
    same = (type(error), str(error), error.field, error.offset)
    assert (type(copy), str(copy), copy.field, copy.offset) == same, f"{where}: a copy is {copy!r}"


def _prefixes(data: bytes) -> Iterator[bytes]:
    for end in range(0, len(data), 1 + len(data) // MAX_OFFSETS):
        yield data[:end]
    yield data[:-1]


def _swap_byte_order(layout: Layout, data: bytes) -> bytes:
    """Return a container with its numbers in the other byte order."""
    swapped, offset = bytearray(), 0
    fields_left = [*layout.head, *layout.fields]
    while offset < len(data) and fields_left:
        for field in fields_left:
            piece = data[offset : offset + field.size]
            swapped += piece[::-1] if field.wire.is_number else piece
            offset += field.size
        fields_left = list(layout.fields)
    return bytes(swapped)


def _nested_values(value: object) -> Iterator[object]:
    """Yield a value and everything in it."""
    yield value
    inside: Sequence[object] = ()
    if isinstance(value, dict):
        pairs = cast("dict[object, object]", value)
        inside = [*pairs.keys(), *pairs.values()]
    elif isinstance(value, (list, tuple, set, frozenset)):
        inside = [*cast("Sequence[object]", value)]
    elif is_dataclass(value) and not isinstance(value, type):
        inside = [getattr(value, field.name) for field in fields(value)]
    for item in inside:
        yield from _nested_values(item)


def _poses(value: object) -> Iterator[Pose]:
    return (part for part in _nested_values(value) if isinstance(part, Pose))


def _mutable_parts(value: object) -> list[object]:
    """Return the mutable objects in a value."""
    kinds = (list, dict, set, bytearray)
    return [
        part
        for part in _nested_values(value)
        if isinstance(part, kinds)
        or bool(getattr(getattr(part, "flags", None), "writeable", False))
        or _is_mutable_dataclass(part)
    ]


def _is_mutable_dataclass(value: object) -> bool:
    """Return True if a value is an object of a dataclass that is not frozen."""
    if not is_dataclass(value) or isinstance(value, type):
        return False
    return not cast("Any", value).__dataclass_params__.frozen


def _is_array(value: object) -> bool:
    numpy = sys.modules.get("numpy")  # without numpy imported there are no arrays
    return numpy is not None and isinstance(value, numpy.ndarray)


def _equals_expected(value: Any, expected: Any) -> bool:
    """Return True if a value equals the author's value."""
    if _is_array(value):
        return _is_identical(value, expected) if _is_array(expected) else value.tolist() == expected
    if isinstance(value, float) and isinstance(expected, float):
        return value == expected or (math.isnan(value) and math.isnan(expected))
    return bool(value == expected)


def _is_identical(one: Any, other: Any) -> bool:
    """Return True if two values are equal, including types and NaN."""
    if type(one) is not type(other):
        return False
    if _is_array(one):
        fits = one.dtype == other.dtype and one.shape == other.shape
        return bool(fits) and one.tobytes() == other.tobytes()
    if isinstance(one, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if isinstance(one, dict):
        return [*one] == [*other] and all(_is_identical(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_is_identical, one, other))
    if is_dataclass(one):
        return all(_is_identical(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    return bool(one == other) or repr(one) == repr(other)
