"""The Wireshark dissector, in a real tshark."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
import re
import shutil
import socket
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import smartcam
from smartcam._dissector import lua_source, lua_tables
from smartcam.emulator import EmulatedCamera
from smartcam.protocols import BVS, FramedDialect
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from smartcam.protocols.messages import Sender
from tests import ROOT
from tests.machines import B16, BID, THESIS
from tests.protocols.test_vectors import VECTORS
from tests.wireshark import PORT, Capture, Shown, needs_tshark, show, tshark
from tests.wireshark import lua as lua  # a fixture

CLIENT, CAMERA = Sender.CLIENT, Sender.CAMERA
CODE = B16.with_quirks(["code"])
VARIANTS = list({vector.dialect.label: vector.dialect for vector in VECTORS}.values())


def pinned(dialect: FramedDialect) -> list[str]:
    """Return tshark's options that pin a dialect."""
    quirks = [("-o", f"bvs.quirk_{name}:TRUE") for name in dialect.quirks]
    return ["-o", f"bvs.dialect:{dialect.name}", *itertools.chain(*quirks)]


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return Capture(tmp_path / "made.pcap")


# ---------------------------------------------------------------------- the file


def test_source_is_ascii_and_has_every_message_of_every_dialect() -> None:
    source = lua_source()
    assert source.isascii()
    for dialect in BVS.dialects.values():
        assert f'["name"] = "{dialect.name}"' in source
        for row in dialect.table:
            assert f'["name"] = "{row.type.__name__}"' in source
            assert f'["title"] = "{row.title}"' in source


def test_tables_quirks_put_together_are_the_dialect_with_all_of_them() -> None:
    (b16,) = [one for one in lua_tables()["DIALECTS"] if one["name"] == "b16"]
    for count in (2, 3):
        for names in itertools.combinations(B16.wire_quirks, count):
            quirks = [one for one in b16["quirks"] if one["name"] in names]
            for row in B16.with_quirks(names).table:
                sender = row.type.sender.value
                entry = b16["messages"][sender][row.message_id]
                for quirk in quirks:
                    entry = quirk["messages"][sender].get(row.message_id, entry)
                codec = B16.with_quirks(names).encoder(row.type)
                assert entry["fields"] == [[name, wire.value] for name, wire in row.fields]
                assert (entry["size"], entry["data"]) == (codec.size, codec.has_data)
                assert entry["big_endian"] is (row.byte_order == ">")
                assert entry["code_alone"] is codec.may_be_code_only


# ---------------------------------------------------------------------- messages


@needs_tshark
@pytest.mark.parametrize("dialect", VARIANTS, ids=lambda one: one.label)
def test_vectors_of_a_pinned_dialect_are_shown_as_decoded(
    lua: Path, capture: Capture, dialect: FramedDialect
) -> None:
    vectors = [one for one in VECTORS if one.dialect is dialect]
    for number, vector in enumerate(vectors):
        capture.udp(vector.sender, vector.data, 50000 + number)
    found = show(lua, capture.path, *pinned(dialect))
    assert [one.message(dialect) for one in found] == [one.message for one in vectors]
    assert [one.fields["sender"] for one in found] == [one.sender.value for one in vectors]
    assert {one.fields["dialect"] for one in found} == {dialect.label}
    assert {name for one in found for name in one.findings} <= {"refused", "unnamed_bits"}


@needs_tshark
@pytest.mark.parametrize("dialect", [HANDBOOK, BID], ids=lambda one: one.name)
def test_vectors_in_segments_of_any_size_are_put_together(
    lua: Path, capture: Capture, dialect: FramedDialect
) -> None:
    vectors = [one for one in VECTORS if one.dialect is dialect]
    for sender in Sender:
        for vector in (one for one in vectors if one.sender is sender):
            for byte in vector.data:
                capture.tcp(sender, bytes([byte]), 50001)
        whole = b"".join(one.data for one in vectors if one.sender is sender)
        for size, client in ((7, 50002), (len(whole), 50003)):
            for begin in range(0, len(whole), size):
                capture.tcp(sender, whole[begin : begin + size], client)
    found = show(lua, capture.path, *pinned(dialect))
    for client, sender in itertools.product((50001, 50002, 50003), Sender):
        ports = (client, PORT) if sender is CLIENT else (PORT, client)
        wanted = [one.message for one in vectors if one.sender is sender]
        assert [one.message(dialect) for one in found if one.ports == ports] == wanted


