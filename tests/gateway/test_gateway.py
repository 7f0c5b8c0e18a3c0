"""The rules of a gateway: one answer to each request, in time, never a stale part; the counts."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError
from smartcam.gateway import Gateway, GatewaySettings
from smartcam.gateway._inside import GatewayFile

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PARTS = "(x: real32 mm, y: real32 mm, theta: real32 deg)*"
TWO = [{"x": 0.1, "y": 0.2, "theta": 0.5}, {"x": 0.3, "y": -0.05, "theta": 0.0}]
APPLICATIONS: list[Any] = [
    {"id": 7, "layout": PARTS, "constant": TWO, "processing_time": 0.1, "load_time": 0},
    {"id": 8, "layout": PARTS, "constant": [], "processing_time": 0.1, "load_time": 0},
    {"id": 9, "layout": PARTS, "constant": TWO, "processing_time": 30.0, "load_time": 0},
    {"id": 10, "layout": "n: int32", "constant": {"n": 5}, "processing_time": 0, "load_time": 0},
]
FIRST = b"0,1,100.000,200.000,0.000,28.648,0.000,0.000\r\n"
SECOND = b"0,0,300.000,-50.000,0.000,0.000,0.000,0.000\r\n"


class Robot:
    """A connection to a gateway, byte by byte."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def ask(self, request: bytes, end: bytes = b"\n") -> bytes:
        self.writer.write(request)
        return await self.reader.readuntil(end)

    def reset(self) -> None:
        self.writer.transport.abort()


class Cell:
    """A gateway, its camera, and robots."""

    def __init__(self, gateway: Gateway, emulator: EmulatedCamera) -> None:
        self.gateway, self.emulator = gateway, emulator
        self._robots: list[Robot] = []

    async def robot(self) -> Robot:
        port = int(self.gateway.address.rpartition(":")[2])
        robot = Robot(*await asyncio.open_connection("127.0.0.1", port))
        self._robots.append(robot)
        return robot

    async def counts(self) -> Any:
        """Return the counts once nothing is under way; it balances."""
        for _ in range(100):
            await asyncio.sleep(0.001)
        found = self.gateway.counts
        assert found.requests == found.answered + found.errors + found.abandoned + found.open
        assert found.parts == found.delivered + found.forgotten + found.waiting
        return found

    def close(self) -> None:
        for robot in self._robots:
            robot.writer.close()


@contextlib.asynccontextmanager
async def cell(
    interpret_as: Any = "localizations: " + PARTS, **settings: Any
) -> AsyncIterator[Cell]:
    said = GatewaySettings(listen="tcp/127.0.0.1:0", **settings)
    async with (
        EmulatedCamera(applications=APPLICATIONS) as emulator,
        smartcam.connect(emulator.url, application=7, interpret_as=interpret_as) as camera,
        Gateway(camera, said) as gateway,
    ):
        found = Cell(gateway, emulator)
        try:
            yield found
        finally:
            found.close()


async def test_parts_come_one_by_one_and_then_none() -> None:
    async with cell() as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER\r\n") == FIRST
        assert await robot.ask(b"next\r") == SECOND
        assert await robot.ask(b" NEXT \n") == b"1,0\r\n"
        counts = await it.counts()
    assert (counts.requests, counts.answered, counts.errors) == (3, 3, 0)
    assert (counts.parts, counts.delivered) == (2, 2)


async def test_without_a_result_there_is_no_next_part() -> None:
    async with cell() as it:
        robot = await it.robot()
        assert (await robot.ask(b"NEXT\n")).startswith(b"26,0,NO_RESULT there is no result")
        assert await robot.ask(b"TRIGGER\n") == FIRST
        other = await it.robot()
        assert (await other.ask(b"NEXT\n")).startswith(b"26,0,NO_RESULT")


async def test_a_part_that_is_too_old_is_not_given() -> None:
    async with cell(max_age=10) as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER\n") == FIRST
        await asyncio.sleep(11)
        assert await robot.ask(b"NEXT\n") == b"26,0,NO_RESULT the result is older than 10 s\r\n"
        assert (await it.counts()).forgotten == 1


async def test_a_failed_trigger_leaves_no_part_of_the_result_before() -> None:
    async with cell(timeout=1) as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER\n") == FIRST
        begun = asyncio.get_running_loop().time()
        assert (await robot.ask(b"TRIGGER 9\n")).startswith(b"21,0,TIMEOUT ")
        assert asyncio.get_running_loop().time() - begun < 1.3
        assert (await robot.ask(b"NEXT\n")).startswith(b"26,")
        assert (await robot.ask(b"WHY\n")).startswith(b"0,0,NO_RESULT ")


