"""Each check of the suite for protocols finds the mistake that it is there for.

What is right is the Acme camera of ``docs/adding-a-camera.md``; each mistake is one thing changed.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, FrameError, LocalProtocolError
from smartcam.models import Capabilities, Status
from smartcam.protocols import (
    CodeMeaning,
    Frame,
    FramedDialect,
    Protocol,
    State,
    Transport,
    Verdict,
)
from smartcam.protocols import LineDialect as Dialect
from smartcam.protocols import LineMachine as Machine
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from smartcam.testing import Conversation, Received, Sent, WireSuite
from smartcam.testing._suites.protocols.words import MESSAGES_BY_CAPABILITY
from tests.testing.acme_page import acme, acme_is_known

__all__ = ["acme_is_known"]

ACME: Protocol = acme.ACME
LINES: Dialect = acme.LINES

CELLS = (m.CellValue("0", "12.5"), m.CellValue("1", "bolt"))
CONNECT = (Sent(m.Connect(), b"HELLO\n"), Received(b"ACME\n", (m.ConnectAnswer(version=1),)))
TALK = Conversation(
    name="a trigger",
    dialect="lines",
    parameters={"password": "f00l"},
    steps=(
        *CONNECT,
        Sent(m.GetStatus(), b"STATE\n"),
        Received(b"stop\n", (m.StatusReport(status=Status(0)),)),
        Sent(m.Query(), b"PROGRAM\n"),
        Received(b"7\n", (m.QueryAnswer(application=7),)),
        Sent(m.Trigger(), b"TRIGGER\n"),
        Received(b"12.5 bolt\n", (m.ResultContainer(data=b"12.5 bolt", cells=CELLS),)),
    ),
)
NONSENSE = Conversation(
    name="nonsense", dialect="lines", steps=(*CONNECT, Received(b"what?\n", (FrameError,)))
)


def fails(check: str, protocol: Protocol, **arguments: Any) -> str:
    """Return a check's failure for a protocol; there must be one."""
    members = {"protocol": protocol, "conversations": (TALK, NONSENSE)}
    suite = type("TestBad", (WireSuite,), members)
    try:
        getattr(suite(), check)(**arguments)
    except pytest.skip.Exception:
        raise AssertionError(f"{check} was skipped") from None
    except (AssertionError, pytest.fail.Exception, ConfigurationError) as error:
        return str(error)
    raise AssertionError(f"{check} found nothing")


def test_failure_says_what_was_expected_in_words() -> None:
    said = fails("test_protocol_describes_itself", changed(schemes={}))
    assert said.startswith("expected: protocol describes itself. ")
    assert "\nfound otherwise: schemes: expected at least one" in said


# ---------------------------------------------------------------------- dialects


def changed(**changes: Any) -> Protocol:
    return dataclasses.replace(ACME, **changes)


def bad_dialect(**changes: Any) -> Any:
    kind = type("BadDialect", (Dialect,), changes)
    return kind(name="lines", about="lines of text", source="this page", rows=LINES.rows)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"schemes": {}}, "at least one"),
        ({"schemes": {"Acme": Transport.TCP}}, "expected lower case"),
        ({"default_port": 0}, "1 to 65535"),
        ({"models": ("Acme1",)}, "expected upper case"),
        ({"dialects": {"other": LINES}}, "calls itself 'lines'"),
        ({"parameters": {"quirks": "a thing"}}, "is reserved"),
        ({"parameters": {"speed": ""}}, "expected a line"),
    ],
)
def test_protocol_that_no_url_can_name_fails(changes: dict[str, Any], said: str) -> None:
    assert said in fails("test_protocol_describes_itself", changed(**changes))


def test_protocol_that_is_not_installed_fails() -> None:
    said = fails("test_entry_point_gives_the_protocol", changed(name="nobody"))
    assert "is unknown" in said
    assert "Is the package installed" in said
    assert "gives Protocol" in fails("test_entry_point_gives_the_protocol", changed(models=()))


