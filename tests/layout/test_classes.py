"""Classes that are layouts."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field
from enum import IntEnum
from typing import Annotated, Any, NamedTuple

import pytest
from pydantic import BaseModel, Field

import smartcam
from smartcam import ConfigurationError, InterpretationError, Layout, LayoutError
from smartcam.emulator import Application, EmulatedCamera
from smartcam.interpreters import Context, Reader, resolve, run
from smartcam.interpreters._inside import run_plain


@dataclass
class Part:
    x: Annotated[float, "real32 mm"]
    theta: Annotated[float, "real32 deg"]


@dataclass
class Measured:
    passed: bool
    count: Annotated[int, "uint16"]
    code: Annotated[str, "string[4]"]
    parts: Annotated[list[Part], "[count]"]


@dataclass(kw_only=True)
class Named:
    number: Annotated[int, "uint32 @sequence"]
    seen: int = field(init=False, default=7)  # none of the container's


class Pair(NamedTuple):
    left: Annotated[float, "real64"]
    right: Annotated[float, "int8"]


class Grade(IntEnum):
    A = 1
    B = 2


class Model(BaseModel):
    grade: Annotated[Grade, "uint8"]
    width: Annotated[float, "int32 um", Field(gt=0)]
    parts: Annotated[list[Part], "*"]


class Nested(BaseModel):
    grade: Annotated[Grade, "uint8"]


@dataclass
class Outer:
    grades: Annotated[list[Nested], "[2]"]


MEASURED = Measured(True, 2, "ab", [Part(0.5, 0.0), Part(0.25, 0.0)])
MODEL = Model(grade=Grade.B, width=0.5, parts=[Part(0.5, 0.0)])
OBJECTS: list[tuple[Any, str, Any]] = [
    (
        Measured,
        "passed: bool, count: uint16, code: string[4], parts: (x: real32 mm, theta: real32 deg)"
        "[count]",
        MEASURED,
    ),
    (Named, "number: uint32 @sequence", Named(number=3)),
    (Pair, "left: real64, right: int8", Pair(0.5, 3)),
    (Model, "grade: uint8, width: int32 um, parts: (x: real32 mm, theta: real32 deg)*", MODEL),
    (Outer, "grades: (grade: uint8)[2]", Outer([Nested(grade=Grade.A), Nested(grade=Grade.B)])),
    (list[Pair], "(left: real64, right: int8)*", [Pair(1, 2), Pair(3, 4)]),
    (Annotated[list[Pair], "[1]"], "(left: real64, right: int8)[1]", [Pair(1, 2)]),
]


@pytest.mark.parametrize(("kind", "text", "value"), OBJECTS, ids=lambda one: repr(one)[:30])
def test_class_says_a_layout_in_both_directions(kind: Any, text: str, value: Any) -> None:
    layout = Layout.of(kind)
    assert layout.text == text
    interpreter = resolve(kind)
    assert interpreter.layout == layout
    for order in ("little", "big"):
        data = layout.build(value, order)
        read = run(interpreter, Reader(data, Context(byte_order=order)))
        assert read == value
        assert type(read) is type(value)


def test_sequence_number_of_a_class_is_one() -> None:
    assert resolve(Named).sequence(Reader(b"\x05\0\0\0")) == 5


def test_lenient_class_takes_any_byte_for_a_bool() -> None:
    data = Layout.of(Measured).build(MEASURED)
    odd = b"\x01" + data[1:]
    assert run(resolve(Measured, lenient=True), Reader(odd)) == MEASURED
    with pytest.raises(InterpretationError, match="passed"):
        run(resolve(Measured), Reader(odd))


@dataclass
class Bare:
    x: float


@dataclass
class Misspelt:
    x: Annotated[float, "reel32 mm"]


@dataclass
class WrongType:
    x: Annotated[int, "real32 mm"]


@dataclass
class TwoInOne:
    x: Annotated[int, "int8, y: int8"]


@dataclass
class ListFirst:
    parts: Annotated[list[Part], "*"]
    x: Annotated[int, "int8"]


@dataclass
class NoSuchCount:
    parts: Annotated[list[Part], "[n]"]


@dataclass
class ListInAList:
    outer: Annotated[list[ListFirst], "*"]


@dataclass
class Empty:
    pass


MISTAKES = {
    Bare: "class Bare, field 'x': expected a layout text",
    Misspelt: "did you mean 'real32'? at character 3\n  x: reel32 mm\n     ^",
    WrongType: "class WrongType, field 'x': expected the type float for 'real32 mm', got int",
    TwoInOne: "expected the layout text of one field, got 'int8, y: int8'",
    ListFirst: "class ListFirst, field 'parts': expected no list here: a list comes last",
    NoSuchCount: "expected the name of a field before the group (there: none), got 'n'",
    ListInAList: "class ListFirst, field 'parts': expected no list here: groups do not nest",
    Empty: "class Empty: expected a field with a layout text, got none",
    int: "expected a dataclass, a pydantic model or a NamedTuple, or a list of one, got <class",
}


@pytest.mark.parametrize("kind", MISTAKES, ids=lambda kind: kind.__name__)
def test_mistake_in_a_class_says_where_and_what_was_expected(kind: type) -> None:
    with pytest.raises(LayoutError, match=re.escape(MISTAKES[kind])):
        Layout.of(kind)


def test_class_that_is_not_at_the_top_of_its_module_reports_it() -> None:
    class Hidden(NamedTuple):
        x: Annotated[int, "int8"]

    @dataclass
    class Local:
        parts: Annotated[list[Hidden], "*"]

    with pytest.raises(LayoutError, match=r"class Local: .*'Hidden'.*top of the module"):
        Layout.of(Local)


def test_model_that_refuses_a_value_is_an_interpretation_error_with_its_field() -> None:
    data = Layout.of(Nested).build({"grade": 9})
    with pytest.raises(InterpretationError, match=r"Nested\.grade: .*got 9") as caught:
        run_plain(resolve(Nested), data, Context())  # type: ignore[arg-type]
    assert (caught.value.field, caught.value.got) == ("grade", 9)


def test_object_that_does_not_fit_its_field_cannot_be_built() -> None:
    with pytest.raises(ConfigurationError, match="'count'"):
        Layout.of(Measured).build(Measured(True, 1, "ab", []))
    with pytest.raises(ConfigurationError, match="'right'"):
        Layout.of(Pair).build(Pair(1, 1000))


async def test_camera_gives_objects_of_the_class_that_it_was_given() -> None:
    says = asdict(MEASURED)
    application = Application(id=7, layout=Layout.of(Measured).text, constant=says)
    async with (
        EmulatedCamera([application], running=True) as emulator,
        smartcam.connect(emulator.url, interpret_as=Measured) as camera,
    ):
        assert (await camera.trigger()).value == MEASURED
        assert (await camera.trigger(interpret_as=Measured)).value.parts == MEASURED.parts
