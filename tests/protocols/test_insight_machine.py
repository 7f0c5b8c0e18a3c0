"""In-Sight native mode, the client's machine: to the byte, in pieces, and with wrong bytes."""

from __future__ import annotations

import contextlib
import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, FrameError, LocalProtocolError, UnsupportedError
from smartcam.models import Status
from smartcam.protocols import Frame, LinkEnded, LinkFailed, Role, State, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import INSIGHT, Event
from tests.protocols.inside import (
    MAX_LINE_BYTES,
    MAX_READ_BYTES,
    NATIVE,
    Command,
    InSightMachine,
    Piece,
    Reply,
)
from tests.protocols.insight_lines import (
    BITMAP,
    DIGITS,
    GREETING,
    IMAGE_LINES,
    LOGIN,
    Talk,
    with_cells,
)

ONLINE = Status.RUNNING | Status.WAITING_FOR_TRIGGER
WELCOME = m.ConnectAnswer(code=1, version=1)
REFUSED = m.ConnectAnswer(code=-6, version=1)
TRIGGERED = m.TriggerAnswer(code=1)

# request, its command lines with their answers, what is told
NAMES = ("A001", "Part.Name", "B002", "B003")
CONVERSATIONS: list[tuple[m.Message, list[tuple[bytes, bytes]], list[Event]]] = [
    (m.GetStatus(), [(b"GO", b"1\r\n")], [m.StatusReport(status=ONLINE)]),
    (m.GetStatus(), [(b"GO", b"0\r\n")], [m.StatusReport(status=Status(0))]),
    (m.Query(), [(b"GJ", b"1\r\n7\r\n")], [m.QueryAnswer(code=1, application=7)]),
    (m.Query(), [(b"GJ", b"1\r\n007\r\n")], [m.QueryAnswer(code=1, application=7)]),
    (m.Query(), [(b"GJ", b"-2\r\n")], [m.QueryAnswer(code=1, application=-1)]),
    (m.Query(), [(b"GJ", b"0\r\n")], [m.QueryAnswer(code=1, application=-1)]),
    (
        m.SwitchApplication(application=12),
        [(b"SJ12", b"1\r\n"), (b"GJ", b"1\r\n12\r\n")],
        [m.SwitchAnswer(code=1, application=12)],
    ),
    (
        m.SwitchApplication(application=13),
        [(b"SJ13", b"-2\r\n"), (b"GJ", b"1\r\n12\r\n")],
        [m.SwitchAnswer(code=-2, application=12)],
    ),
    (
        m.LoadFile(name="M\u00fcller.job".encode()),
        [(b"LFM\xfcller.job", b"1\r\n"), (b"GJ", b"-2\r\n")],
        [m.SwitchAnswer(code=1, application=-1)],
    ),
    (m.Start(), [(b"SO1", b"1\r\n")], [m.StartAnswer(code=1)]),
    (m.Start(), [(b"SO1", b"-5\r\n")], [m.StartAnswer(code=-5)]),
    (m.Stop(), [(b"SO0", b"1\r\n")], [m.StopAnswer(code=1)]),
    (
        m.Trigger(),
        [
            (b"SW8", b"1\r\n"),
            (b"GJ", b"1\r\n7\r\n"),
            (b"GVA001", b"1\r\n12.500\r\n"),
            (b"GVPart.Name", b"1\r\n\xb0 M6\r\n"),
            (b"GVB002", b"-2\r\n"),
            (b"GVB003", b"1\r\n#ERR\r\n"),
            (b"GJ", b"1\r\n7\r\n"),
        ],
        [
            TRIGGERED,
            m.ResultContainer(
                application=7,
                data=json.dumps(
                    {"A001": "12.500", "Part.Name": "\xb0 M6", "B002": None, "B003": "#ERR"}
                ).encode(),
                cells=(
                    m.CellValue("A001", "12.500"),
                    m.CellValue("Part.Name", "\xb0 M6"),
                    m.CellValue("B002", None),
                    m.CellValue("B003", None),
                ),
            ),
        ],
    ),
    (
        m.Trigger(),
        [
            (b"SW8", b"1\r\n"),
            (b"GJ", b"1\r\n7\r\n"),
            *((b"GV" + cell.encode(), b"-2\r\n") for cell in NAMES),
            (b"GJ", b"1\r\n8\r\n"),
        ],
        [
            TRIGGERED,
            m.ResultContainer(
                application=7,
                data=json.dumps(dict.fromkeys(NAMES)).encode(),
                cells=tuple(m.CellValue(cell, None) for cell in NAMES),
                fault="job 8 was loaded while the cells of job 7 were read",
            ),
        ],
    ),
    (
        m.Trigger(),
        [(b"SW8", b"-2\r\n"), (b"GO", b"0\r\n")],
        [m.StatusReport(status=Status(0)), m.TriggerAnswer(code=-2)],
    ),
    (m.Trigger(), [(b"SW8", b"-6\r\n")], [m.TriggerAnswer(code=-6)]),
    (m.ReadImage(), [(b"RI", b"1\r\n100\r\n" + IMAGE_LINES)], [m.Image(code=1, data=BITMAP)]),
    (
        m.ReadImage(),
        [(b"RI", b"0\r\n"), (b"RB", b"1\r\n50\r\n" + IMAGE_LINES)],
        [m.Image(code=1, data=BITMAP)],
    ),
    (m.ReadImage(), [(b"RI", b"-4\r\n")], [m.Image(code=-4, data=b"")]),
    (
        Command(line="EV GetCellValue(A1)"),
        [(b"EV GetCellValue(A1)", b"1\r\n6\r\n<a>\r\n\xb0\r\n")],
        [Reply(line="EV GetCellValue(A1)", code=1, data=b"<a>\r\n\xb0")],
    ),
    (Command(line="se8"), [(b"se8", b"-2\r\n")], [Reply(line="se8", code=-2)]),
    (
        Command(line="GI"),
        [(b"GI", b"1\r\na: 1\r\nb: 2\r\nc: 3\r\nd: 4\r\ne: 5\r\n")],
        [Reply(line="GI", code=1, data=b"a: 1\nb: 2\nc: 3\nd: 4\ne: 5")],
    ),
]
CELLS = with_cells("A1", "Part.Name", "B2:B3")
each = pytest.mark.parametrize(
    ("request_", "lines", "told"), CONVERSATIONS, ids=[repr(one[1])[:40] for one in CONVERSATIONS]
)