@pytest.mark.parametrize(
    ("detection", "said"),
    [
        ({Transport.UDP: ((LINES,),)}, "no scheme has"),
        ({Transport.TCP: ((),)}, "a group is empty"),
        ({Transport.TCP: ((HANDBOOK,),)}, "leaves out {'lines'}"),
        ({Transport.TCP: ((LINES,), (HANDBOOK,))}, "{'handbook'} is not a dialect"),
    ],
)
def test_dialect_that_is_not_tried_fails(detection: dict[Any, Any], said: str) -> None:
    assert said in fails("test_every_dialect_is_tried", changed(detection=detection))


def test_model_of_another_protocol_fails() -> None:
    assert "is Address(protocol='bvs'" in fails(
        "test_model_picks_the_protocol", changed(models=("BVS002C",))
    )


def can(**features: Any) -> Capabilities:
    return Capabilities(dialect="lines", **features)


BAD_DIALECTS: dict[str, list[tuple[dict[str, Any], str]]] = {
    "test_dialect_describes_itself": [
        ({"label": "x"}, "label"),
        ({"application_ids": range(0)}, "at least one"),
        ({"application_ids": range(0, 9, 2)}, "step of 1"),
        ({"results_are_attributable": 1}, "results_are_attributable: expected a bool"),
        ({"has_login": True}, "no parameter 'user'"),
        ({"capabilities": Capabilities(dialect="texts")}, "capabilities.dialect: 'texts'"),
    ],
    "test_dialect_has_what_a_client_needs": [
        ({"has": lambda self, kind: kind is not m.Query}, "has() is False for Query"),
        ({"capabilities": can()}, "neither comes by itself"),
    ],
    "test_capabilities_are_those_of_its_messages": [
        (
            {"capabilities": can(get_status=True, reboot=True)},
            "reboot is True, but has() is False for Reboot",
        ),
        ({"capabilities": can()}, "get_status is False, but has() is True for GetStatus"),
    ],
    "test_messages_have_ids_names_and_fields": [
        ({"message_label": lambda self, message: "it"}, "is 'it'"),
        ({"fields": lambda self, kind: ("speed",)}, "has {'speed'}"),
    ],
    "test_message_unknown_to_the_dialect_is_unsupported": [
        ({"message_id": lambda self, message: 0}, "but it has an id")
    ],
    "test_codes_mean_something": [
        ({"code": lambda *_: "done"}, "expected a CodeMeaning"),
        ({"code": lambda *_: CodeMeaning("", Verdict.DONE)}, "expected a text"),
        ({"code": lambda *_: CodeMeaning("no", Verdict.REFUSED)}, "no code says"),
        ({"capabilities": can(result_codes=True)}, "every code says done"),
    ],
    "test_any_frame_can_be_shown": [
        ({"make_readable": lambda *_: None}, "expected a ReadableFrame")
    ],
    "test_any_raw_request_is_taken_or_refused": [
        ({"raw_request": lambda *_: None}, "raw_request(0): None"),
        ({"body": lambda *_: "text"}, "expected bytes, got 'text'"),
    ],
    "test_unknown_quirk_is_a_mistake": [
        ({"with_quirks": lambda self, names: self}, "did not fail")
    ],
}


@pytest.mark.parametrize(
    ("check", "changes", "said"),
    [(check, *row) for check, rows in BAD_DIALECTS.items() for row in rows],
)
def test_bad_dialect_fails(check: str, changes: dict[str, Any], said: str) -> None:
    assert said in fails(check, ACME, dialect=bad_dialect(**changes))


def test_dialect_that_cannot_be_named_in_a_url_fails() -> None:
    for bad in (changed(name="other"), changed(schemes={"nobody": Transport.TCP})):
        assert fails("test_address_is_read_back", bad, dialect=LINES)


def test_frames_that_are_read_otherwise_fail() -> None:
    class Deaf(FramedDialect):
        def decode(self, sender: m.Sender, frame: Frame) -> m.Message:
            return m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)

    own = {
        one.name: getattr(HANDBOOK, one.name) for one in dataclasses.fields(HANDBOOK) if one.init
    }
    said = fails("test_framed_messages_are_read_back", ACME, dialect=Deaf(**own))
    assert "is read as UnknownMessage" in said


