"""The shapes that answers of lines may have, with smartcam's suite and with hostile peers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from smartcam.exceptions import FrameError, LocalProtocolError
from smartcam.models import Status
from smartcam.protocols import (
    CodeMeaning,
    LineCommand,
    LineDialect,
    LineMachine,
    LineReply,
    LineRow,
    LinkFailed,
    Protocol,
    Role,
    TicketedDialect,
    Transport,
    Verdict,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import refuse_line
from smartcam.registry import PROTOCOLS
from smartcam.testing import Conversation, Received, Sent, WireSuite

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER


def result(text: str) -> m.ResultContainer:
    return m.ResultContainer(data=text.encode("latin-1"))


def taken(text: str) -> tuple[m.Message, ...]:
    if text.startswith("ER"):
        return (m.TriggerAnswer(code=int(text[-2:])),)
    return m.TriggerAnswer(), result(text)


def connected(text: str) -> m.ConnectAnswer:
    return m.ConnectAnswer(version=1)


def query(text: str) -> m.QueryAnswer:
    return m.QueryAnswer(application=int(text.rpartition(",")[2]))


def status(text: str) -> m.StatusReport:
    return m.StatusReport(status=READY)


def first_word(line: str) -> tuple[str, str]:
    first, _, rest = line.partition(",")
    word = rest.partition(",")[0] if first == "ER" else first
    return (word if word.isalpha() else ""), line


def protocol(name: str, dialect: LineDialect) -> Protocol:
    return Protocol(
        name=name,
        schemes={name: Transport.TCP},
        default_port=4711,
        models=(name.upper(),),
        dialects={dialect.name: dialect},
        machine=LineMachine,
    )


CODES = {0: CodeMeaning("done", Verdict.DONE), 3: CodeMeaning("not now", Verdict.BUSY)}
COMMON: dict[str, Any] = {"about": "lines", "source": "this test"}
SEVERAL = LineDialect(
    name="several",
    rows=(
        LineRow(m.Connect, "VER", m.ConnectAnswer, connected, until=("OK",)),
        LineRow(m.Query, "SCENE", m.QueryAnswer, query),
        LineRow(m.Trigger, "MEASURE", m.ResultContainer, result, until=("OK", "ER")),
        LineRow(
            None, "by itself", m.StatusReport, {"BUSY": m.StatusReport(status=READY)}.__getitem__
        ),
    ),
    **COMMON,
)
ECHO = LineDialect(
    name="echo",
    rows=(
        LineRow(m.Connect, "RM", m.ConnectAnswer, connected),
        LineRow(m.GetStatus, "RS", m.StatusReport, status),
        LineRow(m.Query, "PR", m.QueryAnswer, query),
        LineRow(m.Trigger, "TA", m.ResultContainer, taken, echo="TA", extras=(m.TriggerAnswer,)),
        LineRow(m.EndTrigger, "TE", None, refuse_line),
    ),
    split=first_word,
    codes=CODES,
    **COMMON,
)
AT_ONCE = LineDialect(
    name="atonce",
    rows=(
        LineRow(m.Connect, "||{ticket}>TYPE", m.ConnectAnswer, connected),
        LineRow(m.GetStatus, "||{ticket}>STATE", m.StatusReport, status),
        LineRow(m.Query, "||{ticket}>JOB", m.QueryAnswer, query),
        LineRow(m.Trigger, "||{ticket}>READ", m.ResultContainer, result),
        LineRow(None, "by itself", m.ResultContainer, result, answer_word="0"),
    ),
    split=lambda line: (line[2 : line.index(">")], line[line.index(">") + 1 :]),
    tickets=range(1, 4),
    pipelined=True,
    **COMMON,
)


ROWS, ECHOES, IDS = (
    protocol(name, dialect)
    for name, dialect in (("several", SEVERAL), ("echo", ECHO), ("ids", AT_ONCE))
)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register these protocols by their names while a test runs."""
    for one in (ROWS, ECHOES, IDS):
        monkeypatch.setitem(PROTOCOLS._registered, one.name, one)