async def test_no_part_found_is_an_answer_of_its_own() -> None:
    async with cell() as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER 8\n") == b"1,0\r\n"


@pytest.mark.parametrize(
    "request_", [b"PART\n", b"TRIGGER seven\n", b"NEXT 3\n", b"\xff\xfe\n", b"TRIGGER 1 2\n"]
)
async def test_what_is_no_request_is_reported(request_: bytes) -> None:
    async with cell() as it:
        robot = await it.robot()
        assert (await robot.ask(request_)).startswith(b"10,0,BAD_REQUEST expected TRIGGER, NEXT")
        assert await robot.ask(b"STATUS\n") == b"0,0,1,1,7\r\n"


async def test_a_line_without_end_is_answered_and_ends_the_connection() -> None:
    async with cell() as it:
        robot = await it.robot()
        assert (await robot.ask(b"T" * 300)).startswith(b"11,0,TOO_LONG ")
        assert await robot.reader.read() == b""
        assert (await it.counts()).errors == 1


async def test_another_robot_waits_and_is_told_that_the_camera_is_busy() -> None:
    async with cell(timeout=1) as it:
        one, two = await it.robot(), await it.robot()
        one.writer.write(b"TRIGGER 9\n")
        await asyncio.sleep(0.01)
        assert (await two.ask(b"TRIGGER\n")).startswith(b"20,0,BUSY another robot")
        assert (await one.reader.readuntil(b"\n")).startswith(b"21,")


async def test_a_robot_that_leaves_in_the_middle_leaves_nothing_behind() -> None:
    async with cell(timeout=3) as it:
        robot = await it.robot()
        robot.writer.write(b"TRIGGER\n")
        await asyncio.sleep(0.02)
        robot.reset()
        counts = await it.counts()
        assert (counts.abandoned, counts.open, counts.delivered) == (1, 0, 0)
        other = await it.robot()
        assert await other.ask(b"TRIGGER\n") == FIRST  # its own: the turn is free again


async def test_a_second_request_before_the_answer_ends_the_connection() -> None:
    async with cell() as it:
        robot = await it.robot()
        robot.writer.write(b"TRIGGER\n")
        await asyncio.sleep(0.02)
        robot.writer.write(b"NEXT\n")
        assert await robot.reader.read() == b""
        assert (await it.counts()).abandoned == 2


async def test_numbered_requests_may_wait_for_each_other() -> None:
    async with cell() as it:
        robot = await it.robot()
        robot.writer.write(b"1 TRIGGER\n2 NEXT\n3 NEXT\n")
        lines = [await robot.reader.readuntil(b"\n") for _ in range(3)]
        assert lines == [b"1," + FIRST, b"2," + SECOND, b"3,1,0\r\n"]
        robot.writer.write(b"".join(b"%d STATUS\n" % n for n in range(20)))
        answers = [(await robot.reader.readuntil(b"\n")).split(b",") for _ in range(20)]
        assert sorted(int(one[0]) for one in answers) == list(range(20))
        assert sum(one[1] == b"20" for one in answers) == 11  # BUSY: one is served, eight wait
        await it.counts()


async def test_one_robot_too_many_is_told_and_the_others_stay() -> None:
    async with cell(clients=2) as it:
        robots = [await it.robot() for _ in range(2)]
        for robot in robots:
            assert await robot.ask(b"TRIGGER\n") == FIRST
        late = await it.robot()
        assert (await late.reader.readuntil(b"\n")).startswith(b"30,0,FULL ")
        assert await late.reader.read() == b""
        assert await robots[0].ask(b"STATUS\n") == b"0,0,1,1,7\r\n"
        assert (await it.counts()).refused == 1


async def test_a_silent_robot_is_hung_up_on_without_a_line() -> None:
    async with cell(idle=60) as it:
        robot = await it.robot()
        assert await robot.ask(b"STATUS\n") == b"0,0,1,1,7\r\n"
        await asyncio.sleep(61)
        assert await robot.reader.read() == b""


async def test_wait_takes_only_what_comes_after_it() -> None:
    async with cell(timeout=2) as it:
        one, two = await it.robot(), await it.robot()
        assert await two.ask(b"TRIGGER\n") == FIRST
        assert (await one.ask(b"WAIT\n")).startswith(b"21,0,TIMEOUT ")
        one.writer.write(b"WAIT\n")
        await asyncio.sleep(0.01)
        assert await two.ask(b"TRIGGER\n") == FIRST
        assert await one.reader.readuntil(b"\n") == FIRST


async def test_a_camera_that_is_away_is_reported() -> None:
    async with cell(timeout=2) as it:
        robot = await it.robot()
        await it.gateway.camera.close()
        assert (await robot.ask(b"TRIGGER\n")).startswith(b"22,0,NOT_CONNECTED ")
        assert await robot.ask(b"STATUS\n") == b"0,0,0,0,7\r\n"