def failure(talk: Talk) -> str:
    """Return the text that the link failed with; it is the last event, and nothing comes after."""
    *_, last = talk.told()
    assert isinstance(last, LinkFailed)
    assert isinstance(last.error, FrameError)
    assert talk.machine.state is State.FAILED
    assert talk.hear(b"1\r\n" * 9) == b""
    talk.machine.receive_eof()
    assert talk.told() == []
    with pytest.raises(LocalProtocolError):
        talk.send(m.Query())
    return str(last.error)


# ---------------------------------------------------------------------- login


def test_login_answers_the_prompts() -> None:
    talk = Talk(NATIVE.with_parameters({"user": "op", "password": "s\xe9 cret"}))
    assert talk.send(m.Connect()) == b""
    assert talk.hear(b"Welcome to In-Sight(R) 7200 Session 3\r\nUser: ") == b"op\r\n"
    assert talk.hear(b"Password: ") == b"s\xe9 cret\r\n"
    assert talk.told() == []
    assert talk.hear(b"User Logged In\r\n") == b""
    assert (talk.told(), talk.machine.state) == ([WELCOME], State.CONNECTED)


@pytest.mark.parametrize("split", range(len(LOGIN) + 1))
def test_login_in_two_pieces_is_the_same(split: int) -> None:
    talk = Talk()
    talk.send(m.Connect())
    written = talk.hear(LOGIN[:split]) + talk.hear(LOGIN[split:])
    assert (written, talk.told()) == (b"admin\r\n\r\n", [WELCOME])