class TestSeveralLines(WireSuite):
    protocol = ROWS
    conversations = (
        Conversation(
            name="several lines, and a status between answers",
            dialect="several",
            steps=[
                Sent(m.Connect(), b"VER\n"),
                Received(b"Model 2\nOK\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"MEASURE\n"),
                Sent(m.Query(), b""),
                Received(b"BUSY\n", (m.StatusReport(status=READY),)),
                Received(b"1.5\n2.5\nOK\n", (result("1.5\n2.5\nOK"),), b"SCENE\n"),
                Received(b"7\n", (m.QueryAnswer(application=7),)),
            ],
        ),
    )


class TestEcho(WireSuite):
    protocol = ECHOES
    conversations = (
        Conversation(
            name="an echo, a result, a refusal",
            dialect="echo",
            steps=[
                Sent(m.Connect(), b"RM\n"),
                Received(b"RM,1\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"TA\n"),
                Sent(m.EndTrigger(), b"TE\n"),
                Received(b"TA\n", ()),
                Received(b"12.5,1\n", (m.TriggerAnswer(), result("12.5,1"))),
                Sent(m.Trigger(), b"TA\n"),
                Received(b"ER,TA,03\n", (m.TriggerAnswer(code=3),)),
            ],
        ),
        Conversation(
            name="a result in front of its echo is nobody's",
            dialect="echo",
            steps=[
                Sent(m.Connect(), b"RM\n"),
                Received(b"RM,1\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"TA\n"),
                Received(b"12.5,1\n", (FrameError,)),
            ],
        ),
    )


class TestIds(WireSuite):
    protocol = IDS
    conversations = (
        Conversation(
            name="answers in any order",
            dialect="atonce",
            steps=[
                Sent(m.Connect(), b"||1>TYPE\n"),
                Received(b"||1>Model\n", (m.ConnectAnswer(version=1),)),
                Sent(m.Trigger(), b"||2>READ\n"),
                Sent(m.Query(), b"||3>JOB\n"),
                Received(b"||0>somebody else's\n", (result("somebody else's"),)),
                Received(b"||3>5\n", (m.QueryAnswer(application=5),)),
                Received(b"||2>A\n", (result("A"),)),
                Sent(m.Trigger(), b"||1>READ\n"),
                Received(b"||2>A\n", (FrameError,)),
            ],
        ),
    )


def machine(dialect: LineDialect, *, max_length: int = 4096) -> LineMachine:
    """Return a machine in a session, whose answers to Connect have come."""
    made = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=max_length)
    made.send(m.Connect())
    answers = {"several": b"OK\n", "echo": b"RM,1\n", "atonce": b"||1>Model\n"}
    made.receive_data(answers[dialect.name])
    assert made.events() == [m.ConnectAnswer(version=1)]
    made.data_to_send()
    return made


def test_containers_say_whether_a_trigger_has_asked_for_them() -> None:
    made = machine(AT_ONCE)
    made.send(m.Trigger())
    made.receive_data(b"||0>older\n||2>own\n||0>newer\n")
    assert [one.requested for one in made.events()] == [False, True, False]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("dialect", "answer", "sent"),
    [(ECHO, b"RS,OK\n", [b"RS\n"]), (AT_ONCE, b"", [b"||2>STATE\n", b"||3>STATE\n"])],
)
def test_status_is_requested_again_behind_a_request_that_was_sent(
    dialect: LineDialect, answer: bytes, sent: list[bytes]
) -> None:
    made = machine(dialect)
    made.send(m.GetStatus())
    made.send(m.GetStatus())
    assert made.data_to_send() == sent
    if answer:
        made.send(m.GetStatus())  # one is queued
        made.receive_data(answer)
        assert made.data_to_send() == [b"RS\n"]
        made.receive_data(answer)
        assert made.data_to_send() == []
        assert len(made.events()) == 2


def test_answer_of_several_lines_has_a_bound() -> None:
    made = machine(SEVERAL, max_length=100)
    made.send(m.Trigger())
    made.receive_data(b"1.5\n" * 26)
    (failed,) = made.events()
    assert isinstance(failed, LinkFailed)
    assert "more than 100 bytes" in str(failed.error)


def test_ticket_of_an_open_request_is_not_given_again() -> None:
    made = machine(AT_ONCE)
    made.send(m.Trigger())
    for _ in range(5):
        made.send(m.Query())
        (said,) = made.data_to_send()[-1:]
        ticket = said[2:3]
        assert ticket != b"2" or b"READ" in said
        made.receive_data(b"||" + ticket + b">5\n")
        assert made.events() == [m.QueryAnswer(application=5)]


def test_second_request_of_a_kind_waits_for_the_first() -> None:
    made = machine(AT_ONCE)
    made.send(m.Trigger())
    with pytest.raises(LocalProtocolError, match="still owed"):
        made.send(m.Trigger())


@pytest.mark.parametrize(
    "data",
    [
        b"x000L000000008\r\n",
        b"1000M000000008\r\n",
        b"1000L00000000x\r\n",
        b"1000L000000005\r\n1000\r\n",
        b"1000L999999999\r\n",
        b"1000L000000008\r\n1001*x\r\n",
        b"1000L000000008\r\n1000abcd",
        b"1000L000000007\n\n1000*\r\n",
    ],
    ids=repr,
)
def test_no_frame_of_a_ticket_ends_the_link_at_once(data: bytes) -> None:
    dialect = TicketedDialect(
        name="frames",
        rows=(
            LineRow(m.Connect, "G?", m.ConnectAnswer, connected),
            LineRow(m.Query, "A?", m.QueryAnswer, query),
        ),
        **COMMON,
    )
    made = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=4096)
    made.send(m.Connect())
    made.receive_data(data)
    (failed,) = made.events()
    assert isinstance(failed, LinkFailed)
    assert isinstance(failed.error, FrameError)


