"""Check a protocol's state machine as a link uses it, with the bytes of conversations."""
# ruff: noqa: S101 - these are tests, which are in the package so that others can run them

from __future__ import annotations

import dataclasses
import pickle
import tracemalloc
from typing import TYPE_CHECKING, Any, ClassVar

import pytest

from smartcam.exceptions import (
    ConfigurationError,
    LocalProtocolError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.protocols import Frame, LinkEnded, LinkFailed, State, Transport, Verdict
from smartcam.protocols import messages as m
from smartcam.protocols._inside import Counters, ResultBurst
from smartcam.testing._suites.protocols.conversations import Player, Received, Sent
from smartcam.testing._suites.protocols.dialects import check_described
from smartcam.testing._suites.protocols.parameters import SuiteBase
from smartcam.testing._suites.protocols.words import REQUESTS, make_example

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from hypothesis.strategies import DataObject

    from smartcam.protocols import LinkMachine
    from smartcam.protocols._inside import Event
    from smartcam.testing._suites.protocols.conversations import Conversation, Step

MAX_CUTS = 64
"""Largest number of offsets at which one delivery is cut in two."""

MAX_ERROR_CHARACTERS = 500
"""Largest number of characters of an error's text. It may show 64 bytes that the peer sent."""

FILLERS = (b"\0", b"A", b"1", b"\n", b"\xff")
"""Bytes that a camera repeats endlessly, one at a time."""

REFUSALS = (LocalProtocolError, UnsupportedError, ConfigurationError)

MAX_MESSAGES = 1000
"""Number of messages in endless bytes after which the check accepts them as valid messages."""

MAX_MEMORY_FACTOR = 2
"""Largest growth of a machine's memory with endless bytes: this times ``max_pending_bytes``."""


class MachineChecks(SuiteBase):
    """The checks of every protocol's machine, without a socket.

    Attributes:
        max_pending_bytes: largest number of bytes of incomplete messages that a machine may
            keep, if it accepts payloads of 4 KiB.
    """

    max_pending_bytes: ClassVar[int] = 1 << 16

    # ------------------------------------------------------------------ conversations

    def test_conversation_goes_as_written(self, conversation: Conversation) -> None:
        """Check that each request is the written bytes, and each answer the written message."""
        Player(self.protocol, conversation).play()
        kinds = [type(step.message) for step in conversation.steps if isinstance(step, Sent)]
        assert m.Connect in kinds, f"{conversation}: no step sends Connect"

    def test_conversation_can_be_cut_anywhere(self, stream: Conversation) -> None:
        """Check any cut of a conversation over TCP: pieces may come alone, or with the next."""
        for use_buffer in (True, False):
            for split in (_split_bytewise, _keep_whole):
                player = Player(self.protocol, stream)
                for step in stream.steps:
                    player.step(step, split(step), use_buffer=use_buffer)
        for step_index, step in enumerate(stream.steps):
            if isinstance(step, Received):
                size = len(step.data)
                for cut in range(1, size, 1 + size // MAX_CUTS):
                    player = Player(self.protocol, stream).play(step_index)
                    player.step(step, [step.data[:cut], step.data[cut:]])
        joined_stream = dataclasses.replace(stream, steps=_join_deliveries(stream.steps))
        Player(self.protocol, joined_stream).play()

    def test_any_cutting_of_any_bytes_gives_the_same_events(self, stream: Conversation) -> None:
        """Check any cut also with bytes that no camera sends."""
        from smartcam.testing._suites import strategies

        step_indices = range(len(stream.steps) + 1)
        deliveries = _received_data(stream)
        pieces = strategies.st.lists(strategies.noise(deliveries), max_size=3)

        def outcome(step_index: int, cut: Iterable[bytes]) -> tuple[list[Any], State]:
            player = Player(self.protocol, stream).play(step_index)
            events = [event for chunk in cut for event in player.feed_machine(chunk)]
            return events, player.machine.state

        def compare(step_index: int, whole: bytes, chunks: list[bytes]) -> None:
            first = outcome(step_index, [whole])
            for cut in (chunks, [bytes([byte]) for byte in whole]):
                other = outcome(step_index, cut)
                assert other == first, f"whole: {first}, in pieces: {other}"

        def check(data: DataObject) -> None:
            step_index = data.draw(strategies.st.sampled_from(step_indices), label="at step")
            whole = b"".join(data.draw(pieces, label="comes"))
            compare(step_index, whole, strategies.draw_pieces(data, whole))

        for step_index in step_indices:
            compare(step_index, b"".join(deliveries), deliveries)
        strategies.run_with_examples(check)

    # ------------------------------------------------------------------ anything

    def test_any_bytes_tell_messages_or_one_failure(self, conversation: Conversation) -> None:
        """Check that any bytes and requests give events, of which a failure is the last."""
        from smartcam.testing._suites import strategies

        step_indices = range(len(conversation.steps) + 1)
        any_bytes = strategies.noise(_received_data(conversation))
        dialect = conversation.group(self.protocol)[0]
        requests = strategies.st.sampled_from([make_example(kind, dialect) for kind in REQUESTS])
        actions = strategies.st.lists(strategies.st.one_of(any_bytes, requests), max_size=8)

        def check(data: DataObject) -> None:
            step_index = data.draw(strategies.st.sampled_from(step_indices), label="at step")
            player = Player(self.protocol, conversation).play(step_index)
            checker = _LinkChecker(player.machine)
            for action in data.draw(actions, label="then"):
                checker.apply(action)
            checker.close_link()

        strategies.run_with_examples(check)

    def test_end_of_the_link_is_reported_once(self, stream: Conversation) -> None:
        """Check an end anywhere, also within an answer; nothing is read after it."""
        for step_index, halves in _stop_points(stream):
            player = Player(self.protocol, stream).play(step_index)
            checker = _LinkChecker(player.machine)
            for half in halves:
                checker.apply(half)
            failed = checker.has_ended
            checker.close_link()
            assert failed or isinstance(checker.last, LinkEnded), (
                f"at step {step_index}: {checker.last}"
            )

    def test_what_waits_for_more_has_a_bound(self, conversation: Conversation) -> None:
        """Check that bytes without an end fail, are dropped, or are messages."""
        tracing = tracemalloc.is_tracing()
        for step_index, halves in _stop_points(conversation):
            for filler in FILLERS:
                player = Player(self.protocol, conversation).play(step_index)
                for half in halves:
                    player.feed_machine(half)
                if not tracing:
                    tracemalloc.start()
                try:
                    self._feed_endless_bytes(
                        player, filler, f"at step {step_index}, {filler!r} without an end"
                    )
                finally:
                    if not tracing:
                        tracemalloc.stop()

    def _feed_endless_bytes(self, player: Player, filler: bytes, where: str) -> None:
        machine, messages = player.machine, 0
        datagrams = machine.transport is Transport.UDP
        chunk = filler * (60_000 if datagrams else 4096)
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(4 * self.max_pending_bytes // len(chunk)):
            machine.receive_data(chunk)
            events = machine.events()
            failed = any(isinstance(event, LinkFailed) for event in events)
            messages += len(events)
            waiting = len(machine.unfinished_bytes)
            assert waiting <= self.max_pending_bytes, f"{where}: {waiting} bytes are kept"
            if failed:
                assert waiting == 0, f"{where}: {waiting} bytes are kept of a link that failed"
                break
            if datagrams:
                assert waiting == 0, f"{where}: {waiting} bytes of a datagram are kept"
            if messages > MAX_MESSAGES:
                break  # the endless bytes are valid messages
        memory_growth = tracemalloc.get_traced_memory()[0] - before
        assert memory_growth <= MAX_MEMORY_FACTOR * self.max_pending_bytes, (
            f"{where}: the machine has grown by {memory_growth} bytes"
        )

    # ------------------------------------------------------------------ requests

    def test_request_before_the_session_is_refused(self, conversation: Conversation) -> None:
        """Check that a request raises an error; then the conversation goes as written."""
        player = Player(self.protocol, conversation)
        dialect = player.machine.dialect
        for kind in REQUESTS:
            if kind not in {m.Connect, m.Disconnect}:
                check_refused(player, make_example(kind, dialect), "before the session")
        player.play()

    def test_disconnect_before_the_session_is_harmless(self, conversation: Conversation) -> None:
        """Check Disconnect as the first message: it ends a session that a dead client left."""
        player = Player(self.protocol, conversation)
        player.machine.send(m.Disconnect())
        player.take_output()
        player.play()

    def test_message_unknown_to_the_dialect_is_refused(self, conversation: Conversation) -> None:
        """Check the refusal at any time, and that the conversation then goes as written."""
        for step_index in range(len(conversation.steps) + 1):
            player = Player(self.protocol, conversation).play(step_index)
            dialect = player.machine.dialect
            for kind in REQUESTS:
                if not dialect.has(kind):
                    check_refused(player, make_example(kind, dialect), f"at step {step_index}")
            player.play()

    def test_second_request_while_the_answer_is_owed_is_refused(
        self, conversation: Conversation
    ) -> None:
        """Check the refusal, since answers do not name requests; status requests may overlap."""
        for step_index, step in enumerate(conversation.steps):
            if isinstance(step, Sent) and isinstance(step.message, m.Request):
                player = Player(self.protocol, conversation).play(step_index + 1)
                kind = type(step.message)
                answer = kind.answer
                if kind is m.Connect or answer is m.StatusReport:
                    continue
                if player.machine.dialect.answers(kind):
                    check_refused(
                        player, step.message, f"at step {step_index + 1}, an answer is owed"
                    )
                    player.play()

    def test_answer_that_nobody_asked_for_is_not_reported(self, conversation: Conversation) -> None:
        """Check that the machine drops the answer: a later request could take it for its own."""
        for step_index, answer, data in _unrequested_answers(conversation):
            player = Player(self.protocol, conversation).play(step_index)
            events = [event for chunk in data for event in player.feed_machine(chunk)]
            answers = [event for event in events if isinstance(event, answer)]
            assert not answers, (
                f"at step {step_index}, no request was open, but it reported {answers}"
            )

    def test_disconnect_is_the_last_word(self, conversation: Conversation) -> None:
        """Check that Disconnect can be sent in any session, and that nothing is sent after it."""
        for step_index in range(len(conversation.steps) + 1):
            player = Player(self.protocol, conversation).play(step_index)
            machine = player.machine
            if machine.state not in {State.CONNECTING, State.CONNECTED}:
                continue
            machine.send(m.Disconnect())
            player.take_output()
            later = [
                step.data for step in conversation.steps[step_index:] if isinstance(step, Received)
            ]
            for data in (b"", *later):
                machine.receive_data(data)
                machine.events()
                wire = player.take_output()
                assert not wire, f"at step {step_index}, after Disconnect it said {wire!r}"
                for kind in REQUESTS:
                    if kind not in {m.Connect, m.Disconnect}:
                        message = make_example(kind, machine.dialect)
                        check_refused(player, message, f"at step {step_index}, after Disconnect")

    # ------------------------------------------------------------------ self-description

    def test_machine_says_what_it_is(self, conversation: Conversation) -> None:
        """Check the attributes that a client uses, and that returned lists are not used again."""
        player = Player(self.protocol, conversation)
        machine, group = player.machine, player.group
        assert machine.state is State.IDLE, f"at first it is {machine.state}"
        assert machine.dialect in group, f"dialect: {machine.dialect} was not asked for"
        assert machine.candidates[0] in group, f"candidates: {machine.candidates} was not asked for"
        assert machine.transport is conversation.transport, f"transport: {machine.transport}"
        assert isinstance(machine.may_reply, bool), f"may_reply: no bool: {machine.may_reply!r}"
        assert isinstance(machine.counters, Counters), f"counters: {machine.counters!r}"
        unfinished = bytes(machine.unfinished_bytes)
        assert unfinished == b"", f"unfinished_bytes: {unfinished!r} before anything came"
        for take in (machine.events, machine.data_to_send):
            name = getattr(take, "__name__", "it")
            items: list[Any] = take()
            assert items == [], f"{name}() gave {items} before anything was said"
            items.append(None)
            assert take() == [], f"{name}() has returned an earlier list again, with its changes"
        player.play()
        machine.adopt(machine.candidates[0])
        assert list(machine.candidates) == [machine.dialect], f"adopt() left {machine.candidates}"

    def test_state_follows_the_session(self, conversation: Conversation) -> None:
        """Check the states after Connect, after its answer, and after a failure."""
        player = Player(self.protocol, conversation)
        machine = player.machine
        for step_index, step in enumerate(conversation.steps):
            player.play(step_index + 1)
            state, where = machine.state, f"after step {step_index}, {step!r:.200}"
            if isinstance(step, Sent):
                if isinstance(step.message, m.Connect):
                    allowed_states = {State.CONNECTING, State.CONNECTED}
                    assert state in allowed_states, f"{where}: it is {state}"
                continue
            for event in step.events:
                if isinstance(event, m.ConnectAnswer) and step.events[-1] is event:
                    code = machine.dialect.code(event.code, m.Connect)
                    if code.verdict is Verdict.DONE or not machine.dialect.fields(type(event)):
                        assert state is State.CONNECTED, f"{where}: it is {state}"
                if isinstance(event, type):  # a failure is written as its class
                    assert state is State.FAILED, f"{where}: it is {state}"

    def test_bytes_are_counted(self, conversation: Conversation) -> None:
        """Check the counter of bytes, which is in an attempt's error."""
        player = Player(self.protocol, conversation).play()
        received = sum(len(step.data) for step in conversation.steps if isinstance(step, Received))
        counted = player.machine.counters.bytes_received
        assert counted == received, f"counters.bytes_received is {counted}, {received} came"

    def test_trace_shows_what_is_said(self, conversation: Conversation) -> None:
        """Check that a trace has both sides' frames, in words, without the password."""
        traced: list[tuple[m.Sender, Frame | RemoteProtocolError]] = []
        player = Player(
            self.protocol, conversation, lambda sender, frame: traced.append((sender, frame))
        ).play()
        dialect = player.machine.dialect
        secret = conversation.parameters.get("password", "")
        for sender, frame in traced:
            if isinstance(frame, RemoteProtocolError):
                continue
            assert isinstance(frame, Frame), f"traced: expected a Frame, got {frame!r}"
            readable = check_described(dialect, sender, frame)
            trace_text = f"{frame!r} {readable!r}"
            assert not secret or secret not in trace_text, (
                f"the trace has the password: {trace_text}"
            )
        speakers = {
            sender
            for sender, frames in (
                (m.Sender.CLIENT, [step.wire for step in conversation.steps]),
                (m.Sender.CAMERA, [*_received_data(conversation)]),
            )
            if any(frames)
        }
        missing = speakers - {sender for sender, _ in traced}
        assert not missing, f"nothing of the {missing} was traced"


class _LinkChecker:
    """Feeds a machine and checks that a link can process its events."""

    def __init__(self, machine: LinkMachine) -> None:
        self.machine = machine
        self.last: Event | State | None = None
        if machine.state in {State.FAILED, State.CLOSED}:
            self.last = machine.state

    @property
    def has_ended(self) -> bool:
        """True if the machine reported the link's end."""
        return isinstance(self.last, (LinkFailed, LinkEnded, State))

    def apply(self, action: bytes | m.Message) -> None:
        """Pass bytes or a request to the machine."""
        if isinstance(action, m.Message):
            try:
                self.machine.send(action)
            except REFUSALS:
                pass
            else:
                harmless = not self.has_ended or isinstance(action, m.Disconnect)
                assert harmless, f"it took {action} after {self.last}"
        else:
            self.machine.receive_data(action)
        self._check_output()

    def close_link(self) -> None:
        """Close the link from the camera's side, then pass bytes; do both twice."""
        before = self.has_ended
        for _ in range(2):
            self.machine.receive_eof()
            self._check_output()
            self.machine.receive_data(b"too late\r\n\0")
            self._check_output()
        assert self.has_ended, "the link's end was not reported"
        allowed_states = {State.FAILED, State.CLOSED} if before else {State.CLOSED}
        assert self.machine.state in allowed_states, f"at the end it is {self.machine.state}"

    def _check_output(self) -> None:
        for event in self.machine.events():
            assert not self.has_ended, f"{event} after {self.last}, which is the last"
            self.last = event
            if isinstance(event, LinkFailed):
                self._check_error(event.error)
            elif isinstance(event, LinkEnded):
                assert event.pending >= 0, f"{event}: expected the number of bytes left"
            else:
                is_message = isinstance(event, (m.Report, m.UnknownMessage, ResultBurst))
                assert is_message, f"{event!r} is none of a camera's messages"
        for data in self.machine.data_to_send():
            assert isinstance(data, bytes), f"data_to_send() has {data!r}"

    def _check_error(self, error: RemoteProtocolError) -> None:
        assert isinstance(error, RemoteProtocolError), f"LinkFailed with {error!r}"
        assert str(error), f"{error!r} says nothing"
        length = len(str(error))
        assert length <= MAX_ERROR_CHARACTERS, f"a text of {length}: {error!r:.200}"
        copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own bytes
        assert str(copy) == str(error), f"{error!r} is {copy!r} after pickle"
        assert self.machine.state is State.FAILED, f"after {error!r} it is {self.machine.state}"


def check_refused(player: Player, message: m.Message, where: str) -> None:
    """Check that a machine refuses a message, and that nothing has changed.

    Raises:
        AssertionError: the machine takes it, or sends bytes or reports an event.
    """
    machine = player.machine
    state = machine.state
    try:
        machine.send(message)
    except (LocalProtocolError, UnsupportedError):
        pass
    else:
        pytest.fail(f"{where}: {message} was taken")
    events, wire = machine.events(), player.take_output()
    assert not events, f"{where}: {message} was refused, but it reported {events}"
    assert not wire, f"{where}: {message} was refused, but it said {wire!r}"
    assert machine.state is state, f"{where}: {message} was refused, but it is {machine.state}"


def _received_data(conversation: Conversation) -> list[bytes]:
    return [step.data for step in conversation.steps if isinstance(step, Received)]


def _split_bytewise(step: Step) -> list[bytes] | None:
    return [bytes([byte]) for byte in step.data] if isinstance(step, Received) else None


def _keep_whole(_: Step) -> None:
    return None


def _join_deliveries(steps: Sequence[Step]) -> list[Step]:
    """Return the steps with consecutive deliveries joined."""
    joined_steps: list[Step] = []
    for step in steps:
        last = joined_steps[-1] if joined_steps else None
        if isinstance(step, Received) and isinstance(last, Received) and not last.wire:
            joined_steps[-1] = Received(last.data + step.data, last.events + step.events, step.wire)
        else:
            joined_steps.append(step)
    return joined_steps


def _stop_points(conversation: Conversation) -> Iterator[tuple[int, list[bytes]]]:
    """Yield each index of a step, and for an answer also its first half in a list.

    The index after the last step is included unless the conversation ends with a failure.
    """
    failed = False
    for step_index, step in enumerate(conversation.steps):
        yield step_index, []
        if isinstance(step, Received):
            yield step_index, [step.data[: len(step.data) // 2]]
            failed = any(isinstance(event, type) for event in step.events)
    if not failed:
        yield len(conversation.steps), []


def _unrequested_answers(
    conversation: Conversation,
) -> Iterator[tuple[int, type[m.Message], list[bytes]]]:
    """Yield each request's index, its answer's type, and the deliveries up to the answer."""
    steps = conversation.steps
    for step_index, step in enumerate(steps):
        if not isinstance(step, Sent) or not isinstance(step.message, m.Request):
            continue
        answer = type(step.message).answer
        if answer is None or issubclass(answer, (m.StatusReport, m.ResultContainer)):
            continue
        data: list[bytes] = []
        for following in steps[step_index + 1 :]:
            if isinstance(following, Sent):
                break
            data.append(following.data)
            if any(isinstance(event, answer) for event in following.events):
                yield step_index, answer, data
                break