def test_login_greeting_before_connect_is_kept() -> None:
    talk = Talk()
    assert talk.hear(GREETING) == b""
    assert talk.send(m.Connect()) == b"admin\r\n"


def test_login_after_a_disconnect_without_a_session_goes_on() -> None:
    talk = Talk()
    talk.machine.send(m.Disconnect())
    talk.machine.send(m.Connect())
    assert (talk.hear(LOGIN), talk.told()) == (b"admin\r\n\r\n", [WELCOME])


@pytest.mark.parametrize(
    "said",
    [
        GREETING + b"Password: Invalid Password\r\n",
        GREETING + b"Invalid Password\r\n",
        GREETING + b"Password: \r\nUser: ",
        GREETING + b"User: ",
        GREETING + b"Password: Password: ",
    ],
)
def test_login_refused_is_reported_once_and_nothing_is_said_again(said: bytes) -> None:
    talk = Talk()
    talk.send(m.Connect())
    assert talk.hear(said).count(b"admin\r\n") == 1
    assert talk.told() == [REFUSED]
    assert NATIVE.code(-6, m.Connect).text == "the user or the password is wrong"
    assert talk.machine.data_to_send() == []


@pytest.mark.parametrize(
    "said",
    [
        b"220 ftp.example.org FTP server ready\r\n",
        b"HTTP/1.1 400 Bad Request\r\n",
        b"SSH-2.0-OpenSSH_9.6\r\n",
        GREETING + b"Password: Unknown\r\n",
        b"\xff\xfb\x01\xff\xfb\x03\r\n",
    ],
)
def test_login_with_something_else_fails(said: bytes) -> None:
    talk = Talk()
    talk.send(m.Connect())
    talk.hear(said)
    assert "the greeting or the login of an In-Sight camera was expected" in failure(talk)


def test_login_line_without_an_end_fails() -> None:
    talk = Talk()
    talk.send(m.Connect())
    talk.hear(b"Welcome to In-Sight " * 300)
    assert failure(talk) == f"a line of more than {MAX_LINE_BYTES} bytes came"


def test_login_flood_before_connect_fails() -> None:
    talk = Talk()
    talk.hear(b"x" * 2 * MAX_LINE_BYTES)
    assert talk.told() == []
    talk.hear(b"x")
    assert failure(talk) == f"more than {2 * MAX_LINE_BYTES} bytes came before the login"


def test_login_greeting_that_never_ends_fills_no_memory() -> None:
    talk = Talk()
    talk.send(m.Connect())
    for _ in range(500):
        talk.hear(b"Welcome to In-Sight\r\n\r\n" * 20)
    assert (talk.machine.buffered, talk.told()) == (0, [])
    assert talk.hear(b"User: ") == b"admin\r\n"


# ---------------------------------------------------------------------- requests


@each
def test_request_is_said_and_heard_to_the_byte(
    request_: m.Message, lines: list[tuple[bytes, bytes]], told: list[Event]
) -> None:
    talk = Talk(CELLS).logged_in()
    assert talk.send(request_) == lines[0][0] + b"\r\n"
    for (_, answer), (following, _) in pairwise(lines):
        assert talk.hear(answer) == following + b"\r\n"
    assert talk.hear(lines[-1][1]) == b""
    assert talk.told() == told
    assert talk.machine.buffered == 0


@each
def test_request_is_the_same_at_every_split_point(
    request_: m.Message, lines: list[tuple[bytes, bytes]], told: list[Event]
) -> None:
    heard = b"".join(answer for _, answer in lines)
    for split in range(len(heard)):
        talk = Talk(CELLS).logged_in()
        written = talk.send(request_) + talk.hear(heard[:split]) + talk.hear(heard[split:])
        assert written == b"".join(line + b"\r\n" for line, _ in lines)
        assert talk.told() == told


