"""Packets, as tshark reads them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import Connected, Disconnected
from smartcam.observers import TraceEntry
from smartcam.recording import Recording, write_pcap
from tests.recording.recordingkit import (
    COUNTER,
    PACKET_URLS,
    URL,
    at,
    container,
    frame,
    packet_items,
    record,
    session,
    status,
    write,
)
from tests.wireshark import TSHARK, needs_tshark

FIELDS = (
    "frame.time_epoch",
    "ip.src",
    "ip.dst",
    *(f"{kind}.{name}" for kind in ("tcp", "udp") for name in ("srcport", "dstport", "payload")),
    "tcp.stream",
    "tcp.flags.syn",
    "tcp.flags.ack",
    "tcp.flags.fin",
    "tcp.analysis.flags",
    "_ws.malformed",
    "_ws.expert.severity",
)
WARNING = 0x600000
"""Of tshark's severities; checksums that are wrong are errors."""


def packets(path: Path) -> list[dict[str, str]]:
    """Return the packets as tshark reads them, and see that it finds nothing wrong."""
    command = [TSHARK, "-r", str(path), "-T", "fields"]
    for kind in ("ip", "tcp", "udp"):
        command += ["-o", f"{kind}.check_checksum:TRUE"]
    for name in FIELDS:
        command += ["-e", name]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)  # noqa: S603
    found = [dict(zip(FIELDS, row.split("\t"), strict=True)) for row in done.stdout.splitlines()]
    for packet in found:
        assert (packet["tcp.analysis.flags"], packet["_ws.malformed"]) == ("", "")
        assert all(int(one) < WARNING for one in packet["_ws.expert.severity"].split(",") if one)
    return found


def opened(found: list[dict[str, str]], name: str) -> list[str]:
    """Return a field of the first packet of each connection."""
    return [
        one[name] for one in found if (one["tcp.flags.syn"], one["tcp.flags.ack"]) == ("1", "0")
    ]


def said(recording: Recording, direction: str) -> str:
    return "".join(one.hex for one in recording.frames() if one.direction == direction)


@needs_tshark
@pytest.mark.parametrize(("transport", "host"), [("tcp", "127.0.0.1"), ("udp", "127.0.0.1")])
async def test_pcap_of_a_run_has_nothing_wrong_for_tshark(
    tmp_path: Path, transport: Any, host: str
) -> None:
    path = tmp_path / "run.pcap"
    async with EmulatedCamera([COUNTER], transport=transport, host=host) as emulator:
        recording = await record(tmp_path / "run.mcap", emulator, triggers=2)
        port = str(emulator.port)
    count = write_pcap(recording, path)
    found = packets(path)
    assert len(found) == count
    payload, source = f"{transport}.payload", f"{transport}.srcport"
    assert "".join(one[payload] for one in found if one[source] != port) == said(recording, ">")
    assert "".join(one[payload] for one in found if one[source] == port) == said(recording, "<")


@needs_tshark
@pytest.mark.parametrize("scheme", ["bvs", "bvs+udp"])
def test_pcap_of_an_ipv6_camera_has_nothing_wrong_for_tshark(tmp_path: Path, scheme: str) -> None:
    url = f"{scheme}://[2001:db8::7]:36701?dialect=handbook"
    recording = write(tmp_path / "run.mcap", session(url))
    assert write_pcap(recording, tmp_path / "run.pcap") == len(packets(tmp_path / "run.pcap"))


@needs_tshark
def test_pcap_packet_has_the_recorded_time(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [frame(0.123456, "> Connect")])
    write_pcap(recording, tmp_path / "run.pcap")
    times = [
        one["frame.time_epoch"] for one in packets(tmp_path / "run.pcap") if one["tcp.payload"]
    ]
    assert times == [f"{at(0).timestamp():.0f}.123456000"]


