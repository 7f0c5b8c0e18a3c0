"""Packets of control and stream, byte by byte, and invalid bytes."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import MessageError
from smartcam.frames._gige import gvsp
from tests.frames.gige.packets import header, leader, trailer
from tests.frames.inside import gvcp


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (gvcp.encode(gvcp.GvcpCommand.DISCOVERY, 1, flags=0x11), "4211000200000001"),
        (
            gvcp.encode(gvcp.GvcpCommand.READREG, 2, gvcp.readreg_payload(0x0A00)),
            "420100800004000200000a00",
        ),
        (
            gvcp.encode(gvcp.GvcpCommand.WRITEREG, 3, gvcp.writereg_payload((0x0A00, 2))),
            "420100820008000300000a0000000002",
        ),
        (
            gvcp.encode(gvcp.GvcpCommand.READMEM, 4, gvcp.readmem_payload(0x200, 512)),
            "4201008400080004" + "0000020000000200",
        ),
        (
            gvcp.encode(gvcp.GvcpCommand.WRITEMEM, 5, gvcp.writemem_payload(0x200, b"abcd")),
            "4201008600080005" + "0000020061626364",
        ),
        (
            gvcp.encode_resend(6, 7, 2, 9, extended=False),
            "42000040000c0006" + "00000007" + "00000002" + "00000009",
        ),
        (
            gvcp.encode_resend(6, 1 << 40, 2, 9, extended=True),
            "4210004000140006" + "00000000" + "00000002" + "00000009" + "0000010000000000",
        ),
    ],
)
def test_requests(packet: bytes, expected: str) -> None:
    assert packet.hex() == expected


def test_an_answer() -> None:
    ack = gvcp.decode_ack(bytes.fromhex("8006008300000003"))
    assert tuple(ack) == (gvcp.GvcpStatus.ACCESS_DENIED, 0x83, 3, b"")
    assert gvcp.status_text(0x8006) == "ACCESS_DENIED (0x8006)"
    assert gvcp.status_text(0x9001) == "status 0x9001"
    with pytest.raises(MessageError, match="4 bytes of payload are announced, got 2"):
        gvcp.decode_ack(bytes.fromhex("00000081000400020000"))


def test_headers() -> None:
    assert gvsp.decode_header(header(3, 7, 9), 8) == (0, 7, 3, 9, 8)
    long = header(3, 1 << 40, 1 << 25, 0x100, extended=True)
    assert gvsp.decode_header(long, 20) == (0x100, 1 << 40, 3, 1 << 25, 20)
    assert gvsp.decode_header(long, 19) is None
    assert gvsp.decode_header(b"", 0) is None


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    gvsp.decode_header(data, len(data))
    for reader in (
        gvcp.decode_ack,
        gvcp.DeviceInfo.decode,
        gvsp.decode_leader,
        gvsp.decode_trailer,
    ):
        with contextlib.suppress(MessageError):
            reader(data)
    assert gvcp.text(data).isprintable()


@pytest.mark.parametrize("packet", [leader(1, 1), trailer(1, 2)])
def test_a_cut_packet_is_refused(packet: bytes) -> None:
    reader = gvsp.decode_leader if packet[4] == 1 else gvsp.decode_trailer
    for size in range(len(packet) - 8):
        with pytest.raises(MessageError):
            reader(packet[8 : 8 + size])
    reader(packet[8:])
    reader(packet[8:] + b"more")