def test_table_of_abilities_has_every_capability() -> None:
    others = {"dialect", "unasked_status", "unasked_results", "result_codes"}
    assert {one.name for one in dataclasses.fields(Capabilities)} == {
        *MESSAGES_BY_CAPABILITY,
        *others,
    }


# ---------------------------------------------------------------------- machines


class Wordless(Machine):
    def data_to_send(self) -> list[bytes]:
        return [one.lower() for one in super().data_to_send()]


class ByDeliveries(Machine):
    """Takes each delivery for a line."""

    def receive_data(self, data: bytes) -> None:
        super().receive_data(data if data.endswith(b"\n") else data + b"\n")


class Fussy(Machine):
    """Drops what has two lines in it."""

    def receive_data(self, data: bytes) -> None:
        super().receive_data(b"" if data.count(b"\n") > 1 else data)


class Raising(Machine):
    def receive_data(self, data: bytes) -> None:
        data.decode()
        super().receive_data(data)


class Talkative(Machine):
    """Goes on after a failure."""

    def receive_data(self, data: bytes) -> None:
        if self.state is State.FAILED:
            self._held.add_ready((m.QueryAnswer(application=1),))
        super().receive_data(data)


class Nonsense(Machine):
    def _handle_line(self, line: str) -> None:
        try:
            super()._handle_line(line)
        except FrameError:
            self._held.add_ready((m.Trigger(),))


class Verbose(Machine):
    def _handle_line(self, line: str) -> None:
        try:
            super()._handle_line(line)
        except FrameError:
            raise FrameError("what? " * 200) from None


class EndsTwice(Machine):
    def receive_eof(self) -> None:
        if self.state is State.CLOSED:
            self.state = State.CONNECTED
        super().receive_eof()


class Unbounded(Machine):
    """Waits for the end of the line, however long it takes."""

    def receive_data(self, data: bytes) -> None:
        if b"\n" in data:
            super().receive_data(data)
        else:
            self._reader.feed(data)


class Hoarding(Unbounded):
    @property
    def unfinished_bytes(self) -> bytes:
        return b""


class KeepsFailed(Machine):
    def receive_data(self, data: bytes) -> None:
        super().receive_data(data)
        if self.state is State.FAILED:
            self._reader.feed(data)


class Willing(Machine):
    """Sends whatever the state is."""

    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        if isinstance(message, m.Query):
            state, self.state = self.state, State.CONNECTED
            super().send(message, answered=answered)
            self.state = state
        else:
            super().send(message, answered=answered)


class Touchy(Machine):
    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        if self.state is State.IDLE and isinstance(message, m.Disconnect):
            raise LocalProtocolError("not yet")
        super().send(message, answered=answered)


class Obliging(Machine):
    """Takes what it has not."""

    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        if not isinstance(message, m.Reboot):
            super().send(message, answered=answered)


class Impatient(Machine):
    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        asked, self._open_requests = self._open_requests, []
        try:
            super().send(message, answered=answered)
        finally:
            self._open_requests[:0] = asked


class Credulous(Machine):
    """Knows an answer by its looks."""

    def _handle_line(self, line: str) -> None:
        if line.isdecimal() and not self._open_requests:
            self._held.add_ready((m.QueryAnswer(application=int(line)),))
        else:
            super()._handle_line(line)


class Restless(Machine):
    """Speaks after Disconnect."""

    def send(
        self, message: m.Message, *, answered: bool | None = None, again: bool = False
    ) -> None:
        if not isinstance(message, m.Disconnect):
            super().send(message, answered=answered)


class Answering(Machine):
    """Says something by itself."""

    def receive_data(self, data: bytes) -> None:
        super().receive_data(data)
        if self.state is State.DISCONNECTED:
            self._outbox.append(b"BYE\n")


class WrongCandidates(Machine):
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.candidates = (HANDBOOK,)


