"""Test ifm's sensors: tickets, uploaded layouts, images, errors and versions."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam.emulator import ManualClock
from smartcam.exceptions import (
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    ConnectFailedError,
    FrameError,
    InterpretationError,
    NotRunningError,
    OvertriggeredError,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.makes import EmulatedIfm
from tests.handmade import until
from tests.makes.inside import ImageChunk, read_chunks

PATIENCE = 10.0
TYPELESS = b'{"layouter":"flexible","elements":[{"type":1}]}'
PART = {"n": 7, "x": 12.5, "passed": True, "name": "bolt", "ROIs": [{"q": 0.5}, {"q": 0.25}]}


def v3(ticket: int | str, content: bytes) -> bytes:
    """Return a frame of version 3."""
    body = f"{ticket}".encode() + content + b"\r\n"
    return f"{ticket}L{len(body):09}\r\n".encode() + body


class Peer:
    """A device for one client; a test sees its requests and chooses the answers."""

    def __init__(self) -> None:
        self.requests: asyncio.Queue[tuple[int, str]] = asyncio.Queue()
        self.says: dict[str, bytes] = {
            "G?": b"IFM ELECTRONIC\tO2D500",
            "p7": b"*",
            "E?": b"000000000",
            "A?": b"001\t01\t01",
        }
        self.uploaded = b"*"
        self._writer: asyncio.StreamWriter | None = None

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                header = await reader.readexactly(16)
                body = await reader.readexactly(int(header[5:14]))
                ticket, line = int(body[:4]), body[4:-2].decode()
                if line[0] == "c":
                    self.say(ticket, self.uploaded)
                elif line in self.says:
                    self.say(ticket, self.says[line])
                else:
                    self.requests.put_nowait((ticket, line))
        writer.close()

    def say(self, ticket: int | str, content: bytes) -> None:
        assert self._writer is not None
        self._writer.write(v3(ticket, content))


@contextlib.asynccontextmanager
async def scripted_device(**options: Any) -> AsyncIterator[tuple[Peer, smartcam.Camera[Any]]]:
    peer = Peer()
    server = await asyncio.start_server(peer.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    try:
        async with smartcam.connect(f"pcic://127.0.0.1:{port}?dialect=v3", **options) as camera:
            yield peer, camera
    finally:
        server.close()
        await server.wait_closed()


# ---------------------------------------------------------------------- tickets


@pytest.mark.asyncio
async def test_results_that_come_while_a_command_waits_are_not_lost() -> None:
    async with scripted_device() as (peer, camera), camera.results() as results:
        waiting = asyncio.create_task(camera.request("S?"))
        ticket, line = await peer.requests.get()
        assert line == "S?"
        for number in range(5):
            peer.say("0000", b"star;%d;stop" % number)
        peer.say(ticket, b"0000000005")
        assert await waiting == b"0000000005"
        async with asyncio.timeout(PATIENCE):
            found = [(await anext(results)).raw for _ in range(5)]
        assert found == [b"star;%d;stop" % number for number in range(5)]


@pytest.mark.asyncio
async def test_result_of_somebody_else_never_ends_a_trigger() -> None:
    async with scripted_device() as (peer, camera):
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        ticket, line = await peer.requests.get()
        assert line == "T?"
        peer.say("0000", b"star;other;stop")
        await camera.query_application()  # everything before its answer is heard
        assert not trigger.done()
        peer.say(ticket, b"star;own;stop")
        result = await trigger
        assert result.raw == b"star;own;stop"
        assert result.latency is not None
        assert camera.statistics().unclaimed == 1


@pytest.mark.asyncio
async def test_answer_under_an_unknown_ticket_ends_the_link() -> None:
    async with scripted_device(reconnect=None) as (peer, camera):
        peer.say(4711, b"*")
        with pytest.raises(smartcam.ConnectionLostError, match="nothing was asked"):
            await camera.trigger(timeout=PATIENCE)


@pytest.mark.asyncio
async def test_refused_trigger_is_tried_again_or_told() -> None:
    async with scripted_device() as (peer, camera):
        refused = asyncio.create_task(camera.trigger(when_busy="refuse"))
        ticket, _ = await peer.requests.get()
        peer.say(ticket, b"!")
        with pytest.raises(CameraBusyError, match="another trigger source"):
            await refused
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        for content in (b"!", b"!", b"star;1;stop"):
            ticket, _ = await peer.requests.get()
            peer.say(ticket, content)
        assert (await trigger).raw == b"star;1;stop"


@pytest.mark.asyncio
async def test_device_in_configuration_mode_is_not_running() -> None:
    async with scripted_device() as (peer, camera):
        peer.says["E?"] = b"!"
        with pytest.raises(NotRunningError):
            await camera.trigger()


@pytest.mark.asyncio
async def test_errors_and_notifications_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "smartcam.client")
    async with scripted_device() as (peer, camera):
        peer.say("0001", b"110002001:Short circuit on OUT1")
        peer.say("0010", b'000500003:{"ID":1}')
        peer.say("0020", b"anything")
        await camera.query_application()
    assert "error 110002001: Short circuit on OUT1" in caplog.text
    assert 'notification 500003: {"ID":1}' in caplog.text


@pytest.mark.asyncio
async def test_overrun_ends_an_asynchronous_trigger() -> None:
    clock = ManualClock()
    async with (
        EmulatedIfm(clock=clock) as emulator,
        smartcam.connect(f"{emulator.url}?trigger=async") as camera,
    ):
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        await until(lambda: emulator.busy)
        emulator.device.trigger()
        with pytest.raises(OvertriggeredError):
            await trigger


@pytest.mark.asyncio
async def test_overrun_of_a_sensor_does_not_touch_a_trigger_with_a_ticket() -> None:
    clock = ManualClock()
    async with EmulatedIfm(clock=clock) as emulator, smartcam.connect(emulator.url) as camera:
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        await until(lambda: emulator.busy)
        emulator.device.trigger()
        await camera.query_application()
        clock.advance(1.0)
        assert (await trigger).raw.startswith(b"star;")


@pytest.mark.asyncio
async def test_several_clients_have_layouts_of_their_own() -> None:
    defaults = {"parts": [PART]}
    async with (
        EmulatedIfm(defaults=defaults) as emulator,
        smartcam.connect(emulator.url, interpret_as="n: int16") as one,
        smartcam.connect(emulator.url, interpret_as="name: string[6]") as two,
        two.results() as seen,
    ):
        assert (await one.trigger()).value.n == 7
        async with asyncio.timeout(PATIENCE):
            assert (await anext(seen)).value.name == "bolt"
        assert one.connected
        assert two.connected


# ---------------------------------------------------------------------- layouts


@pytest.mark.parametrize(
    ("layout", "value"),
    [
        ("n: uint8, x: real32 mm", {"n": 7, "x": 0.0125}),
        ("n: int32, passed: bool, name: string[4]", {"n": 7, "passed": True, "name": "bolt"}),
        ("x: real64", {"x": 12.5}),
        ("name: string[2]", {"name": "bo"}),
    ],
)
@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.asyncio
async def test_what_comes_is_what_was_declared(
    layout: str, value: dict[str, object], version: int
) -> None:
    async with (
        EmulatedIfm(defaults={"parts": [PART]}, version=version) as emulator,
        smartcam.connect(emulator.url, interpret_as=layout) as camera,
    ):
        found = (await camera.trigger()).value._asdict()
        assert found == pytest.approx(value)
        await camera.switch_application(2)
        assert (await camera.trigger()).value._asdict() == pytest.approx(value)


@pytest.mark.asyncio
async def test_records_are_those_of_the_group_that_has_their_name() -> None:
    async with (
        EmulatedIfm(defaults={"parts": [PART]}) as emulator,
        smartcam.connect(emulator.url, interpret_as="passed: bool, ROIs: (q: real32)*") as camera,
    ):
        value = (await camera.trigger()).value
        assert (value.passed, [one.q for one in value.ROIs]) == (True, [0.5, 0.25])
        described = json.loads((await camera.request("C?") or b"")[9:])
        assert [one["id"] for one in described["elements"]] == ["start_string", "passed", "ROIs"]


@pytest.mark.parametrize(
    ("layout", "why"),
    [("n: int64", "no int64"), ("(n: int8)[3]", "cannot fix the number of records")],
)
@pytest.mark.asyncio
async def test_layout_that_no_device_can_send_is_a_mistake(layout: str, why: str) -> None:
    async with EmulatedIfm() as emulator:
        with pytest.raises((ConfigurationError, ConnectFailedError), match=why):
            async with smartcam.connect(emulator.url, interpret_as=layout):
                pass


@pytest.mark.asyncio
async def test_version_without_lengths_has_no_binary_results() -> None:
    async with EmulatedIfm(version=2) as emulator:
        with pytest.raises((ConfigurationError, ConnectFailedError), match="use v3 or v4"):
            async with smartcam.connect(f"{emulator.url}?dialect=v2", interpret_as="n: int8"):
                pass


@pytest.mark.asyncio
async def test_result_of_another_layout_is_reported_and_not_read() -> None:
    async with scripted_device(interpret_as="n: int32") as (peer, camera):
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        ticket, _ = await peer.requests.get()
        peer.say(ticket, b"star;1;stop")
        with pytest.raises(InterpretationError, match="smartcam;"):
            await trigger


@pytest.mark.asyncio
async def test_refused_layout_is_no_session() -> None:
    peer = Peer()
    peer.uploaded = b"!"
    server = await asyncio.start_server(peer.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    with pytest.raises(ConnectFailedError, match="refused the session"):
        await smartcam.connect(
            f"pcic://127.0.0.1:{port}?dialect=v3", interpret_as="n: int8", connect_timeout=1.0
        )
    server.close()
    await server.wait_closed()


@pytest.mark.asyncio
async def test_emulated_sensor_refuses_what_is_no_layout() -> None:
    async with EmulatedIfm() as emulator:
        reader, writer = await asyncio.open_connection("127.0.0.1", emulator.port)
        for ticket, text in enumerate((b'{"elements":}', b"[]", TYPELESS), 1000):
            writer.write(v3(ticket, b"c%09d" % len(text) + text))
        writer.write(v3(1003, b"c"))
        answers = [await reader.readexactly(23) for _ in range(4)]
        assert [one[20:21] for one in answers] == [b"!", b"!", b"!", b"?"]
        writer.close()
        await writer.wait_closed()


# ---------------------------------------------------------------------- other requests


@pytest.mark.asyncio
async def test_input_goes_to_the_container_of_the_url() -> None:
    async with EmulatedIfm() as emulator, smartcam.connect(f"{emulator.url}?input=3") as camera:
        await camera.set_input(b"bolt \xff")
        assert await camera.request("J03?") == b"000000006bolt \xff"
        assert (await camera.trigger(input=b"nut")).raw.startswith(b"star")
        assert emulator.inputs[3] == "nut"
        with pytest.raises(ConfigurationError, match="256 bytes"):
            await camera.set_input(bytes(257))
        assert await camera.query_application() == 1


@pytest.mark.asyncio
async def test_commands_of_the_table_are_answered() -> None:
    async with EmulatedIfm() as emulator, smartcam.connect(emulator.url) as camera:
        for line in ("g1", "g0", "o011", "d1005", "p3"):
            assert await camera.request(line) == b"*"
        assert await camera.request("O01?") == b"011"
        assert len(await camera.request("H?") or b"") > 800
        assert await camera.request("V?") == b"03 01 02 03"
        assert await camera.request("L?") == b"001"
        with pytest.raises(UnsupportedError, match="wrong syntax"):
            await camera.request("S")
        with pytest.raises(CommandRejectedError, match="not now"):
            await camera.request("I77?")
        with pytest.raises(ConfigurationError, match="dialect fixes the protocol's version"):
            await camera.request("v01")
        with pytest.raises(UnsupportedError, match="ifm: dialect v3 has no Stop"):
            await camera.stop()


@pytest.mark.asyncio
async def test_images_come_with_their_chunks() -> None:
    async with (
        EmulatedIfm(defaults={"images": 3}) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        await camera.trigger()
        assert (await camera.read_image()).startswith(b"P5\n64 48\n255\n")
        chunks = read_chunks(await camera.request("I02?") or b"")
        assert [(one.type, one.width, one.height, one.number) for one in chunks] == [
            (251, 64, 48, count) for count in (1, 2, 3)
        ]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda data: data[:-1], "is not the beginning"),
        (lambda data: b"x" + data[1:], "is not the beginning"),
        (lambda data: data[:13] + struct.pack("<i", 8) + data[17:], "image chunk of 8 bytes"),
        (lambda data: data[:17] + struct.pack("<i", -1) + data[21:], "header of -1"),
        (lambda data: b"000000003abc", "3 bytes are no image chunk"),
    ],
)
def test_broken_chunks_are_a_frame_error(change: Any, why: str) -> None:
    chunk = ImageChunk(251, 4, 2, 1, 12.5, bytes(8)).encoded
    data = b"%09d" % len(chunk) + chunk
    assert read_chunks(data) == [ImageChunk(251, 4, 2, 1, 12.5, bytes(8))]
    with pytest.raises(FrameError, match=why):
        read_chunks(change(data))


@pytest.mark.asyncio
async def test_something_else_that_speaks_frames_is_no_sensor() -> None:
    peer = Peer()
    peer.says["G?"] = b"ACME\tX1"
    server = await asyncio.start_server(peer.serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    with pytest.raises(ConnectFailedError) as caught:
        await smartcam.connect(f"pcic://127.0.0.1:{port}?dialect=v3", connect_timeout=1.0)
    assert "IFM ELECTRONIC" in "".join(caught.value.attempts)
    server.close()
    await server.wait_closed()


@pytest.mark.asyncio
async def test_trigger_that_a_switch_cuts_off_ends_in_time() -> None:
    clock = ManualClock()
    async with EmulatedIfm(clock=clock) as emulator, smartcam.connect(emulator.url) as camera:
        trigger = asyncio.create_task(camera.trigger(timeout=0.5))
        await until(lambda: emulator.busy)
        emulator.device.switch_application(0)
        with pytest.raises(TriggerTimeoutError, match="no application"):
            await trigger


def test_emulated_sensor_refuses_what_is_no_option() -> None:
    mistakes: list[dict[str, Any]] = [
        {"applications": [0]},
        {"applications": [1], "active": 2},
        {"applications": [{"id": 1, "triger": "process"}]},
        {"defaults": {"trigger": "never"}},
        {"defaults": {"parts": []}},
        {"version": 5},
    ]
    for options in mistakes:
        with pytest.raises(ConfigurationError):
            EmulatedIfm(**options)