@each
def test_request_cut_by_the_end_says_what_was_left(
    request_: m.Message, lines: list[tuple[bytes, bytes]], told: list[Event]
) -> None:
    heard = b"".join(answer for _, answer in lines)
    for cut in range(len(heard)):
        talk = Talk(CELLS).logged_in()
        talk.send(request_)
        talk.hear(heard[:cut])
        buffered = talk.machine.buffered
        talk.machine.receive_eof()
        *before, last = talk.told()
        assert (before, last) == (told[: len(before)], LinkEnded(pending=buffered))
        assert talk.machine.state is State.CLOSED
        assert talk.hear(heard[cut:]) == b""
        assert talk.told() == []


@each
def test_request_trace_has_every_byte(
    request_: m.Message, lines: list[tuple[bytes, bytes]], told: list[Event]
) -> None:
    talk = Talk(CELLS).logged_in()
    talk.traced.clear()
    heard = b"".join(answer for _, answer in lines)
    written = talk.send(request_) + talk.hear(heard)
    spelled = dict.fromkeys(m.Sender, b"")
    for sender, frame in talk.traced:
        assert isinstance(frame, Frame)
        spelled[sender] += NATIVE.make_readable(sender, frame).data
    assert spelled == {m.Sender.CLIENT: written, m.Sender.CAMERA: heard}
    counters = talk.machine.counters
    assert counters.bytes_received == len(LOGIN) + len(heard)
    assert counters.bytes_sent == len(b"admin\r\n\r\n") + len(written)
    pieces = sum(sender is m.Sender.CAMERA for sender, _ in talk.traced)
    assert 0 < counters.frames_received - pieces < 8  # those of the login


def test_requests_are_sent_one_after_the_other() -> None:
    talk = Talk().logged_in()
    assert talk.send(m.Trigger()) == b"SW8\r\n"
    assert talk.send(m.Stop()) == b""
    assert talk.send(m.Query()) == b""
    assert talk.hear(b"1\r\n") == b"GJ\r\n"
    assert talk.hear(b"1\r\n7\r\n") == b"SO0\r\n"
    assert talk.hear(b"1\r\n") == b"GJ\r\n"
    talk.hear(b"1\r\n7\r\n")
    container = m.ResultContainer(application=7, data=b"{}", cells=())
    stopped, active = m.StopAnswer(code=1), m.QueryAnswer(code=1, application=7)
    assert talk.told() == [TRIGGERED, container, stopped, active]


def test_request_of_a_kind_that_is_open_is_refused_and_changes_nothing() -> None:
    talk = Talk().logged_in()
    talk.send(m.Query())
    with pytest.raises(LocalProtocolError, match="the answer to a Query is still owed"):
        talk.send(m.Query())
    talk.hear(b"1\r\n7\r\n")
    assert talk.send(m.Query()) == b"GJ\r\n"


def test_get_status_in_line_is_not_repeated() -> None:
    talk = Talk().logged_in()
    assert talk.send(m.Trigger()) == b"SW8\r\n"
    assert talk.send(m.GetStatus()) + talk.send(m.GetStatus()) == b""
    assert talk.hear(b"-1\r\n") == b"GO\r\n"
    assert talk.hear(b"1\r\n") == b""


def test_get_status_is_repeated_behind_one_that_was_sent() -> None:
    talk = Talk().logged_in()
    assert talk.send(m.GetStatus()) == b"GO\r\n"
    assert talk.send(m.GetStatus()) + talk.send(m.GetStatus()) == b""
    assert talk.hear(b"1\r\n") == b"GO\r\n"
    assert talk.hear(b"0\r\n") == b""


@pytest.mark.parametrize("name", ["a\r\nSO1", "\u65e5\u672c.job", "x" * MAX_LINE_BYTES, "a\0b"])
def test_load_file_that_cannot_be_sent_is_refused_and_changes_nothing(name: str) -> None:
    talk = Talk().logged_in()
    talk.send(m.Trigger())
    with pytest.raises(ConfigurationError, match="can be sent"):
        talk.send(m.LoadFile(name=name.encode()))
    assert talk.hear(b"-6\r\n") == b""
    assert talk.send(m.LoadFile(name=b"a.job")) == b"LFa.job\r\n"