@needs_tshark
def test_status_bits_are_drawn_where_they_stand(lua: Path, capture: Capture) -> None:
    capture.udp(CAMERA, bytes.fromhex("12000200 2801"))
    text = tshark(lua, capture.path, "-O", "bvs", *pinned(BID))
    assert "Status: 0x00000128 (RUNNING|SIMULATION_MODE|OVERTRIGGERED)" in text
    assert "[Running: True]" in text
    assert ".... .... .... ...0 = Waiting for trigger: False" in text
    assert ".... ...1 .... .... = Overtriggered: True" in text
    assert ".... .... ..1. .... = Busy: False" in text


@needs_tshark
def test_result_codes_say_what_they_mean(lua: Path, capture: Capture) -> None:
    capture.udp(CAMERA, BID.encode(m.TriggerAnswer(code=0x16)))
    capture.udp(CAMERA, BID.encode(m.TriggerAnswer(code=0x77)))
    capture.udp(CAMERA, BID.encode(m.TriggerAnswer(code=0)))
    capture.udp(CAMERA, bytes.fromhex("31000200 1a00"))  # a refusing code and nothing else
    shown = show(lua, capture.path, *pinned(BID))
    assert [one.fields["verdict"] for one in shown] == ["busy", "refused", "done", "refused"]
    assert [one.findings for one in shown] == [["refused"], ["refused"], [], ["refused"]]
    assert shown[3].fields["message"] == "SwitchAnswer"
    text = tshark(lua, capture.path, "-O", "bvs", *pinned(BID))
    assert "Code: 0x00000016 (NOK Busy: Ready status is not set)" in text
    assert "Code: 0x00000077 (not documented)" in text


@needs_tshark
def test_answers_are_linked_to_their_requests(lua: Path, capture: Capture) -> None:
    capture.udp(CLIENT, HANDBOOK.encode(m.Query()))
    capture.udp(CLIENT, HANDBOOK.encode(m.GetClock()))
    capture.udp(CLIENT, HANDBOOK.encode(m.Trigger()))
    capture.udp(CAMERA, HANDBOOK.encode(m.QueryAnswer(application=7)))
    capture.udp(CAMERA, HANDBOOK.encode(m.QueryAnswer(application=7)))
    shown = show(lua, capture.path, "-2")  # the first pass finds what the second one shows
    assert [one.fields.get("answer_in") for one in shown] == ["4", None, None, None, None]
    assert [one.fields.get("answer_to") for one in shown] == [None, None, None, "1", None]
    assert shown[3].fields["time"] == "0.003000000"


@needs_tshark
def test_info_column_names_all_messages_of_a_packet(lua: Path, capture: Capture) -> None:
    status = m.StatusReport(status=smartcam.Status.BUSY)
    capture.tcp(CAMERA, HANDBOOK.encode(m.ConnectAnswer(version=1)) + HANDBOOK.encode(status)[:15])
    rest = HANDBOOK.encode(m.ResultContainer(application=3, data=bytes(40)))
    capture.tcp(CAMERA, HANDBOOK.encode(status)[15:] + rest)
    lines = tshark(lua, capture.path, "-T", "fields", "-e", "_ws.col.Info").splitlines()
    assert lines[0].startswith("ConnectAnswer(version=1)")
    data = 32 * "00" + "..."
    assert lines[1] == (
        f"StatusReport(status=BUSY, endian=0); ResultContainer(application=3, data={data})"
    )


# ---------------------------------------------------------------------- what is broken