@needs_tshark
def test_pcap_large_frame_is_divided_into_segments(tmp_path: Path) -> None:
    data = bytes(range(256)) * 4096
    large = container(1, b"")._replace(hex=data.hex())
    recording = write(tmp_path / "run.mcap", [*session(), large])
    write_pcap(recording, tmp_path / "run.pcap")
    payloads = [one["tcp.payload"] for one in packets(tmp_path / "run.pcap")]
    segments = [payload for payload in payloads if len(payload) > 2]
    assert {len(payload) // 2 for payload in segments[:-1]} == {1460}
    assert "".join(segments) == data.hex()


@needs_tshark
def test_pcap_each_link_is_a_connection_of_its_own(tmp_path: Path) -> None:
    gone = Disconnected(camera="left", at=at(3), reason="gone", expected=False)
    tries = [frame(4, "> Disconnect"), frame(4, "> Connect")]
    recording = write(tmp_path / "run.mcap", [*session(), gone, *tries, *tries])
    write_pcap(recording, tmp_path / "run.pcap")
    found = packets(tmp_path / "run.pcap")
    assert opened(found, "tcp.srcport") == ["49153", "49154", "49155"]
    ends = [(one["tcp.stream"], one["tcp.srcport"]) for one in found if one["tcp.flags.fin"] == "1"]
    assert ends[:3] == [("0", "36701"), ("0", "49153"), ("1", "49154")]


@needs_tshark
def test_pcap_addresses_are_the_cameras_or_made_up(tmp_path: Path) -> None:
    named = Connected(camera="left", at=at(0), url="bvs://camera.lan:36701?dialect=handbook")
    one = write(tmp_path / "a.mcap", session(URL))
    other = write(tmp_path / "b.mcap", [frame(0, "> Connect"), named])
    write_pcap(one, tmp_path / "a.pcap")
    write_pcap(other, tmp_path / "b.pcap")
    first, second = packets(tmp_path / "a.pcap")[0], packets(tmp_path / "b.pcap")[0]
    assert (first["ip.src"], first["ip.dst"]) == ("192.0.2.1", "192.168.0.10")
    assert (second["ip.src"], second["ip.dst"]) == ("192.0.2.1", "192.0.2.2")


def test_pcap_of_one_camera_leaves_the_others_out(tmp_path: Path) -> None:
    items = [frame(0, "> Connect"), frame(1, "> Query")._replace(camera="right")]
    recording = write(tmp_path / "run.mcap", items)
    assert write_pcap(recording, tmp_path / "both.pcap") == 16
    assert write_pcap(recording, tmp_path / "one.pcap", camera="right") == 8
    with pytest.raises(ConfigurationError, match="it has no camera 'up'"):
        write_pcap(recording, tmp_path / "none.pcap", camera="up")


def test_pcap_what_has_no_bytes_makes_no_packet(tmp_path: Path) -> None:
    secret = TraceEntry(at(0), "left", ">", None, "password", {"text": "***"}, "")
    recording = write(tmp_path / "run.mcap", [secret])
    assert write_pcap(recording, tmp_path / "run.pcap") == 0
    assert (tmp_path / "run.pcap").stat().st_size == 24


def test_pcap_file_that_is_there_is_refused(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [status(0)])
    path = tmp_path / "run.pcap"
    path.write_text("precious")
    with pytest.raises(ConfigurationError, match=r"run\.pcap: the file exists already"):
        write_pcap(recording, path)
    assert path.read_text() == "precious"
    assert write_pcap(recording, path, overwrite=True) == 8
    with pytest.raises(ConfigurationError, match="Is a directory"):
        write_pcap(recording, tmp_path, overwrite=True)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux has /dev/full")
def test_pcap_full_disk_is_told(tmp_path: Path) -> None:
    recording = write(tmp_path / "run.mcap", [status(0)])
    with pytest.raises(RecordingError, match="pcap /dev/full: No space left on device"):
        write_pcap(recording, "/dev/full", overwrite=True)


@pytest.mark.parametrize("name", PACKET_URLS)
def test_pcap_is_to_the_byte_what_dpkt_made(tmp_path: Path, name: str) -> None:
    """The golden files were written with dpkt 1.9.8, before its place was taken."""
    recording = write(tmp_path / "run.mcap", packet_items(PACKET_URLS[name]))
    write_pcap(recording, tmp_path / "run.pcap")
    golden = Path(__file__).parent / "golden" / f"{name}.pcap"
    assert (tmp_path / "run.pcap").read_bytes() == golden.read_bytes()


@needs_tshark
@pytest.mark.parametrize("name", PACKET_URLS)
def test_pcap_of_frames_of_all_sizes_has_nothing_wrong_for_tshark(
    tmp_path: Path, name: str
) -> None:
    recording = write(tmp_path / "run.mcap", packet_items(PACKET_URLS[name]))
    assert write_pcap(recording, tmp_path / "run.pcap") == len(packets(tmp_path / "run.pcap"))


@needs_tshark
@settings(max_examples=5)
@given(st.lists(st.binary(min_size=1, max_size=70) | st.just(b"\xff\xff" * 8), min_size=20))
@pytest.mark.parametrize("scheme", ["bvs", "bvs+udp"])
def test_pcap_checksums_are_those_that_tshark_works_out(scheme: str, data: list[bytes]) -> None:
    with TemporaryDirectory() as folder:
        frames = [container(1, b"")._replace(hex=one.hex()) for one in data]
        url = f"{scheme}://192.168.0.10:36701?dialect=handbook"
        recording = write(Path(folder, "run.mcap"), [*session(url), *frames])
        count = write_pcap(recording, Path(folder, "run.pcap"))
        assert count == len(packets(Path(folder, "run.pcap")))


def test_pcap_checksum_of_0_is_written_as_all_ones(tmp_path: Path) -> None:
    """RFC 768: 0 says that a datagram has none."""

    def checksum(payload: bytes) -> bytes:
        frame_ = container(1, b"")._replace(hex=payload.hex())
        recording = write(
            tmp_path / f"{payload.hex()}.mcap",
            [Connected(camera="left", at=at(0), url=PACKET_URLS["udp4"]), frame_],
        )
        write_pcap(recording, tmp_path / f"{payload.hex()}.pcap")
        begin = 24 + 16 + 14 + 20 + 6  # file, record, Ethernet, IP, the header's first fields
        return (tmp_path / f"{payload.hex()}.pcap").read_bytes()[begin : begin + 2]

    needed = checksum(b"\0\0")
    assert needed not in {b"\0\0", b"\xff\xff"}
    assert checksum(needed) == b"\xff\xff"