@pytest.mark.parametrize("message", [m.StatusReport(status=Status(0)), Reply(line="GO", code=1)])
def test_send_what_a_client_does_not_say_is_refused(message: m.Message) -> None:
    with pytest.raises(LocalProtocolError, match="cannot be sent by the client in state connected"):
        Talk().logged_in().send(message)


def test_send_what_the_dialect_has_not_is_unsupported() -> None:
    with pytest.raises(UnsupportedError) as caught:
        Talk().logged_in().send(m.Reboot())
    assert str(caught.value) == (
        "dialect native has no Reboot; it can: switch, load_file, start_stop, result_codes, "
        "get_status, read_image"
    )


@pytest.mark.parametrize("message", [m.Query(), m.Trigger(), Command(line="GO")])
def test_send_without_a_session_is_refused(message: m.Message) -> None:
    talk = Talk()
    with pytest.raises(LocalProtocolError, match="in state idle"):
        talk.send(message)
    talk.send(m.Connect())
    with pytest.raises(LocalProtocolError, match="in state connecting"):
        talk.send(message)
    with pytest.raises(LocalProtocolError, match="Connect cannot be sent in state connecting"):
        talk.send(m.Connect())


def test_disconnect_ends_what_is_in_line() -> None:
    talk = Talk(with_cells("A1", "A2")).logged_in()
    talk.send(m.Trigger())
    talk.send(m.Query())
    assert talk.send(m.Disconnect()) == b""
    assert talk.machine.state is State.DISCONNECTED
    assert talk.hear(b"1\r\n1\r\n7\r\n") == b""  # its socket's way out is closed by now
    assert (talk.told(), talk.machine.buffered) == ([], 0)
    talk.machine.receive_eof()
    assert talk.told() == [LinkEnded(pending=0)]


def test_disconnect_during_the_login_ends_it() -> None:
    talk = Talk()
    talk.send(m.Connect())
    talk.send(m.Disconnect())
    assert (talk.hear(GREETING), talk.told()) == (b"", [])


def test_machine_plays_the_clients_side_of_tcp_only() -> None:
    for role, transport in ((Role.CAMERA, Transport.TCP), (Role.CLIENT, Transport.UDP)):
        with pytest.raises(ConfigurationError, match="the client's side of TCP only"):
            InSightMachine(NATIVE, role, transport, max_length=1)


# ---------------------------------------------------------------------- what nobody says