@needs_tshark
def test_datagrams_that_are_broken_are_shown_with_the_reason(lua: Path, capture: Capture) -> None:
    query = HANDBOOK.encode(m.Query())
    broken = {
        "wrong magic": b"\x51" + query[1:],
        "too short": query[:7],
        "length bomb": bytes.fromhex("50535642 ffffffff 20000000"),
        "two frames": query + query,
        "rest missing": HANDBOOK.encode(m.SwitchApplication(application=1))[:-1],
        "thesis, length 0": bytes.fromhex("42565350 00000000 01000000"),
    }
    for data in broken.values():
        capture.udp(CLIENT, data)
    shown = show(lua, capture.path)
    assert [one.findings for one in shown] == [
        ["no_frame"], ["unfinished"], ["no_frame"], ["no_frame"], ["unfinished"], ["no_frame"],
    ]  # fmt: skip
    assert [bytes.fromhex(one.fields["skipped"]) for one in shown] == list(broken.values())


@needs_tshark
def test_bodies_that_do_not_fit_are_shown_with_the_reason(lua: Path, capture: Capture) -> None:
    capture.udp(CAMERA, bytes.fromhex("50535642 06000000 12000000 10000000 0000"))
    capture.udp(CAMERA, bytes.fromhex("50535642 05000000 30000000 15000000 ff"))
    capture.udp(CAMERA, bytes.fromhex("50535642 01000000 77000000 ab"))
    short, long, unknown = show(lua, capture.path)
    assert (short.findings, short.fields["message"]) == (["malformed"], "StatusReport")
    assert short.status(HANDBOOK) == smartcam.Status.BUSY
    assert (long.findings, long.fields["surplus"]) == (["long_body"], "ff")
    assert long.message(HANDBOOK) == m.QueryAnswer(application=21)
    assert unknown.findings == ["unknown_id"]
    assert unknown.message(HANDBOOK) == m.UnknownMessage(message_id=0x77, payload=b"\xab")
    text = tshark(lua, capture.path, "-O", "bvs")
    assert "StatusReport came with 6 bytes, it needs 8" in text


@needs_tshark
def test_stream_goes_on_at_the_next_magic_number(lua: Path, capture: Capture) -> None:
    query, answer = HANDBOOK.encode(m.Query()), HANDBOOK.encode(m.QueryAnswer(application=1))
    capture.tcp(CLIENT, query)
    capture.tcp(CAMERA, answer + b"garbage" + answer)
    _, first, garbage, second = show(lua, capture.path)
    assert first.message(HANDBOOK) == second.message(HANDBOOK) == m.QueryAnswer(application=1)
    assert (garbage.findings, garbage.fields["skipped"]) == (["no_frame"], b"garbage".hex())


