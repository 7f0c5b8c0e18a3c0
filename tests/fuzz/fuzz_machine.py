"""Target ``machine``: one link's state machine, in either role, whatever is received and said.

Input: dialect, role, transport, policy, state and limit; then steps until the bytes end. A step is
bytes received as they are, a whole frame of a known message with any body, a message that this
side says, or the peer's end.

Beside it a twin that nobody traces, and into which a transport writes: it may give bursts.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from itertools import pairwise

from smartcam.exceptions import (
    FrameError,
    LocalProtocolError,
    MessageError,
    RemoteProtocolError,
    UnsupportedError,
)
from smartcam.protocols import (
    Frame,
    FramedDialect,
    LinkEnded,
    LinkFailed,
    Machine,
    Role,
    State,
    Transport,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import POLICIES, Event, Policy
from tests.fuzz.fuzz_framing import write
from tests.fuzz.fuzz_input import Choices, check_decoding
from tests.machines import DIALECTS, EXAMPLES, TRANSITIONS, one_by_one
from tests.protocols.frame_times import small_reads

OWN_POLICY = None
CHOSEN_POLICIES = (
    OWN_POLICY,
    Policy(fatal=(FrameError,), exact_length=True),  # of an emulator that hangs up
    Policy(fatal=(), exact_length=False),
    Policy(
        fatal=(), exact_length=True, reports_malformed=True
    ),  # of a camera that answers with codes
)
ANSWERED = (None, True, False)
ENDED = {State.FAILED, State.CLOSED}


@dataclass
class Link:
    """A machine with everything that went through it."""

    machine: Machine
    twin: Machine
    policy: Policy
    limit: int
    traced: list[tuple[m.Sender, Frame | RemoteProtocolError]]
    state: State  # what the table of transitions makes of it
    messages: list[m.Message] = field(default_factory=list)  # what it takes
    events: list[Event] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    first: list[tuple[m.Message, bool | None]] = field(default_factory=list)
    looked_at: int = 0  # of what was traced
    long_bodies: int = 0
    owed: set[int] = field(default_factory=set)  # ids of answers that were asked for
    talked: bool = False  # something was said after something had been received

    def receive(self, data: bytes) -> None:
        """Give the machine bytes, and look at what it made of them."""
        machine = self.machine
        ended = machine.state in ENDED
        counted = machine.counters.bytes_received, machine.counters.frames_received
        machine.receive_data(data)
        fresh = one_by_one(machine.events())
        self.events += fresh
        self.follow()
        if machine.role is Role.CLIENT:
            self.settle(fresh)
        if ended:
            assert not fresh, "an event after the end"
            assert counted == (machine.counters.bytes_received, machine.counters.frames_received)
        else:
            self.chunks.append(data)
        room = machine.dialect.header.size + max(self.limit, 1)
        assert machine.buffered < (room if machine.transport is Transport.TCP else 1)
        if fresh:
            self.check_end()
        while data and machine.transport is Transport.TCP:
            data = data[write(self.twin, data) :]
        if machine.transport is Transport.UDP:
            self.twin.receive_data(data)
        self.check_twin(fresh)

    def check_twin(self, fresh: list[Event]) -> None:
        """The twin has made the same of it."""
        machine, twin = self.machine, self.twin
        assert plain(one_by_one(twin.events())) == plain(fresh)
        assert (twin.state, twin.buffered) == (machine.state, machine.buffered)
        counted = dataclasses.replace(twin.counters)
        if machine.state is State.FAILED:  # nothing is counted behind what broke it
            counted.bytes_received = machine.counters.bytes_received
        assert counted == machine.counters

    def follow(self) -> None:
        """Take the frames that came through the table of transitions: the machine must agree."""
        fresh, self.looked_at = self.traced[self.looked_at :], len(self.traced)
        for (_, what), (_, behind) in pairwise([*fresh, (None, None)]):
            if isinstance(what, Frame):
                refused = isinstance(behind, MessageError)
                assert refused == (not self.takes(what)), f"{what} in {self.state}"
        machine = self.machine
        assert machine.state is (State.FAILED if machine.error is not None else self.state)
        assert machine.counters.long_bodies == self.long_bodies

    def takes(self, frame: Frame) -> bool:
        """Return True if a frame may come now; then it counts as having come."""
        dialect, sender = self.machine.dialect, self.machine.role.receives
        message = check_decoding(dialect, sender, frame)
        surplus = dialect.surplus(sender, frame)  # less than 0 where a code comes alone
        if self.policy.reports_malformed and (message is None or surplus):
            message = m.MalformedMessage(message_id=frame.message_id, payload=frame.payload)
            surplus = 0
        surplus = max(surplus, 0)
        if message is None or (surplus and self.policy.exact_length):
            return False
        following = TRANSITIONS.get((self.state, sender, type(message)))
        if following is None:
            return False
        self.state = following
        self.long_bodies += surplus > 0
        self.messages.append(message)
        return True

    def settle(self, fresh: list[Event]) -> None:
        """An answer comes only where one is owed, and pays for it."""
        for event in fresh:
            if isinstance(event, m.Message):
                answers = self.machine.dialect.message_id(event)
                unasked = (
                    *(m.StatusReport, m.ResultContainer, m.DisconnectAnswer),
                    m.UnknownMessage,
                )
                assert answers in self.owed or isinstance(event, unasked), f"unasked: {event}"
                self.owed.discard(answers)

    def say(self, message: m.Message, answered: bool | None) -> None:
        """Have the machine say something; a refusal must change nothing."""
        machine = self.machine
        counters = machine.counters
        before = (machine.state, counters.frames_sent, counters.bytes_sent, len(self.traced))
        try:
            machine.send(message, answered=answered)
        except (LocalProtocolError, UnsupportedError):
            after = (machine.state, counters.frames_sent, counters.bytes_sent, len(self.traced))
            assert after == before
            assert machine.data_to_send() == []
        else:
            assert machine.data_to_send() == [machine.dialect.encode(message)]
            self.twin.send(message, answered=answered)
            self.talked = self.talked or bool(self.chunks)
            self.state = TRANSITIONS[self.state, machine.role.sends, type(message)]
            self.looked_at = len(self.traced)
            self.first.append((message, answered))
            owed = answer_to(message, answered, machine.dialect)
            if owed is not None and machine.role is Role.CLIENT:
                assert owed not in self.owed, "two answers of one id are owed"
                self.owed.add(owed)
        assert machine.events() == []

    def end(self) -> None:
        """Tell the machine that the peer closed the link."""
        ended, pending = self.machine.state in ENDED, self.machine.buffered
        self.machine.receive_eof()
        fresh = self.machine.events()
        assert fresh == ([] if ended else [LinkEnded(pending=pending)])
        self.events += fresh
        self.state = self.machine.state
        self.check_end()
        self.twin.receive_eof()
        self.check_twin(fresh)

    def check_end(self) -> None:
        """An end comes once, last, and agrees with the state."""
        ends = [one for one in self.events if isinstance(one, (LinkFailed, LinkEnded))]
        assert ends == self.events[len(self.events) - len(ends) :]
        assert len(ends) <= 1
        failed = [one.error for one in ends if isinstance(one, LinkFailed)]
        assert failed == ([] if self.machine.error is None else [self.machine.error])
        assert (self.machine.state is State.FAILED) == bool(failed)
        assert all(isinstance(error, self.policy.fatal) for error in failed)


def check(data: bytes) -> None:
    """Drive a machine through the steps of ``data``."""
    with small_reads():
        check_machine(data)


def check_machine(data: bytes) -> None:
    """As :func:`check`."""
    choices = Choices(data)
    dialect, role, transport = (
        choices.pick(DIALECTS),
        choices.pick(tuple(Role)),
        choices.pick(tuple(Transport)),
    )
    policy, state = choices.pick(CHOSEN_POLICIES), choices.pick(tuple(State)[:4])
    limit = choices.byte()
    link = make(dialect, role, transport, policy, state, limit)
    while choices:
        step(link, choices)
    link.check_end()
    check_account(link)
    check_cutting(link, policy, state)


def make(
    dialect: FramedDialect,
    role: Role,
    transport: Transport,
    policy: Policy | None,
    state: State,
    limit: int,
) -> Link:
    """Return a link whose machine has been put into ``state``."""
    traced: list[tuple[m.Sender, Frame | RemoteProtocolError]] = []
    machine = Machine(
        dialect,
        role,
        transport,
        max_length=limit,
        policy=policy,
        trace=lambda sender, what: traced.append((sender, what)),
    )
    twin = Machine(dialect, role, transport, max_length=limit, policy=policy)
    machine.state = twin.state = state
    return Link(machine, twin, policy or POLICIES[role, transport], limit, traced, state)


def answer_to(message: m.Message, answered: bool | None, dialect: FramedDialect) -> int | None:
    """Return the id of the answer that a request asks for, None where none is expected."""
    if answered is None:
        answered = isinstance(message, m.UnknownMessage) or (
            isinstance(message, m.Request) and dialect.answers(type(message))
        )
    return dialect.message_id(message) if answered else None


def step(link: Link, choices: Choices) -> None:
    """Take one step."""
    dialect = link.machine.dialect
    match choices.byte() % 8:
        case 0 | 1:
            link.receive(choices.take(choices.byte()))
        case 2 | 3:
            row = choices.pick(dialect.table)
            body = choices.take(choices.byte() % 64)
            link.receive(dialect.header.pack(row.message_id, len(body)) + body)
        case 4:
            message_id, body = choices.byte(), choices.take(choices.byte() % 16)
            frame = dialect.header.pack(message_id, len(body)) + body
            cut = choices.byte() % (len(frame) + 1)
            link.receive(frame[:cut])
            link.receive(frame[cut:])
        case 5 | 6:
            link.say(choices.pick(EXAMPLES), choices.pick(ANSWERED))
        case _:
            link.end()


def check_account(link: Link) -> None:
    """Every frame has one fate, and so has everything that makes no frame."""
    machine, counters = link.machine, link.machine.counters
    received = [what for sender, what in link.traced if sender is machine.role.receives]
    frames = [what for what in received if isinstance(what, Frame)]
    errors = [what for what in received if not isinstance(what, Frame)]
    messages = [event for event in link.events if isinstance(event, m.Message)]
    waiting = iter(link.messages)
    assert all(message in waiting for message in messages), "an event that no frame said"
    assert counters.frames_received == len(frames)
    assert counters.bytes_received == sum(map(len, link.chunks))
    assert counters.frames_sent == len(link.traced) - len(received)
    assert counters.ignored_frames + (machine.error is not None) == len(errors)
    if machine.transport is Transport.UDP:
        units = len(link.chunks)  # a datagram is a frame, or it is an error
    else:
        units = len(frames) + sum(isinstance(error, FrameError) for error in errors)
    assert units == len(messages) + counters.unexpected_messages + len(errors)


def check_cutting(link: Link, policy: Policy | None, state: State) -> None:
    """The same bytes in one piece make the same of the link."""
    machine = link.machine
    if link.talked or machine.transport is Transport.UDP or machine.state is State.CLOSED:
        return
    # without a magic number, what is dropped is what was there
    if not machine.dialect.header.magic and FrameError not in link.policy.fatal:
        return
    whole = make(machine.dialect, machine.role, machine.transport, policy, state, link.limit)
    for message, answered in link.first:
        whole.say(message, answered)
    whole.receive(b"".join(link.chunks))
    assert plain(whole.events) == plain(link.events)
    assert whole.machine.state is machine.state
    assert whole.machine.buffered == machine.buffered


def plain(events: list[Event]) -> list[object]:
    """Return events without what may depend on how the bytes were cut: an error's text."""
    return [type(one.error) if isinstance(one, LinkFailed) else one for one in events]