BROKEN: list[tuple[m.Message, bytes, str]] = [
    (m.GetStatus(), b"2\r\n", "'2' came, 0 (offline) or 1 (online) was expected"),
    (m.GetStatus(), b"\r\n", "'' came, 0 (offline)"),
    (m.GetStatus(), b"1\0\r\n", "'1\\x00' came, 0 (offline)"),
    (m.Query(), b"yes\r\n", "'yes' came, a status code was expected"),
    (m.Query(), b"\r\n", "'' came, a status code was expected"),
    (m.Query(), b"--1\r\n", "'--1' came, a status code"),
    (m.Query(), b"9" * 13 + b"\r\n", "a status code was expected"),
    (m.Query(), b"\xb2\r\n", "a status code was expected"),
    (m.Query(), b"1\r\n7a\r\n", "'7a' came, the id of a job was expected"),
    (m.Query(), b"1\r\n1000\r\n", "'1000' came, the id of a job was expected"),
    (m.Query(), b"1\r\n" + b"1" * 4000 + b"\r\n", "the id of a job was expected"),
    (m.Query(), b"x" * (MAX_LINE_BYTES + 2), f"a line of more than {MAX_LINE_BYTES} bytes came"),
    (m.Query(), b"1\n7\n" * MAX_LINE_BYTES, f"a line of more than {MAX_LINE_BYTES} bytes came"),
    (m.Query(), b"-2\r\n-2\r\n", "'-2' came, nothing was asked"),
    (m.Start(), b"1\r\n\r\n", "'' came, nothing was asked"),
    (m.ReadImage(), b"1\r\nbig\r\n", "'big' came, an image's size was expected"),
    (m.ReadImage(), b"1\r\n100\r\n\r\n", "'' came, hexadecimal digits of an image were due"),
    (m.ReadImage(), b"1\r\n100\r\n42 4D\r\n", "'42 4D' came, hexadecimal digits"),
    (m.ReadImage(), b"1\r\n100\r\n424\r\n", "'424' came, hexadecimal digits"),
    (m.ReadImage(), b"1\r\n100\r\n\xff\xb2\r\n", "'\xff\xb2' came, hexadecimal digits"),
    (m.ReadImage(), b"1\r\n100\r\n89504E470D0A\r\n", "an image came that is no bitmap"),
    (m.ReadImage(), b"1\r\n9\r\n424DFFFFFFFF\r\n", "a bitmap of 4294967295 bytes comes; at most"),
    (m.ReadImage(), b"1\r\n9\r\n424D00000000\r\n", "a bitmap of 0 bytes comes; at most"),
    (m.ReadImage(), b"1\r\n9\r\n424D0700000011\r\n22\r\n", "the image's checksum is '22'"),
    (m.ReadImage(), b"1\r\n9\r\n424D070000001122\r\n", "8 bytes of a bitmap of 7 bytes came"),
    (
        m.ReadImage(),
        b"1\r\n100\r\n" + DIGITS + b"\r\nBD5F\r\n",
        "the image's checksum is 'BD5F', BD5E was expected",
    ),
    (Command(line="EV a"), b"1\r\n4294967296\r\n", "a text of 4294967296 bytes comes; 0 to 1000"),
    (Command(line="EV a"), b"1\r\n-1\r\n", "a text of -1 bytes comes; 0 to 1000"),
    (Command(line="EV a"), b"1\r\n\r\n", "'' came, a length was expected"),
    (Command(line="EV a"), b"1\r\n2\r\nabc\r\n", "'c' came after a text of 2 bytes, its end was"),
]


@pytest.mark.parametrize(("request_", "heard", "text"), BROKEN)
def test_answer_that_is_none_ends_the_link(request_: m.Message, heard: bytes, text: str) -> None:
    talk = Talk().logged_in()
    talk.send(request_)
    talk.hear(heard)
    assert isinstance(talk.traced[-1][1], FrameError)
    assert text in failure(talk)


@pytest.mark.parametrize(("request_", "heard", "text"), BROKEN)
def test_answer_that_is_none_ends_the_link_byte_by_byte(
    request_: m.Message, heard: bytes, text: str
) -> None:
    talk = Talk().logged_in()
    talk.send(request_)
    for byte in heard:
        talk.hear(bytes([byte]))
    assert text in failure(talk)


def test_answer_nobody_asked_for_ends_the_link() -> None:
    talk = Talk().logged_in()
    talk.hear(b"1")
    assert talk.told() == []
    talk.hear(b"\r\n")
    assert failure(talk) == "'1' came, nothing was asked"


def test_failure_drops_what_was_in_line() -> None:
    talk = Talk().logged_in()
    talk.send(m.Trigger())
    talk.send(m.Query())
    assert talk.hear(b"garbage\r\n1\r\n") == b""
    assert "a status code was expected" in failure(talk)


def answers() -> st.SearchStrategy[bytes]:
    codes = [b"1", b"0", b"-2", b"7", b"50", b"4294967295", b""]
    login = [GREETING, b"User: ", b"Password: ", b"User Logged In", b"Invalid Password"]
    lines = st.sampled_from([*codes, *login, b"12.500", b"#ERR", DIGITS, b"BD5E"])
    ends = st.sampled_from([b"\r\n", b"", b"\n", b"\r", b"\0"])
    pieces = st.one_of(st.tuples(lines, ends).map(b"".join), st.binary(max_size=20))
    return st.lists(pieces, max_size=30).map(b"".join)


REQUESTS: list[m.Message] = [one for one, _, _ in CONVERSATIONS] + [m.Connect(), m.Disconnect()]


