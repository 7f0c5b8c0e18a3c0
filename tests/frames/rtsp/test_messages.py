"""Requests that are cut from a client's bytes, and bytes that are refused."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.frames.inside import messages

REQUESTS = (
    b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n",
    b"SET_PARAMETER rtsp://h/a RTSP/1.0\r\nCSeq: 2\r\nContent-Length: 6\r\n\r\n$\0\r\n\r\n",
    b"\r\n\r\nPLAY rtsp://h/a RTSP/1.0\nCSeq:3\nRange: npt=0-\n\n",
    b"$\1\0\3abc",
    b"GET_PARAMETER rtsp://h/a RTSP/1.0\r\ncseq: 4\r\nX: a\r\nX: b\r\nContent-Length: 0\r\n\r\n",
    b"$\7\0\0",
)
MESSAGES = (
    messages.RtspRequest("OPTIONS", "*", {"cseq": "1"}),
    messages.RtspRequest(
        "SET_PARAMETER", "rtsp://h/a", {"cseq": "2", "content-length": "6"}, b"$\0\r\n\r\n"
    ),
    messages.RtspRequest("PLAY", "rtsp://h/a", {"cseq": "3", "range": "npt=0-"}),
    messages.ChannelData(1, b"abc"),
    messages.RtspRequest(
        "GET_PARAMETER", "rtsp://h/a", {"cseq": "4", "x": "a, b", "content-length": "0"}
    ),
    messages.ChannelData(7, b""),
)


def read(*pieces: bytes) -> list[messages.RtspRequest | messages.ChannelData]:
    """Return the messages in pieces that are parsed one after the other."""
    parser, found = messages.RequestParser(), []
    for piece in pieces:
        parser.feed(piece)
        while (message := parser.next()) is not None:
            found.append(message)
    return found


def pieces_of(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in pairwise(places)]


@given(st.lists(st.integers(0, 10_000), max_size=30))
def test_pieces_do_not_matter(cuts: list[int]) -> None:
    assert read(*pieces_of(b"".join(REQUESTS), cuts)) == list(MESSAGES)


def test_byte_by_byte() -> None:
    data = b"".join(REQUESTS)
    assert read(*(data[at : at + 1] for at in range(len(data)))) == list(MESSAGES)


@given(
    st.lists(
        st.binary(max_size=60)
        | st.sampled_from([*REQUESTS, b"$", b"\r\n", b"RTSP/1.0\r\n", b"Content-Length: 9\r\n"]),
        max_size=12,
    ),
    st.lists(st.integers(0, 2000), max_size=12),
)
def test_any_bytes_are_read_alike_in_any_pieces_or_refused(
    parts: list[bytes], cuts: list[int]
) -> None:
    def told(*pieces: bytes) -> tuple[list[messages.RtspRequest | messages.ChannelData], int]:
        parser, found = messages.RequestParser(), []
        for piece in pieces:
            parser.feed(piece)
            try:
                while (message := parser.next()) is not None:
                    found.append(message)
            except messages.RtspError as error:
                return found, error.status if error.fatal else -1
        assert parser.unparsed_bytes <= messages.MAX_MESSAGE_BYTES
        return found, 0

    data = b"".join(parts)
    assert told(data) == told(*pieces_of(data, cuts))
    assert told(data)[1] >= 0


@pytest.mark.parametrize(
    ("data", "status", "text"),
    [
        (b"GET / HTTP/1.1\r\n", 400, "METHOD URL RTSP/1.0"),
        (b"RTSP/1.0 200 OK\r\n", 400, "METHOD URL RTSP/1.0"),
        (b"options * RTSP/1.0\r\n", 400, "METHOD URL RTSP/1.0"),
        (b"OPTIONS *  RTSP/1.0\r\n", 400, "METHOD URL RTSP/1.0"),
        (b"OPTIONS * RTSP/2.0\r\n", 505, "got RTSP/2.0"),
        (b"\x16\x03\x01\x02\x00\n", 400, "METHOD URL RTSP/1.0"),
        (b"OPTIONS * RTSP/1.0\r\n folded\r\n", 400, "NAME: VALUE"),
        (b"OPTIONS * RTSP/1.0\r\nA : b\r\n", 400, "NAME: VALUE"),
        (b"OPTIONS * RTSP/1.0\r\nA: \0\r\n", 400, "NAME: VALUE"),
        (b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\ncseq: 2\r\n", 400, "cseq: expected once"),
        (b"OPTIONS * RTSP/1.0\r\nContent-Length: -1\r\n", 413, "Content-Length"),
        (b"OPTIONS * RTSP/1.0\r\nContent-Length: \xb2\r\n", 413, "Content-Length"),
        (
            b"OPTIONS * RTSP/1.0\r\nContent-Length: %d\r\n" % (messages.MAX_BODY_BYTES + 1),
            413,
            "Content-Length",
        ),
        (b"OPTIONS * RTSP/1.0\r\n" + b"A: b\r\n" * messages.MAX_LINE_BYTES, 400, "a: expected"),
        (b"A" * (messages.MAX_LINE_BYTES + 1), 400, "a line"),
        (b"A" * (messages.MAX_LINE_BYTES + 1) + b"\n", 400, "a line"),
        (
            b"OPTIONS * RTSP/1.0\r\n"
            + b"".join(b"A%d: b\r\n" % n for n in range(messages.MAX_HEADERS + 1)),
            400,
            "headers",
        ),
    ],
)
def test_bytes_without_a_request_are_refused(data: bytes, status: int, text: str) -> None:
    with pytest.raises(messages.RtspError, match=text) as caught:
        read(data)
    assert (caught.value.status, caught.value.fatal) == (status, True)


def test_half_message_is_recognized() -> None:
    parser = messages.RequestParser()
    for data, midst in ((b"\r\n", False), (b"OPT", True), (b"IONS * RTSP/1.0\r\n", True)):
        parser.feed(data)
        assert parser.next() is None
        assert parser.has_partial_message == midst
    parser.feed(b"\r\n")
    assert parser.next() == messages.RtspRequest("OPTIONS", "*", {})
    assert not parser.has_partial_message


@pytest.mark.parametrize("cseq", [{}, {"cseq": ""}, {"cseq": "-1"}, {"cseq": "1" * 10}])
def test_a_request_has_a_number(cseq: dict[str, str]) -> None:
    with pytest.raises(messages.RtspError, match="CSeq"):
        messages.cseq_of(messages.RtspRequest("OPTIONS", "*", cseq))


def test_answers() -> None:
    assert messages.encode_answer(461, "3", (("A", "b"),), b"c\n") == (
        b"RTSP/1.0 461 Unsupported Transport\r\nCSeq: 3\r\nA: b\r\nContent-Length: 2\r\n\r\nc\n"
    )
    assert messages.encode_answer(200, "") == b"RTSP/1.0 200 OK\r\n\r\n"