@needs_tshark
def test_random_bytes_never_break_the_dissector(lua: Path, capture: Capture) -> None:
    chance = random.Random(6)  # noqa: S311 - the same ones always
    for number in range(400):
        vector = chance.choice(VECTORS)
        data = bytearray(vector.data)
        for _ in range(chance.randrange(4)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        cut = bytes(data[: chance.randrange(len(data) + 1)])
        (capture.udp if number % 2 else capture.tcp)(vector.sender, cut, 50000 + number % 60)
    for options in ([], ["-2"], pinned(THESIS), pinned(CODE)):
        assert show(lua, capture.path, *options)


# ---------------------------------------------------------------------- which dialect, which side


def conversation(capture: Capture, *steps: tuple[Sender, str], client: int = 50000) -> None:
    for sender, text in steps:
        capture.tcp(sender, bytes.fromhex(text), client)


@needs_tshark
def test_dialect_without_magic_is_found_by_what_the_camera_says(
    lua: Path, capture: Capture
) -> None:
    connect, status = (CLIENT, "01000000"), (CAMERA, "12000200 2000")
    long_answer, ask = (CAMERA, "01000400 00000100"), (CLIENT, "12000000")
    conversation(capture, connect, (CAMERA, "01000200 0100"), status, client=1001)
    conversation(capture, connect, long_answer, (CLIENT, "30000000"), ask, status, client=1002)
    conversation(capture, connect, long_answer, status, client=1003)
    conversation(capture, connect, long_answer, ask, (CLIENT, "41000000"), client=1004)
    conversation(capture, connect, long_answer, (CLIENT, "16000000"), client=1005)
    conversation(capture, (CLIENT, "02000000"), (CAMERA, "02000200 0000"), client=1006)
    shown = show(lua, capture.path, "-2")
    labels = {min(one.ports): one.fields["dialect"] for one in shown}
    assert labels == {
        1001: "b16",
        1002: "bid",
        1003: "b16 with quirk code",
        1004: "b16 with quirk code",
        1005: "bid",
        1006: "bid",
    }


@needs_tshark
def test_side_on_another_port_is_found_by_what_is_reported(lua: Path, tmp_path: Path) -> None:
    capture = Capture(tmp_path / "made.pcap", camera=999)
    capture.udp(CAMERA, HANDBOOK.encode(m.QueryAnswer(application=1)))
    capture.udp(CLIENT, HANDBOOK.encode(m.Query()))
    capture.udp(CLIENT, THESIS.encode(m.Connect()), 50007)
    shown = show(lua, capture.path)  # a magic number is known on any port
    assert [one.fields["sender"] for one in shown] == ["camera", "client", "client"]
    assert [one.fields["dialect"] for one in shown] == ["handbook", "handbook", "thesis"]


@needs_tshark
def test_other_ports_are_left_alone_unless_told(lua: Path, tmp_path: Path) -> None:
    capture = Capture(tmp_path / "made.pcap", camera=999)
    capture.tcp(CLIENT, B16.encode(m.Connect()))
    assert show(lua, capture.path) == []
    for option in (["-d", "tcp.port==999,bvs"], ["-o", "bvs.port:999"]):
        (found,) = show(lua, capture.path, *option)
        assert found.fields["message"] == "Connect"


@needs_tshark
def test_another_protocol_on_the_port_is_not_swallowed(lua: Path, capture: Capture) -> None:
    capture.tcp(CLIENT, b"GET / HTTP/1.1\r\nHost: camera\r\n\r\n")
    (found,) = show(lua, capture.path)
    assert found.findings == ["no_frame"]


@needs_tshark
def test_filters_of_the_documents_are_understood_and_find_something(
    lua: Path, capture: Capture
) -> None:
    page = ROOT / "docs" / "wireshark.md"
    filters = re.findall(r"^\| `(bvs[^`]*)` \|", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(filters) > 8
    status = smartcam.Status.BUSY | smartcam.Status.OVERTRIGGERED
    capture.tcp(CLIENT, HANDBOOK.encode(m.Query()))
    capture.tcp(CAMERA, HANDBOOK.encode(m.QueryAnswer(application=7)))
    capture.tcp(CAMERA, HANDBOOK.encode(m.StatusReport(status=status)))
    capture.tcp(CAMERA, HANDBOOK.encode(m.ResultContainer(application=7, data=b"bolt M4")))
    capture.tcp(CAMERA, HANDBOOK.encode(m.SwitchAnswer(code=1, application=7)))
    capture.tcp(CAMERA, bytes.fromhex("50535642 01000000 12000000 ff"))
    capture.tcp(CAMERA, bytes.fromhex("50535642 00000000 77000000"))
    capture.tcp(CAMERA, b"garbage")
    capture.tcp(CAMERA, bytes.fromhex("50535642 05000000 30000000 15000000 ff"))
    capture.udp(CAMERA, b"\x50")
    with ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda one: tshark(lua, capture.path, "-2", "-Y", one), filters)
        assert [one for one, text in zip(filters, found, strict=True) if not text] == []


# ---------------------------------------------------------------------- a real capture

SPOKEN = [
    (dialect, transport, quirks)
    for transport in ("tcp", "udp")
    for dialect, quirks in (
        ("handbook", {}),
        ("thesis", {}),
        ("b16", {}),
        ("b16", {"code": True}),
        ("bid", {}),
    )
]


@contextlib.asynccontextmanager
async def dumping(path: Path, cameras: list[EmulatedCamera]) -> AsyncIterator[None]:
    """Capture what cameras hear and say; at the end all of it is in the file.

    Other tests run beside this one: their clients may have the port of a camera with the other
    transport.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as marker:
        marker.bind(("127.0.0.1", 0))
        places = [("udp", marker.getsockname()[1]), *((one.transport, one.port) for one in cameras)]
        wanted = " or ".join(f"{transport} port {port}" for transport, port in places)
        process = await asyncio.create_subprocess_exec(
            *("dumpcap", "-q", "-i", "lo", "-w", str(path), "-f", f"ip and ({wanted})"),
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(120):
                await _began(process)
                yield
                await _flushed(path, marker)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
            await asyncio.wait_for(process.communicate(), 60)


async def _began(process: asyncio.subprocess.Process) -> None:
    assert process.stderr is not None
    heard = b""
    while b"File:" not in heard:
        line = await process.stderr.readline()
        heard += line
        if not line:
            pytest.skip(f"needs leave to capture on loopback: {heard.decode().strip()}")


async def _flushed(path: Path, marker: socket.socket) -> None:
    """Send marks until one is in the file: packets come in order."""
    mark = b"smartcam: the end of a capture"
    while mark not in path.read_bytes():  # noqa: ASYNC240 - a small file
        marker.sendto(mark, marker.getsockname())
        await asyncio.sleep(0.02)


async def use(emulator: EmulatedCamera) -> None:
    """Have a session with everything in it that every dialect has."""
    async with smartcam.connect(emulator.url, application=3) as camera:
        await camera.trigger()
        await camera.get_clock()
        await camera.switch_application(1)
        await camera.trigger()
        with pytest.raises(smartcam.CommandRejectedError):
            await camera.switch_application(77)


@needs_tshark
@pytest.mark.skipif(shutil.which("dumpcap") is None, reason="needs Wireshark's dumpcap")
@pytest.mark.real_time
async def test_captured_sessions_are_shown_as_the_camera_saw_them(
    lua: Path, tmp_path: Path
) -> None:
    path, fast = tmp_path / "lo.pcapng", {"load_time": 0, "processing_time": 0}
    programs: list[dict[str, Any]] = [
        {"id": number, "layout": "n: int32", "constant": {"n": number}, **fast} for number in (1, 3)
    ]
    async with contextlib.AsyncExitStack() as stack:
        cameras = [
            await stack.enter_async_context(
                EmulatedCamera(programs, dialect=dialect, transport=transport, quirks=quirks)  # type: ignore[arg-type]
            )
            for dialect, transport, quirks in SPOKEN
        ]
        async with dumping(path, cameras):
            await asyncio.gather(*map(use, cameras))
    told = [("-d", f"{one.transport}.port=={one.port},bvs") for one in cameras]
    shown = await asyncio.to_thread(show, lua, path, "-2", *itertools.chain(*told))
    for camera in cameras:
        for sender, direction in ((CLIENT, "in"), (CAMERA, "out")):
            said = [one.message for one in camera.log if one.direction == direction]
            place = (camera.transport, camera.port)
            seen = [one for one in shown if (one.transport, one.ports[sender is CLIENT]) == place]
            assert [one.message(camera.wire_dialect) for one in seen] == said, camera.url
            assert {one.fields["sender"] for one in seen} == {sender.value}
            assert {one.fields["dialect"] for one in seen} == {camera.wire_dialect.label}
    assert {name for one in shown for name in one.findings} == {"refused"}
    unlinked = [one for one in shown if one.fields["message"] == "QueryAnswer" and not linked(one)]
    assert unlinked == []


def linked(one: Shown) -> bool:
    return "answer_to" in one.fields and float(one.fields["time"]) >= 0