def converse(requests: list[m.Message], pieces: list[bytes], *, login: bool) -> tuple[Any, ...]:
    """Send and receive by turns; return all written bytes and events."""
    talk = Talk(CELLS, max_length=100)
    if login:
        talk.logged_in()
    else:
        talk.machine.send(m.Connect())
    told: list[Event] = []
    for request in requests:
        with contextlib.suppress(LocalProtocolError):
            talk.machine.send(request)
    written = talk.written()
    for piece in pieces:
        written += talk.hear(piece)
        told += talk.told()
        assert talk.machine.buffered <= MAX_LINE_BYTES + 100 + len(piece)
    assert all(not isinstance(one, LinkFailed) for one in told[:-1])
    talk.machine.receive_eof()
    # by their texts: errors have no equals
    return written, [repr(one) for one in told + talk.told()], talk.machine.state


@given(
    st.lists(st.sampled_from(REQUESTS), max_size=6),
    answers(),
    st.lists(st.integers(0, 600), max_size=8),
    st.booleans(),
)
def test_any_bytes_give_events_and_chunks_change_nothing(
    requests: list[m.Message], heard: bytes, cuts: list[int], login: bool
) -> None:
    points = sorted({0, len(heard), *(cut for cut in cuts if cut < len(heard))})
    pieces = [heard[begin:end] for begin, end in pairwise(points)]
    assert converse(requests, pieces, login=login) == converse(requests, [heard], login=login)


@given(st.binary(max_size=300))
def test_any_bytes_give_events_or_end_the_link(heard: bytes) -> None:
    for request in (m.GetStatus(), m.Query(), m.Trigger(), m.ReadImage(), Command(line="EV a")):
        converse([request], [heard], login=True)
    converse([], [heard], login=False)


def test_room_takes_what_a_link_writes_into_it() -> None:
    talk = Talk()
    talk.send(m.Connect())
    room = talk.machine.get_buffer()
    assert len(room) == MAX_READ_BYTES
    room[: len(LOGIN)] = LOGIN
    assert talk.machine.buffer_updated(len(LOGIN))
    assert talk.told() == [WELCOME]


# ---------------------------------------------------------------------- the dialect


def test_password_is_in_no_trace_and_no_repr() -> None:
    dialect = NATIVE.with_parameters({"user": "op", "password": "hunter2"})
    talk = Talk(dialect)
    talk.send(m.Connect())
    assert talk.hear(LOGIN) == b"op\r\nhunter2\r\n"
    assert "hunter2" not in repr([talk.traced, dialect])
    sent = [frame for sender, frame in talk.traced if sender is m.Sender.CLIENT]
    assert sent == [Frame(Piece.LINE, b"op"), Frame(Piece.PASSWORD, b"")]
    spelled = dialect.make_readable(m.Sender.CLIENT, Frame(Piece.PASSWORD, b""))
    assert spelled == (None, "password", {"text": "***"}, b"")


@pytest.mark.parametrize(
    ("sender", "frame", "spelled"),
    [
        (m.Sender.CLIENT, Frame(0, b"GO"), (None, "command", {"text": "GO"}, b"GO\r\n")),
        (m.Sender.CAMERA, Frame(0, b"\xb0"), (None, "line", {"text": "\xb0"}, b"\xb0\r\n")),
        (m.Sender.CAMERA, Frame(1, b"User: "), (None, "text", {"text": "User: "}, b"User: ")),
    ],
)
def test_spell_gives_text_and_bytes(sender: m.Sender, frame: Frame, spelled: object) -> None:
    assert NATIVE.make_readable(sender, frame) == spelled


