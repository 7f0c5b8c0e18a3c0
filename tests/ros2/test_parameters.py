"""Parameters of a node: declarations, values, and sets that fail."""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Any

import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError, RosError, RosMessageError, SmartCamError
from smartcam.ros2 import Node, RosTypes
from smartcam.ros2._node.parameter_values import decode_value, encode_value, typed_value
from tests.ros2.inside import RosParameters

PATIENCE = 10.0
INT64 = (1 << 63) - 1


@pytest.fixture
def parameters() -> RosParameters:
    return RosParameters(Node("cam3", namespace="line1"), served=False, timeout=PATIENCE)


class Device:
    """A device whose hooks set values; it refuses bad ones, and takes its time."""

    def __init__(self) -> None:
        self.said: list[Any] = []
        self.bad: set[Any] = set()
        self.slow: dict[Any, float] = {}

    def hook(self, name: str) -> Any:
        async def on_set(value: Any) -> None:
            self.said.append((name, value))
            await asyncio.sleep(self.slow.get(value, 0.0))
            if value in self.bad:
                raise SmartCamError(f"{name} is not to be {value}")

        return on_set


# ------------------------------------------------------------------ values


@pytest.mark.parametrize(
    ("value", "kind", "kept"),
    [
        (True, "bool", True),
        (-3, "integer", -3),
        (INT64, "integer", INT64),
        (-INT64 - 1, "integer", -INT64 - 1),
        (2.5, "double", 2.5),
        (math.inf, "double", math.inf),
        ("größer", "string", "größer"),
        ("", "string", ""),
        (b"\x00\xff", "byte_array", b"\x00\xff"),
        (b"", "byte_array", b""),
        ([True, False], "bool_array", (True, False)),
        ([1, -INT64], "integer_array", (1, -INT64)),
        ([0.5, -1.0], "double_array", (0.5, -1.0)),
        (["a", ""], "string_array", ("a", "")),
        (np.float64(2.5), "double", 2.5),
        (np.uint8(7), "integer", 7),
        (np.arange(3), "integer_array", (0, 1, 2)),
    ],
)
def test_a_value_has_a_type_and_goes_through_a_message(value: Any, kind: str, kept: Any) -> None:
    made = typed_value("it", value)
    assert (made.type, made.value) == (kind, kept)
    assert type(made.value) is type(kept)
    message = RosTypes().message("rcl_interfaces/msg/ParameterValue")
    assert decode_value(message.decode(message.encode(encode_value(made)))) == made


@pytest.mark.parametrize(
    ("value", "why"),
    [
        (None, "NoneType"),
        (INT64 + 1, "64 bits"),
        ([1, 1 << 70], "64 bits"),
        ([], "without elements"),
        ([1, 2.0], "float, int"),
        ([[1]], "list"),
        ([b"a"], "bytes"),
        ({"a": 1}, "dict"),
        ("a\0b", "NUL"),
        (["a", "\0"], "NUL"),
        ("\udc80", "surrogates"),
        (1j, "complex"),
    ],
)
def test_what_is_no_value(parameters: RosParameters, value: Any, why: str) -> None:
    with pytest.raises(ConfigurationError, match=f"it.*{why}"):
        parameters.declare("it", value)
    assert "it" not in parameters.names()