class Sharing(Machine):
    def events(self) -> Any:
        shared = self.__dict__.setdefault("shared", [])
        shared += super().events()
        return shared


class Stuck(Machine):
    """Does not know that it failed."""

    def receive_data(self, data: bytes) -> None:
        super().receive_data(data)
        if self.state is State.FAILED:
            self.state = State.CONNECTED


class Uncounted(Machine):
    def receive_data(self, data: bytes) -> None:
        super().receive_data(data)
        self.counters.bytes_received = 0


class Untraced(Machine):
    def __init__(self, *args: Any, trace: Any = None, **options: Any) -> None:
        super().__init__(*args, **options)


class Indiscreet(Machine):
    def __init__(self, *args: Any, trace: Any = None, **options: Any) -> None:
        super().__init__(*args, trace=trace, **options)
        if trace is not None:
            trace(m.Sender.CLIENT, Frame(0, b"LOGIN f00l"))


ANYTHING = "test_any_bytes_tell_messages_or_one_failure"
MISTAKES = [
    ("test_conversation_goes_as_written", Wordless, "expected b'HELLO\\n' on the wire"),
    ("test_conversation_can_be_cut_anywhere", ByDeliveries, "expected events"),
    ("test_any_cutting_of_any_bytes_gives_the_same_events", Fussy, "in pieces"),
    (ANYTHING, Talkative, "which is the last"),
    (ANYTHING, Verbose, "a text of 1200"),
    (ANYTHING, Nonsense, "none of a camera's messages"),
    ("test_end_of_the_link_is_reported_once", EndsTwice, "which is the last"),
    ("test_what_waits_for_more_has_a_bound", Unbounded, "bytes are kept"),
    ("test_what_waits_for_more_has_a_bound", Hoarding, "the machine has grown by"),
    ("test_what_waits_for_more_has_a_bound", KeepsFailed, "of a link that failed"),
    ("test_request_before_the_session_is_refused", Willing, "Query() was taken"),
    ("test_disconnect_before_the_session_is_harmless", Touchy, "not yet"),
    ("test_message_unknown_to_the_dialect_is_refused", Obliging, "Reboot() was taken"),
    ("test_second_request_while_the_answer_is_owed_is_refused", Impatient, "Query() was taken"),
    ("test_answer_that_nobody_asked_for_is_not_reported", Credulous, "no request was open"),
    ("test_disconnect_is_the_last_word", Restless, "GetStatus() was taken"),
    ("test_disconnect_is_the_last_word", Answering, "it said b'BYE"),
    ("test_machine_says_what_it_is", WrongCandidates, "was not asked for"),
    ("test_machine_says_what_it_is", Sharing, "has returned an earlier list again"),
    ("test_bytes_are_counted", Uncounted, "bytes_received is 0"),
    ("test_trace_shows_what_is_said", Untraced, "was traced"),
    ("test_trace_shows_what_is_said", Indiscreet, "the trace has the password"),
]


@pytest.mark.parametrize(("check", "machine", "said"), MISTAKES)
def test_bad_machine_fails(check: str, machine: Any, said: str) -> None:
    argument = "stream" if "cut" in check or "end_of" in check else "conversation"
    try:
        found = fails(check, changed(machine=machine), **{argument: TALK})
    except LocalProtocolError as error:
        found = str(error)
    assert said in found


def test_machine_that_does_not_fail_fails() -> None:
    check = "test_state_follows_the_session"
    assert "it is State.CONNECTED" in fails(check, changed(machine=Stuck), conversation=NONSENSE)


def test_machine_that_raises_fails() -> None:
    talk = dataclasses.replace(TALK, steps=(*CONNECT, Received(b"\xff\n", (FrameError,))))
    with pytest.raises(UnicodeDecodeError):
        fails(ANYTHING, changed(machine=Raising), conversation=talk)


def test_every_check_of_the_wire_has_a_mistake() -> None:
    own = {name for name in dir(WireSuite) if name.startswith("test_")}
    text = Path(__file__).read_text(encoding="utf-8")
    assert [name for name in sorted(own) if f'"{name}"' not in text] == []
