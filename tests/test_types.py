"""Types that a user's program sees: mypy and pyright check this file, strictly, in CI."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, assert_type

import smartcam
from smartcam import Camera, Layout, Localization, Result
from smartcam.emulator import EmulatedCamera
from smartcam.interpreters import Interpreter, Reader

URL = "bvs://192.0.2.1"


@dataclass
class Measured:
    width: Annotated[float, "real32 mm"]


class Length(Interpreter):
    def interpret(self, reader: Reader) -> int:
        return len(reader)


def reading(reader: Reader) -> tuple[int, str]:
    return reader.get_int8(0), reader.get_string(1, 3)


def test_camera_knows_the_type_of_its_values() -> None:
    assert_type(smartcam.connect(URL), Camera[Any])  # a fleet's file may say how to read them
    assert_type(smartcam.connect("fleet://127.0.0.1/line1/cam3"), Camera[Any])
    assert_type(smartcam.connect(URL, interpret_as="raw"), Camera[bytes])
    assert_type(smartcam.connect(URL, interpret_as=None), Camera[Any])
    assert_type(
        smartcam.connect(URL, interpret_as="localizations", name="a"),
        Camera[list[Localization]],
    )
    assert_type(smartcam.connect(URL, interpret_as=reading), Camera[tuple[int, str]])
    assert_type(smartcam.connect(URL, interpret_as=Measured), Camera[Measured])
    assert_type(smartcam.connect(URL, interpret_as=list[Measured]), Camera[list[Measured]])
    assert_type(smartcam.connect(URL, interpret_as="x: int8"), Camera[Any])
    assert_type(smartcam.connect(URL, interpret_as=Layout("x: int8")), Camera[Any])
    assert_type(smartcam.connect(URL, interpret_as=Length), Camera[Any])
    assert_type(smartcam.connect(URL, interpret_as={7: Measured}), Camera[Any])


def given(interpreter: Interpreter) -> Camera:
    """A bare Camera stays what it always was."""
    camera = smartcam.connect(URL, interpret_as=interpreter)
    assert_type(camera, Camera[Any])
    return camera


def value_of(result: Result) -> Any:
    """And so does a bare Result."""
    return assert_type(result.value, Any)


async def test_values_have_their_types_wherever_they_come() -> None:
    async with (
        EmulatedCamera(active=7, running=True) as emulator,
        smartcam.connect(emulator.url, interpret_as="localizations") as camera,
    ):
        stream = camera.results()
        result = await camera.trigger()
        assert_type(result, Result[list[Localization]])
        assert assert_type(result.value[0].pose.position.x, float) > -1
        many = await camera.trigger(results_per_trigger=1)
        assert_type(many, list[Result[list[Localization]]])
        text = await camera.trigger(interpret_as=reading)
        assert_type(text.value, tuple[int, str])
        assert len(text.value) == 2
        streamed = await anext(stream)
        assert_type(streamed.value, list[Localization])
        assert streamed == result
        waiting = camera.next_result()
        await camera.trigger()
        assert_type((await waiting).value, list[Localization])
        assert value_of(result) == result.value
