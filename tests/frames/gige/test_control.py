"""The control channel and discovery on real sockets."""

import asyncio
import ipaddress
import socket
import struct
from collections.abc import Callable
from typing import Any, cast

import pytest

from smartcam.exceptions import ConfigurationError, FrameSourceError, FrameTimeoutError
from smartcam.frames import FrameAddress
from smartcam.frames._gige import camera_url as _camera_url
from smartcam.frames._gige import driver
from smartcam.frames._gige import force_address as force
from smartcam.frames._gige.control import RequestRefusedError
from smartcam.frames._inside import ControlChannel, GigEDriver, checked_mac, force_address
from tests.frames.gige.camera import camera
from tests.frames.inside import AnsweringCamera as Found
from tests.frames.inside import DeviceInfo, Network, find_cameras, networks

Answers = Callable[[int, bytes], list[bytes]]


def ack(status: int, command: int, request: int, payload: bytes = b"") -> bytes:
    return struct.pack(">HHHH", status, command, len(payload), request) + payload


class Peer(asyncio.DatagramProtocol):
    """A peer with given answers."""

    def __init__(self, answers: Answers) -> None:
        self._answers = answers
        self.asked: list[bytes] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.asked.append(data)
        for one in self._answers(int.from_bytes(data[6:8], "big"), data):
            self.transport.sendto(one, addr)


async def asked(answers: Answers) -> tuple[int | FrameSourceError, Peer, ControlChannel]:
    """Read a register of a peer with given answers."""
    loop = asyncio.get_running_loop()
    transport, peer = await loop.create_datagram_endpoint(
        lambda: Peer(answers), local_addr=("127.0.0.1", 0)
    )
    control = await ControlChannel.connect(
        "127.0.0.1", transport.get_extra_info("sockname")[1], "cam"
    )
    try:
        return await control.read_register(0xA00), peer, control
    except FrameSourceError as error:
        return error, peer, control
    finally:
        control.close()
        control.close()
        transport.close()
        await asyncio.sleep(0)


WORD = struct.pack(">I", 7)


async def test_a_request_without_an_answer_is_sent_again_with_its_id() -> None:
    times = 0

    def second(request: int, _: bytes) -> list[bytes]:
        nonlocal times
        times += 1
        return [ack(0, 0x81, request, WORD)] if times == 2 else []

    value, peer, _ = await asked(second)
    assert value == 7
    assert peer.asked[0] == peer.asked[1]
    assert len(peer.asked) == 2


async def test_answers_to_other_requests_and_noise_are_dropped() -> None:
    value, _, control = await asked(
        lambda request, _: [
            b"",
            b"noise",
            ack(0, 0x81, request + 1, struct.pack(">I", 9)),
            ack(0, 0x81, request, WORD),
            ack(0, 0x81, request, struct.pack(">I", 9)),
        ]
    )
    assert value == 7
    assert control.dropped >= 2


async def test_silence_and_endless_pending_end() -> None:
    error, peer, _ = await asked(lambda *_: [])
    assert isinstance(error, FrameTimeoutError)
    assert len(peer.asked) == 3
    begun = asyncio.get_running_loop().time()
    pending = struct.pack(">HH", 0, 60_000)
    error, _, _ = await asked(lambda request, _: [ack(0, 0x89, request, pending)])
    assert isinstance(error, FrameTimeoutError)
    assert asyncio.get_running_loop().time() - begun < 100


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ((0x8003, 0x81, b""), "INVALID_ADDRESS"),
        ((0, 0x85, WORD), "expected an answer 0x0081 of 4 bytes, got 0x0085 of 4"),
        ((0, 0x81, b""), "got 0x0081 of 0"),
    ],
)
async def test_wrong_answer_is_an_error(answer: tuple[int, int, bytes], message: str) -> None:
    error, _, _ = await asked(lambda request, _: [ack(answer[0], answer[1], request, answer[2])])
    assert isinstance(error, FrameSourceError)
    assert message in str(error)
    assert not isinstance(error, RequestRefusedError) or error.status == 0x8003


async def test_closed_port_is_reported_at_once() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    begun = asyncio.get_running_loop().time()
    with pytest.raises(FrameSourceError, match="nothing listens there"):
        await GigEDriver(FrameAddress.parse(f"gige://127.0.0.1:{port}")).open()
    assert asyncio.get_running_loop().time() - begun < 0.2


async def test_memory_is_read_and_written_in_words_and_parts() -> None:
    async with camera() as there:
        control = await ControlChannel.connect("127.0.0.1", there.port, "cam")
        await control.write_register(0xA00, 2)
        assert await control.read(0x68, 6) == b"Tester"
        assert await control.read(0x69, 5) == b"ester"
        assert len(await control.read(0x20000, 1500)) == 1500
        await control.write(0x10015, b"\1\2")
        assert there.words[0x10014] == 0x40010200
        await control.write(0x10014, bytes(range(8)))
        assert there.words[0x10018] == 0x04050607
        control.close()
        with pytest.raises(FrameSourceError, match="closed"):
            await control.read_register(0)