async def test_a_stopped_camera_is_reported() -> None:
    async with cell(timeout=2) as it:
        robot = await it.robot()
        await it.gateway.camera.stop()
        assert (await robot.ask(b"TRIGGER\n")).startswith(b"23,0,NOT_RUNNING ")


async def test_bytes_are_no_parts() -> None:
    async with cell(interpret_as=None) as it:
        robot = await it.robot()
        assert (await robot.ask(b"TRIGGER\n")).startswith(b"25,0,UNREADABLE the result is bytes")


async def test_records_come_in_the_units_that_are_asked_for() -> None:
    async with cell(interpret_as="table: " + PARTS, length="m", angle="rad", decimals=4) as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER\n") == b"0,1,0.1000,0.2000,0.5000\r\n"


async def test_brackets_are_as_long_whatever_they_say() -> None:
    async with cell(robot="ur", timeout=1) as it:
        robot = await it.robot()
        first = await robot.ask(b"TRIGGER\n")
        assert first == b"(0,1,0.100000,0.200000,0.000000,0.000000,0.000000,0.500000)\n"
        assert await robot.ask(b"STATUS\n") == b"(0,0,1,1,7,0,0,0)\n"
        assert await robot.ask(b"TRIGGER 8\n") == b"(1,0,0,0,0,0,0,0)\n"
        assert await robot.ask(b"TRIGGER 9\n") == b"(21,0,0,0,0,0,0,0)\n"
        assert (await robot.ask(b"WHY\n")).startswith(b"TIMEOUT ")


async def test_a_flipped_tool_points_into_the_table() -> None:
    async with cell(robot="kuka", tool_flip=True) as it:
        robot = await it.robot()
        request = b"<Robot><Id>4</Id>\r\n<Request>TRIGGER</Request>\r\n</Robot>\r\n"
        answer = await robot.ask(request, b"</Gateway>")
        assert answer == (
            b'<Gateway><Id>4</Id><Code>0</Code><Left>1</Left><Part X="100.0000" Y="200.0000" '
            b'Z="0.0000" A="28.6479" B="0.0000" C="180.0000"/><Words></Words></Gateway>'
        )
        # every element is there in an error, too: each has a queue of its own in the controller
        wrong = await robot.ask(b"<Robot><Request>PICK</Request></Robot>", b"</Gateway>")
        assert wrong.startswith(
            b'<Gateway><Id>0</Id><Code>10</Code><Left>0</Left><Part X="0" Y="0" Z="0" A="0" B="0" '
            b'C="0"/><Words>BAD_REQUEST '
        )


async def test_answers_of_a_fixed_width_have_it() -> None:
    async with cell(robot="siemens") as it:
        robot = await it.robot()
        request = b"TRIGGER".ljust(30) + b"\r\n"
        for asked in (request, b"NEXT\0\0\0\r\n", b"\0\0PICK\r\n"):
            answer = await robot.ask(asked)
            assert (len(answer), answer[-2:]) == (96, b"\r\n")


async def test_what_also_stands_after_a_pose() -> None:
    async with cell(also=("quality", "feature_id")) as it:
        robot = await it.robot()
        assert await robot.ask(b"TRIGGER\n") == FIRST[:-2] + b",1.000,\r\n"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"listen": "127.0.0.1:7001"}, "tcp/HOST:PORT"),
        ({"robot": "ur", "also": ["feature_id"]}, "brackets have no room"),
        ({"line_end": "none"}, "need a width"),
        ({"separator": "."}, "stands in no number"),
        ({"timeout": 0}, "greater than 0"),
        ({"clients": 0}, "greater than or equal to 1"),
    ],
)
def test_settings_that_cannot_work_are_reported(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        GatewaySettings.model_validate(settings)


def test_a_file_says_all_that_options_say(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("url: bvs://192.168.0.10\nrobot: fanuc\nlength: m\ncalibration: plane.json\n")
    file = GatewayFile.load(path)
    assert file.calibration == str(tmp_path / "plane.json")
    settings = file.settings(decimals=6)
    assert (settings.robot, settings.style.length, settings.style.decimals) == ("fanuc", "m", 6)
    path.write_text("url: bvs://192.168.0.10\nrobot: fanuk\n")
    with pytest.raises(ConfigurationError, match=r"cell\.yaml, line 2: robot: "):
        GatewayFile.load(path)
    path.write_text("robot: fanuc\n")
    with pytest.raises(ConfigurationError, match="expected a camera's URL, or emulated: true"):
        GatewayFile.load(path)