def test_a_message_with_an_unknown_type_is_refused() -> None:
    message = RosTypes().message("rcl_interfaces/msg/ParameterValue")
    with pytest.raises(RosMessageError, match="parameter type 10: expected 0 to 9"):
        decode_value(message.new(type=10))
    assert decode_value(message.new()).value is None


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"name": ""}, "name"),
        ({"name": "x" * 257}, "name"),
        ({"name": "a\nb"}, "name"),
        ({"name": "use_sim_time"}, "exists already"),
        ({"type": "int"}, "did you mean 'integer'"),
        ({"type": "double"}, "expected double, got integer 5"),
        ({"minimum": 6}, "out of its range"),
        ({"minimum": 3, "maximum": 2}, "nothing is in"),
        ({"minimum": 0.5}, "whole"),
        ({"minimum": True}, "whole"),
        ({"step": 1}, "a minimum"),
        ({"minimum": 0, "step": 0}, "above 0"),
        ({"minimum": 0, "step": 2}, "steps of 2"),
        ({"value": "a", "minimum": 0}, "string has no range"),
        ({"value": [1], "maximum": 3}, "integer_array has no range"),
        ({"value": 1.0, "minimum": math.nan}, "nothing is in"),
        ({"value": math.nan, "minimum": 0}, "out of its range"),
        ({"value": "x" * 65_537}, "length 65537"),
    ],
)
def test_what_cannot_be_declared(parameters: RosParameters, more: Any, why: str) -> None:
    before = parameters.names()
    with pytest.raises(ConfigurationError, match=why):
        parameters.declare(**{"name": "it", "value": 5, **more})
    assert parameters.names() == before


def test_there_is_an_end_to_what_can_be_declared(parameters: RosParameters) -> None:
    for number in range(1023):
        parameters.declare(f"p{number}", number)
    with pytest.raises(ConfigurationError, match="at most 1024"):
        parameters.declare("more", 1)


@pytest.mark.parametrize(
    ("first", "bounds", "fit", "misfit"),
    [
        (0, {"minimum": -2, "maximum": 2}, [-2, 2], [-3, 3, INT64]),
        (0, {"maximum": 2}, [-INT64 - 1], [3]),
        # the last value fits, whatever the step: so it is in ROS
        (0, {"minimum": 0, "maximum": 10, "step": 4}, [0, 4, 8, 10], [2, 9, -4, 12]),
        (
            0.0,
            {"minimum": 0, "maximum": 1, "step": 0.1},
            [0.1, 0.3, 0.1 + 0.2, 0.7, 1.0, 0.1 * 3],
            [0.15, 1.1, -0.1, math.nan, math.inf, -math.inf],
        ),
        (1.0, {"minimum": 0.5}, [0.5, 1e300, math.inf], [0.4, math.nan, -math.inf]),
        (1.0, {}, [math.nan, math.inf, -0.0], []),
    ],
)
async def test_ranges(
    parameters: RosParameters, first: Any, bounds: Any, fit: Any, misfit: Any
) -> None:
    parameters.declare("it", first, **bounds)
    for value in fit:
        await parameters.set("it", value)
        assert parameters.get("it") == pytest.approx(value, nan_ok=True, abs=0)
    for value in misfit:
        before = parameters.get("it")
        with pytest.raises(ConfigurationError, match=r"'it'.*out of its range"):
            await parameters.set("it", value)
        assert parameters.get("it") == before


# ------------------------------------------------------------------ to set


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("gain", 3, "'gain' is double, it cannot be set to integer 3"),
        ("gain", "3", "is double, it cannot be set to string '3'"),
        ("gain", None, "cannot be unset"),
        ("count", 3.0, "is integer, it cannot be set to double"),
        ("count", True, "is integer, it cannot be set to bool"),
        ("serial", "x", "read-only"),
        ("words", [1], "is string_array, it cannot be set to integer_array"),
        ("gian", 3.0, "of /line1/cam3 is not declared; did you mean 'gain'"),
    ],
)
async def test_a_type_is_fixed(parameters: RosParameters, name: str, value: Any, why: str) -> None:
    device = Device()
    parameters.declare("gain", 1.0, on_set=device.hook("gain"))
    parameters.declare("count", 1, on_set=device.hook("count"))
    parameters.declare("serial", "a", read_only=True, on_set=device.hook("serial"))
    parameters.declare("words", [], type="string_array", on_set=device.hook("words"))
    before = {one: parameters.get(one) for one in parameters.names()}
    with pytest.raises(ConfigurationError, match=why):
        await parameters.set(name, value)
    with pytest.raises(ConfigurationError, match=why):
        await parameters.set_all({"gain": 2.0, name: value})
    assert {one: parameters.get(one) for one in parameters.names()} == before
    assert device.said == []  # everything is looked at before anything is done
    await parameters.set("words", ["a"])
    await parameters.set("words", [])
    assert parameters.get("words") == ()


