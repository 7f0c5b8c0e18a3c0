"""A bench for the dissector: captures made by hand, and what tshark shows of them."""

from __future__ import annotations

import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar
from xml.etree import ElementTree as ET

import pytest

from smartcam._dissector import lua_source
from smartcam.models import Status
from smartcam.protocols import FramedDialect
from smartcam.protocols import messages as m
from smartcam.protocols.messages import Sender, UnknownMessage, wire_fields

PORT = 36701
SECONDS = 300
BYTES = {"magic", "data", "payload", "surplus", "skipped"}
FINDINGS = {
    *("malformed", "no_frame", "unfinished", "long_body"),
    *("unknown_id", "refused", "unnamed_bits"),
}

TSHARK = shutil.which("tshark") or ""

TestT = TypeVar("TestT", bound="Callable[..., object]")


def needs_tshark(test: TestT) -> TestT:
    """Mark a test that Wireshark's command line has a part in."""
    reason = "needs tshark: Wireshark's command line"
    marked: TestT = pytest.mark.long(pytest.mark.skipif(not TSHARK, reason=reason)(test))
    return marked


class Capture:
    """Packets in a file: raw IPv4 without check sums."""

    def __init__(self, path: Path, camera: int = PORT) -> None:
        self.path = path
        self._camera = camera  # its port
        self._numbers: dict[tuple[int, Sender], int] = {}
        self._time = 0
        path.write_bytes(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101))

    def udp(self, sender: Sender, data: bytes, client: int = 50000) -> None:
        """Add a datagram."""
        ports = self._ports(sender, client)
        self._add(sender, 17, struct.pack(">HHHH", *ports, 8 + len(data), 0) + data)

    def tcp(self, sender: Sender, data: bytes, client: int = 50000) -> None:
        """Add a segment behind those before it."""
        number = self._numbers.get((client, sender), 1)
        self._numbers[client, sender] = number + len(data)
        flags, window = 0x5018, 65535
        ports = self._ports(sender, client)
        head = struct.pack(">HHIIHHHH", *ports, number, 1, flags, window, 0, 0)
        self._add(sender, 6, head + data)

    def _ports(self, sender: Sender, client: int) -> tuple[int, int]:
        from_client = sender is Sender.CLIENT
        return (client, self._camera) if from_client else (self._camera, client)

    def _add(self, sender: Sender, protocol: int, data: bytes) -> None:
        ends = [b"\x0a\0\0\x01", b"\x0a\0\0\x02"]
        source, target = ends if sender is Sender.CLIENT else ends[::-1]
        size = 20 + len(data)
        packet = struct.pack(">BBHHHBBH", 0x45, 0, size, 0, 0, 64, protocol, 0) + source + target
        self._time += 1000
        with self.path.open("ab") as file:
            file.write(struct.pack("<IIII", 1, self._time, size, size) + packet + data)


class Shown(NamedTuple):
    """One message, or bytes that make no frame, as Wireshark shows it."""

    packet: int  # its packet's number
    transport: str  # of the packet: tcp or udp
    ports: tuple[int, int]  # of the packet: source and target
    # value of each field by its name, without ``bvs.``; hex where it is bytes
    fields: dict[str, str]
    findings: list[str]  # names of the expert's findings

    def message(self, dialect: FramedDialect) -> m.Message:
        """Return the message that these fields are."""
        name = self.fields["message"]
        if name == "UnknownMessage":
            payload = bytes.fromhex(self.fields.get("payload", ""))
            return UnknownMessage(message_id=int(self.fields["id"], 16), payload=payload)
        message_type: type[m.Message] = getattr(m, name)
        values: dict[str, object] = {}
        for field, wire in wire_fields(message_type):
            if field == "status":
                values[field] = self.status(dialect)
            elif field in dialect.fields(message_type):
                text = self.fields.get(field, "")
                values[field] = bytes.fromhex(text) if wire is m.Wire.DATA else int(text, 0)
        return message_type(**values)

    def status(self, dialect: FramedDialect) -> Status:
        """Return the status that the named and the other bits make."""
        bits = int(self.fields.get("status.others", "0"), 0) << dialect.status_bits.unnamed_shift
        for member in Status:
            if self.fields.get(f"status.{(member.name or '').lower()}") in {"True", "1"}:
                bits |= member
        return Status(bits)


@pytest.fixture(scope="session")
def lua(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the dissector's file."""
    path = tmp_path_factory.mktemp("lua") / "smartcam.lua"
    path.write_text(lua_source(), encoding="ascii")
    return path


def tshark(lua: Path, capture: Path, *options: str) -> str:
    """Return what tshark prints of a capture; the dissector must not fail."""
    done = subprocess.run(  # noqa: S603
        [
            str(shutil.which("tshark")),
            "-n",
            "-X",
            f"lua_script:{lua}",
            "-r",
            str(capture),
            *options,
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS,
    )
    assert done.returncode == 0, done.stderr
    assert "Lua" not in done.stderr, done.stderr
    assert "Lua Error" not in done.stdout
    return done.stdout


def show(lua: Path, capture: Path, *options: str) -> list[Shown]:
    """Return every message that the dissector finds in a capture."""
    root = ET.fromstring(tshark(lua, capture, "-T", "pdml", *options))  # noqa: S314
    return [
        _shown(packet, proto)
        for packet in root.iter("packet")
        for proto in packet.iter("proto")
        if proto.get("name") == "bvs"
    ]


def _shown(packet: ET.Element, proto: ET.Element) -> Shown:
    values = {one.get("name", ""): one.get("show", "") for one in packet.iter("field")}
    transport = "tcp" if "tcp.srcport" in values else "udp"
    fields: dict[str, str] = {}
    findings: list[str] = []
    for one in proto.iter("field"):
        name, shown = one.get("name", ""), one.get("show", "")
        kept = name.removeprefix("bvs.")
        if name.startswith("bvs.") and kept in FINDINGS:
            findings.append(kept)
        elif name.startswith("bvs."):
            fields[kept] = shown.replace(":", "") if kept in BYTES else shown
    number = int(packet.find("proto/field[@name='num']").get("show", ""))  # type: ignore[union-attr]
    ports = (int(values[f"{transport}.srcport"]), int(values[f"{transport}.dstport"]))
    return Shown(number, transport, ports, fields, findings)