@pytest.mark.parametrize(("tickets", "digits"), [(range(100, 1000), 5), (range(1), 12)])
def test_frames_have_as_many_digits_as_their_dialect_says(tickets: range, digits: int) -> None:
    dialect = TicketedDialect(
        name="frames",
        rows=(
            LineRow(m.Connect, "G?", m.ConnectAnswer, connected),
            LineRow(m.Query, "A?", m.QueryAnswer, query),
        ),
        tickets=tickets,
        digits=digits,
        **COMMON,
    )
    frame = dialect.frame(b"Model 1", str(tickets[0]), with_length=True)
    assert frame == b"%dL%0*d\r\n%dModel 1\r\n" % (
        *(tickets[0], digits, 9 + dialect.width, tickets[0]),
    )
    for size in range(len(frame) + 1):
        made = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=4096)
        made.send(m.Connect())
        for part in (frame[:size], frame[size:]):
            made.receive_data(part)
        assert made.events() == [m.ConnectAnswer(version=1)]
    for place in range(dialect.width + 1 + digits + 2):
        made = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=4096)
        made.send(m.Connect())
        made.receive_data(frame[:place] + b"x")  # which nothing can follow any more
        assert isinstance(made.events()[0], LinkFailed)


# ---------------------------------------------------------------------- lines of the user's own


OWN = (
    LineRow(m.Reboot, "RESTART", None, refuse_line),
    LineRow(LineCommand, "{line}", LineReply, lambda line: LineReply(data=line.encode())),
)


@pytest.mark.parametrize("line", ["MEASURE", "MEASURE 1", "MEASURE,2"])
def test_trigger_by_hand_is_the_clients_own(line: str) -> None:
    dialect = replace(SEVERAL, rows=(*SEVERAL.rows, *OWN), make="Acme")
    with pytest.raises(LocalProtocolError, match=r"Acme: .* call trigger\(\)"):
        dialect.raw_request(line, b"")
    assert dialect.raw_request("MEASURE?", b"").expects_answer


def test_line_of_ones_own_is_answered_in_the_shape_of_the_row_that_says_it() -> None:
    made = machine(replace(SEVERAL, rows=(*SEVERAL.rows, *OWN)))
    raw = made.dialect.raw_request("VER", b"")
    made.send(raw.message)
    made.send(m.Query())
    made.receive_data(b"Model 2\nOK\n7\n")
    assert made.events() == [LineReply(data=b"Model 2\nOK"), m.QueryAnswer(application=7)]


def test_line_of_ones_own_that_is_never_answered_is_not_waited_for() -> None:
    made = machine(replace(SEVERAL, rows=(*SEVERAL.rows, *OWN)))
    raw = made.dialect.raw_request("RESTART", b" NOW")
    assert not raw.expects_answer
    made.send(raw.message)
    made.send(m.Query())
    assert b"".join(made.data_to_send()) == b"RESTART NOW\nSCENE\n"
    made.receive_data(b"7\n")
    assert made.events() == [m.QueryAnswer(application=7)]