async def test_there_is_no_simulated_time(parameters: RosParameters) -> None:
    assert parameters.get("use_sim_time") is False
    await parameters.set("use_sim_time", False)
    with pytest.raises(ConfigurationError, match="the system's time only"):
        await parameters.set("use_sim_time", True)
    assert parameters.get("use_sim_time") is False


async def test_what_a_value_is_by_now(parameters: RosParameters) -> None:
    device = Device()
    parameters.declare("serial", "a", read_only=True, on_set=device.hook("serial"))
    parameters.update("serial", "b")
    assert parameters.get("serial") == "b"
    assert device.said == []
    with pytest.raises(ConfigurationError, match="is string"):
        parameters.update("serial", 3)
    parameters.undeclare("serial")
    for call in (parameters.get, parameters.describe, parameters.undeclare):
        with pytest.raises(ConfigurationError, match="not declared"):
            call("serial")
    parameters.declare("serial", 3)


async def test_a_plain_function_may_be_the_hook(parameters: RosParameters) -> None:
    said: list[Any] = []
    parameters.declare("gain", 1.0, on_set=said.append)
    await parameters.set("gain", 2.0)
    assert said == [2.0]


async def test_all_or_none(parameters: RosParameters) -> None:
    device = Device()
    for name in ("a", "b", "c", "d"):
        parameters.declare(name, 1, on_set=device.hook(name))
    device.bad = {5}
    with pytest.raises(SmartCamError, match="c is not to be 5"):
        await parameters.set_all({"a": 2, "b": 3, "c": 5, "d": 6})
    assert [parameters.get(name) for name in "abcd"] == [1, 1, 1, 1]
    assert device.said == [("a", 2), ("b", 3), ("c", 5), ("b", 1), ("a", 1)]
    await parameters.set_all({"a": 2, "b": 3})
    assert [parameters.get(name) for name in "abcd"] == [2, 3, 1, 1]


async def test_what_cannot_be_taken_back_counts_and_is_told(
    parameters: RosParameters, caplog: pytest.LogCaptureFixture
) -> None:
    device = Device()
    for name in ("a", "b", "c"):
        parameters.declare(name, 1 if name != "a" else 10, on_set=device.hook(name))
    device.bad = {10, 5}
    with pytest.raises(SmartCamError, match="c is not to be 5") as failed:
        await parameters.set_all({"a": 2, "b": 3, "c": 5})
    assert [parameters.get(name) for name in "abc"] == [2, 1, 1]
    (note,) = failed.value.__notes__
    assert "'a' stays integer 2" in note
    assert note in caplog.text