async def test_cameras_are_found() -> None:
    async with camera() as there, camera(deaf=True):
        place = Network("127.0.0.1", ("127.0.0.1",))
        (found,) = await find_cameras([place], port=there.port)
        nowhere = await find_cameras([place, Network("192.0.2.1", ())], port=1)
    assert nowhere == []
    assert found.info.label == "Maker Tester (T1)"
    assert found.info.mac == "02:00:00:00:00:01"
    assert found.reachable
    assert Network("127.0.0.1", ("127.255.255.255", "127.0.0.1")) in [
        one._replace(network=None) for one in networks()
    ] or not hasattr(socket, "AF_PACKET")


def info(address: str, serial: str) -> Found:
    device = DeviceInfo("02:00:00:00:00:02", address, "Maker", "Tester", "1", serial, "left")
    return Found(device, address, address != "10.0.0.9")


async def test_a_camera_is_chosen_by_its_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    async def found(_: object) -> list[Found]:
        return [info("10.0.0.8", "A"), info("10.0.0.9", "B")]

    monkeypatch.setattr(_camera_url, "find_cameras", found)
    monkeypatch.setattr(driver, "find_cameras", found)
    address = FrameAddress.parse("gige://?serial=B")
    assert await _camera_url.find_camera(address, _camera_url.read_wanted_stream(address)) == (
        "10.0.0.9",
        3956,
    )
    for url, message in (
        ("gige://", "expected one camera, found 2"),
        ("gige://?serial=C", "found 0"),
    ):
        with pytest.raises(FrameSourceError, match=message) as caught:
            await GigEDriver(FrameAddress.parse(url)).open()
        assert caught.value.available[0] == 'gige://10.0.0.8 "left" Maker Tester (A)'
    first, second = await GigEDriver.discover()
    assert first.url == "gige://10.0.0.8"
    assert first.remark == ""
    assert "10.0.0.9 is outside of the network" in second.remark


# FORCEIP


HERE = [Network("127.0.0.1", ("127.0.0.1",), ipaddress.IPv4Network("127.0.0.0/8"))]


MAC = "02:00:00:00:00:01"


async def test_a_camera_gets_an_address() -> None:
    async with camera(address="10.9.8.7") as there:
        found = await force_address(
            "02-00-00-00-00-01",
            "127.0.5.6/16",
            gateway="127.0.0.2",
            in_networks=HERE,
            port=there.port,
        )
        assert there.forced == ("127.0.5.6", "255.255.0.0", "127.0.0.2")
        assert found.url == "gige://127.0.5.6"
        assert not found.remark


async def test_missing_camera_is_reported() -> None:
    async with camera() as there:
        with pytest.raises(FrameSourceError, match="answers; there are 02:00:00:00:00:01 Maker"):
            await force_address(
                "02:00:00:00:00:02", "127.0.5.6/8", in_networks=HERE, port=there.port
            )
        assert not there.forced


async def test_camera_under_other_control_refuses() -> None:
    async with camera() as there:
        there.owner = ("127.0.0.1", 1)
        with pytest.raises(FrameSourceError, match="ACCESS_DENIED"):
            await force_address(MAC, "127.0.5.6/8", in_networks=HERE, port=there.port)


async def test_camera_that_ignores_its_address_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(force, "APPEAR_TIMEOUT", 0.1)
    async with camera() as there:
        there.answer_forceip_only = True
        with pytest.raises(FrameTimeoutError, match="does not answer at it within"):
            await force_address(MAC, "127.0.5.6/8", in_networks=HERE, port=there.port)


@pytest.mark.parametrize(
    ("mac", "address", "more", "text"),
    [
        ("02:00:00:00:00", "127.0.5.6/8", {}, "mac: expected"),
        (7, "127.0.5.6/8", {}, "mac: expected a text"),
        (MAC, "127.0.5.6", {}, "prefix is missing"),
        (MAC, "127.0.5.999/8", {}, "expected an IPv4 address"),
        (MAC, "::1/64", {}, "expected an IPv4 address"),
        (MAC, "192.168.0.0/24", {}, "the network's own"),
        (MAC, "192.168.0.255/24", {}, "the network's own"),
        (MAC, "224.0.0.5/24", {}, "no device can have it"),
        (MAC, "0.0.0.0/31", {}, "no device can have it"),
        (MAC, "127.0.5.6/8", {"gateway": "here"}, "gateway: expected"),
    ],
)
async def test_invalid_addresses_are_refused(
    mac: Any, address: str, more: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigurationError, match=text):
        await force_address(mac, address, in_networks=[], **more)


def test_a_hardware_address_may_be_written_in_many_ways() -> None:
    assert checked_mac("0A0b.0c0D.0E0f") == checked_mac("0a-0b-0c-0d-0e-0f") == "0a:0b:0c:0d:0e:0f"