@pytest.mark.parametrize(
    ("given_", "cells"),
    [
        ("", ()),
        ("A1", ("A001",)),
        (" b2 , Part.Name,,C12", ("B002", "Part.Name", "C012")),
        ("A1:B2", ("A001", "B001", "A002", "B002")),
        ("A1,A1", ("A001", "A001")),
    ],
)
def test_cells_of_a_url_are_named_as_commands_do(given_: str, cells: tuple[str, ...]) -> None:
    assert NATIVE.with_parameters({"cells": given_}).cells == cells


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"cells": "A400"}, "'A400' is no cell"),
        ({"cells": "B2:A1"}, "'B2:A1': the second cell lies left of the first"),
        ({"cells": "Part:B1"}, "'Part' is no cell"),
        ({"cells": "2x"}, "'2x' is no name of a cell"),
        ({"cells": "a b"}, "'a b' is no name of a cell"),
        ({"cells": "A0:Z38,A39:J39,K39"}, "cells: more than 1024"),
        ({"user": "\u65e5"}, "user: only Latin-1 without line ends can be sent"),
        ({"password": "secret\r\nSO0"}, "password: only Latin-1 without line ends can be sent"),
        ({"password": "secret" * 60}, "password: at most 255 bytes can be sent"),
    ],
)
def test_parameters_that_cannot_work_are_refused(parameters: dict[str, str], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        NATIVE.with_parameters(parameters)
    assert text in str(caught.value)
    assert "secret" not in str(caught.value)


def test_dialect_says_what_it_can() -> None:
    can = ["switch", "load_file", "start_stop", "result_codes", "get_status", "read_image"]
    assert NATIVE.capabilities.names == can
    assert (NATIVE.results_are_attributable, NATIVE.application_ids) == (True, range(1000))
    assert all(
        NATIVE.message_id(kind) == 0 for kind in (m.Connect, m.Trigger, m.Image, m.StopAnswer)
    )
    for kind in (m.GetClock, m.SetInput, m.SetSequenceNumber, m.ResetErrors, m.UnknownMessage):
        assert not NATIVE.has(kind)
    assert INSIGHT.dialect_groups(Transport.TCP) == [(NATIVE,)]


@pytest.mark.parametrize(
    ("request_", "code", "text", "verdict"),
    [
        (m.Trigger, -2, "not possible, or the camera is offline", "refused"),
        (m.LoadFile, -1, "the file name is missing", "refused"),
        (m.Start, -5, "accepted, but an operator or an input holds the camera offline", "refused"),
        (m.ReadImage, 0, "the camera does not know the command", "unknown"),
        (None, 1, "done", "done"),
        (None, -2, "not possible", "refused"),
        (None, -99, "a code that is not documented for this command", "refused"),
    ],
)
def test_code_depends_on_the_request(
    request_: type[m.Message] | None, code: int, text: str, verdict: str
) -> None:
    got = NATIVE.code(code, request_)
    assert (got.text, got.verdict.value) == (text, verdict)


def test_raw_request_is_a_command_of_ones_own() -> None:
    raw = NATIVE.raw_request("SI", b"A0028")
    assert raw == (Command(line="SIA0028"), Reply, True, True)
    for wrong in ("", "X", "RT", 0x40):
        with pytest.raises(UnsupportedError, match="begins with no command that is known: GO, SO"):
            NATIVE.raw_request(wrong, b"")
    with pytest.raises(ConfigurationError, match="only Latin-1 without line ends can be sent"):
        NATIVE.raw_request("GV", b"A001\r\nSO0")


def test_body_is_the_data_or_an_error() -> None:
    assert NATIVE.body(Reply(line="GVA001", code=1, data=b"M6")) == b"M6"
    from_camera = [
        (Reply(line="GVA001", code=-1), "GVA001: the camera answered -1: no such cell or name"),
        (Reply(line="SO2", code=-1), "SO2: the camera answered -1: neither 0 nor 1"),
        (Reply(line="EV", code=0), "EV: the camera answered 0: the camera does not know the"),
        (m.StopAnswer(code=1), "StopAnswer is no answer to a command"),
    ]
    for answer, text in from_camera:
        with pytest.raises(Exception, match=text):
            NATIVE.body(answer)


def test_command_that_is_none_cannot_be_made() -> None:
    with pytest.raises(ConfigurationError, match="it begins with none of GO, SO"):
        Command(line="HELO")
    with pytest.raises(ConfigurationError, match=f"at most {MAX_LINE_BYTES} bytes can be sent"):
        Command(line="EV " + "x" * MAX_LINE_BYTES)