async def test_a_hook_that_fails(
    parameters: RosParameters, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(value: Any) -> None:
        raise ZeroDivisionError(value)

    parameters.declare("a", 1, on_set=fails)
    with pytest.raises(RosError, match="'a': ZeroDivisionError: 2"):
        await parameters.set("a", 2)
    assert parameters.get("a") == 1
    assert "Traceback" in caplog.text


async def test_a_hook_that_hangs(parameters: RosParameters) -> None:
    device = Device()
    parameters.declare("a", 1, on_set=device.hook("a"))
    parameters.declare("b", 1, on_set=device.hook("b"))
    device.slow = {3: math.inf}
    loop = asyncio.get_running_loop()
    begun = loop.time()
    with pytest.raises(RosError, match="no answer within 10 s; whether integer 3 took effect is"):
        await parameters.set_all({"a": 2, "b": 3})
    assert loop.time() - begun == pytest.approx(PATIENCE, abs=0.1)
    assert [parameters.get("a"), parameters.get("b")] == [1, 1]
    assert device.said == [("a", 2), ("b", 3), ("a", 1)]
    await parameters.set("b", 4)
    assert parameters.get("b") == 4


async def test_a_timeout_of_the_hooks_own_is_no_deadline(parameters: RosParameters) -> None:
    async def on_set(value: int) -> None:
        async with asyncio.timeout(0.5):
            await asyncio.sleep(value)

    parameters.declare("a", 1, on_set=on_set)
    with pytest.raises(RosError, match="TimeoutError"):
        await parameters.set("a", 2)


async def test_sets_are_one_after_the_other_with_an_end(parameters: RosParameters) -> None:
    device = Device()
    for name in ("a", "b"):
        parameters.declare(name, 1, on_set=device.hook(name))
    device.slow = {2: 7.0, 3: 7.0}
    first = asyncio.create_task(parameters.set_all({"a": 2, "b": 3}))
    await asyncio.sleep(1)
    with pytest.raises(RosError, match="a: earlier changes took more than 10 s"):
        await parameters.set("a", 4)
    await asyncio.sleep(1)
    await parameters.set("a", 5)  # waits for the first
    await first
    assert device.said == [("a", 2), ("b", 3), ("a", 5)]
    assert [parameters.get("a"), parameters.get("b")] == [5, 3]


async def test_a_hook_cannot_set(parameters: RosParameters) -> None:
    async def on_set(value: int) -> None:
        await parameters.set("b", value)

    parameters.declare("a", 1, on_set=on_set)
    parameters.declare("b", 1)
    begun = asyncio.get_running_loop().time()
    with pytest.raises(RosError, match="b: an on_set cannot set"):
        await parameters.set("a", 2)
    assert asyncio.get_running_loop().time() - begun < 1
    assert [parameters.get("a"), parameters.get("b")] == [1, 1]


async def test_a_set_that_is_cancelled(parameters: RosParameters) -> None:
    device = Device()
    for name in ("a", "b"):
        parameters.declare(name, 1, on_set=device.hook(name))
    device.slow = {3: 7.0}
    for when in (0.0, 1.0):  # while it waits for the other, and within its hook
        device.said.clear()
        other = asyncio.create_task(parameters.set("b", 3))
        await asyncio.sleep(1)
        task = asyncio.create_task(parameters.set_all({"a": 2, "b": 3}))
        await asyncio.sleep(when and 6.5 + when)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await other
        wanted = [("b", 3)] if not when else [("b", 3), ("a", 2), ("b", 3), ("a", 1)]
        assert device.said == wanted
        assert parameters.get("a") == 1
        await parameters.set("b", 1)


async def test_what_is_undeclared_while_it_is_set(parameters: RosParameters) -> None:
    device = Device()
    parameters.declare("a", 1, on_set=device.hook("a"))
    device.slow = {2: 1.0}
    task = asyncio.create_task(parameters.set("a", 2))
    await asyncio.sleep(0.5)
    parameters.undeclare("a")
    parameters.declare("a", "other")
    await task
    assert parameters.get("a") == "other"


async def test_sets_that_go_on_end_with_the_node(
    parameters: RosParameters, no_leaks: None, caplog: pytest.LogCaptureFixture
) -> None:
    device = Device()
    for name in ("a", "b"):
        parameters.declare(name, 1, on_set=device.hook(name))
    device.slow = {3: math.inf}
    caller = asyncio.create_task(parameters.set_shielded({"a": 2, "b": 3}))
    await asyncio.sleep(1)
    caller.cancel()  # who asked is gone: it goes on
    await asyncio.sleep(1)
    assert device.said == [("a", 2), ("b", 3)]
    await parameters.close()
    assert device.said == [("a", 2), ("b", 3), ("a", 1)]
    assert [parameters.get("a"), parameters.get("b")] == [1, 1]
    assert not [one for one in caplog.records if one.levelno >= logging.ERROR]
