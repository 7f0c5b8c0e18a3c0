"""Client core, camera core and the emulated device in any history, against a plain model.

``HYPOTHESIS_PROFILE=nightly`` runs histories three times as long, and twenty times as many of them.

The rules put words, noise and time into two wires and carry what is in them; the model
(``core_model``, ``camera_model``) says what each side must hear, say and count. No I/O, no clock.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from smartcam.models import Status
from smartcam.protocols import Role, Transport
from smartcam.protocols import messages as m
from tests.machines import EXAMPLES
from tests.protocols.camera_model import PROGRAMS, Options
from tests.protocols.core_model import (
    ENDED,
    IDS,
    INSPECTIONS,
    LIMIT,
    MISFITS,
    NOISE,
    ORDERS,
    PAYLOADS,
    SESSIONS,
    SETTINGS,
    SURPRISES,
    TIMES,
    WIRES,
    WORK,
    noise,
    packed,
)
from tests.protocols.core_station import Line, Station, Way, refused

PROFILE = settings()
IS_NIGHTLY = PROFILE.max_examples >= settings.get_profile("nightly").max_examples
RUN = settings(
    max_examples=12,
    stateful_step_count=150 if IS_NIGHTLY else 50,
    suppress_health_check=[HealthCheck.too_slow],
)
"""Short runs: behind its first ten histories Hypothesis varies old ones rather than make new."""
RUNS = 40 if IS_NIGHTLY else max(1, PROFILE.max_examples // 25)
MAX_LINES = 4
A_WHILE = 500  # milliseconds: longer than a reboot and every load

OPERATED = frozenset({"operator", "faults", "reboot"})
CROWDED = frozenset({"newcomer", "hang up", "misuse", "reboot"})
BROKEN = frozenset({"raw", "surprises", "noise", "loss"})
KINDS = {
    "clean": frozenset[str](),
    "operated": OPERATED,
    "crowded": CROWDED,
    "broken": BROKEN,
    "wild": OPERATED | CROWDED | BROKEN,
}
"""Events in a history, beside a client that asks and a camera that answers."""

FAMILIES = {"magic": ("handbook", "thesis"), "b16": ("b16", "b16 with quirk code"), "bid": ("bid",)}
"""Dialects that share their tests."""
assert {name for names in FAMILIES.values() for name in names} == {*WIRES}

_THERE_AND_BACK: tuple[Way, ...] = ("up", "down")
_WAYS: st.SearchStrategy[Way] = st.sampled_from(_THERE_AND_BACK)
_KEEP = st.none() | st.integers(0, 40)
_OFFSETS = st.just(0) | st.integers(0, 24)
_WHICH = st.integers(0, MAX_LINES - 1)

_Rule = TypeVar("_Rule", bound="Callable[..., None]")


def only_with(feature: str) -> Callable[[_Rule], _Rule]:
    """Run a rule in histories that have the feature."""
    return precondition(lambda self: feature in self.features)


# ---------------------------------------------------------------------- the machine of rules


class Cores(RuleBasedStateMachine):
    """Common parts of TCP and UDP: words, operators, time, the way from a wire to the device."""

    transport: Transport
    features: frozenset[str]
    dialects: tuple[str, ...]

    @initialize(
        which=st.integers(0, 1),
        options=st.builds(
            Options,
            switch_while_running=st.sampled_from(["refuse", "ignore", "allow"]),
            switch_answer=st.sampled_from(["after_status", "before_status"]),
            waiting_before_result=st.booleans(),
            busy_while_processing=st.booleans(),
            disconnect_answer=st.sampled_from(["code", "silent"]),
            bad_message=st.sampled_from(["code", "ignore"]),
            push_status=st.booleans(),
        ),
        cuts=st.just([1 << 16]) | st.lists(st.integers(1, 40), min_size=1),
        keep=_KEEP,
        warm=st.booleans(),
    )
    def switch_on(
        self, which: int, options: Options, cuts: list[int], keep: int | None, warm: bool
    ) -> None:
        dialect = self.dialects[which % len(self.dialects)]
        self.dialect = dialect
        self.wire = WIRES[dialect]
        self.cuts = itertools.cycle(cuts)  # how a stream comes in pieces where nobody looks
        self.keep = keep  # what a link that the camera drops still delivers, bytes
        self.tells = self.wire.is_bid and options.bad_message == "code"
        self.station = Station(dialect, options, self.drop)
        self.lines = self.station.lines
        self.lines.append(self.fresh_line())
        if warm:
            self.begin(self.lines[0])

    def fresh_line(self) -> Line:
        return Line(self.dialect, self.transport, tells=self.tells)

    def line(self, which: int) -> Line:
        """Return one of the lines, the newest for 0."""
        return self.lines[-1 - which % len(self.lines)]

    # ------------------------------------------------------------------ the client's words

    @rule(which=_WHICH, message=SESSIONS, promptly=st.booleans())
    def say_session(self, which: int, message: m.Message, promptly: bool) -> None:
        line = self.line(which)
        if self.may_connect(line) or isinstance(message, m.Disconnect):
            self.say(line, message, promptly)

    @rule(which=_WHICH, message=ORDERS | SETTINGS, promptly=st.booleans())
    def say_order(self, which: int, message: m.Message, promptly: bool) -> None:
        self.say(self.line(which), message, promptly)

    @rule(which=_WHICH, orders=WORK, milliseconds=TIMES)
    def work(self, which: int, orders: list[m.Message], milliseconds: int) -> None:
        """A good client: a session if there is none, and some orders at once."""
        line = self.line(which)
        if line.client_end.phase in {"idle", "disconnected"} and self.may_connect(line):
            line.say(m.Connect())
        for message in orders:
            line.say(message)
        self.carry(line)
        self.station.pass_time(milliseconds)
        self.carry(line)

    @rule(turns=st.lists(st.tuples(INSPECTIONS, TIMES), min_size=1, max_size=4))
    def inspect(self, turns: list[tuple[list[m.Message], int]]) -> None:
        """The client that has the session triggers, some time passes, again and again."""
        line = self.station.served or self.line(0)
        for orders, milliseconds in turns:
            for message in orders:
                line.say(message)
            self.carry(line)
            self.station.pass_time(milliseconds)

    @only_with("raw")
    @rule(
        which=_WHICH,
        message_id=st.sampled_from([*IDS, 0x77, 0xFFFFFFFF]),
        payload=st.just(b"") | PAYLOADS,
        answered=st.sampled_from([None, True, False]),
        promptly=st.booleans(),
    )
    def say_raw(
        self, which: int, message_id: int, payload: bytes, answered: bool | None, promptly: bool
    ) -> None:
        line = self.line(which)
        if self.harmless(line, (message_id, payload)) and self.keeps_frames(payload):
            message = m.UnknownMessage(message_id=message_id, payload=payload)
            self.say(line, message, promptly, answered)

    def keeps_frames(self, payload: bytes) -> bool:
        """Return True if the camera finds the next frame after this one.

        Without a magic number it does not behind one that is too long, and what it takes for
        frames then could be a Connect.
        """
        return bool(self.wire.magic) or len(payload) <= LIMIT

    def say(
        self, line: Line, message: m.Message, promptly: bool, answered: bool | None = None
    ) -> None:
        line.say(message, answered)
        if promptly:
            self.carry(line)

    @only_with("misuse")
    @rule(which=_WHICH, role=st.sampled_from(Role), message=st.sampled_from(MISFITS + EXAMPLES))
    def misuse(self, which: int, role: Role, message: m.Message) -> None:
        """Send a message that does not fit, is the other side's, or is forbidden now."""
        line = self.line(which)
        machine = line.client if role is Role.CLIENT else line.camera
        end = line.client_end if role is Role.CLIENT else line.camera_end
        ours = getattr(message, "sender", role.sends) is role.sends
        if message in MISFITS or not (ours and end.may_say(message)):
            refused(machine, message)

    # ------------------------------------------------------------------ the operator and time

    @rule(milliseconds=TIMES)
    def pass_time(self, milliseconds: int) -> None:
        self.station.pass_time(milliseconds)

    @only_with("operator")
    @rule(action=st.sampled_from(["start", "trigger", "stop"]))
    def operate(self, action: str) -> None:
        self.station.operate(action)

    @only_with("operator")
    @rule(application=st.sampled_from(sorted(PROGRAMS)), running=st.booleans())
    def operate_switch(self, application: int, running: bool) -> None:
        self.station.operate("switch_application", application, running=running)

    @only_with("faults")
    @rule(what=st.sampled_from([Status.OVERHEAT, Status.SYSTEM_ERROR]), on=st.booleans())
    def operate_condition(self, what: Status, on: bool) -> None:
        self.station.operate("set_condition", what, on)

    @only_with("faults")
    @rule(endian=st.sampled_from([0, 1, 2]))
    def operate_endian(self, endian: int) -> None:
        self.station.operate("set_endian", endian)

    @only_with("reboot")
    @rule(client=st.booleans())
    def reboot(self, client: bool) -> None:
        """By the client that has the session, or by the power switch."""
        if client and self.station.served is not None:
            self.say(self.station.served, m.Reboot(), promptly=True)
        else:
            self.station.operate("reboot")
            self.station.go_down()

    @only_with("surprises")
    @rule(which=_WHICH, what=SURPRISES, promptly=st.booleans())
    def surprise(self, which: int, what: Any, promptly: bool) -> None:
        """The camera sends unasked, unknown or too long messages."""
        line = self.line(which)
        line.pipes["down"].put(noise(self.wire, what))
        line.pipes["down"].disturbed = True
        if promptly:
            self.carry(line)

    # ------------------------------------------------------------------ wires

    @only_with("newcomer")
    @precondition(lambda self: len(self.lines) < MAX_LINES and not self.station.device.rebooting)
    @rule(warm=st.booleans())
    def another_line(self, warm: bool) -> None:
        self.lines.append(self.fresh_line())
        if warm:
            self.begin(self.lines[-1])

    @rule(which=_WHICH)
    def carry_everything(self, which: int) -> None:
        self.carry(self.line(which))

    def carry(self, line: Line) -> None:
        raise NotImplementedError

    def drop(self, line: Line) -> None:
        """The camera lets go of a link."""
        raise NotImplementedError

    def may_connect(self, line: Line) -> bool:
        """Return True if Connect may be put on the wire now."""
        raise NotImplementedError

    def harmless(self, line: Line, what: Any) -> bool:
        """Return True if the step connects only where it may, and reboots nothing by mistake."""
        allowed = {0x01: self.may_connect(line), 0x43: "reboot" in self.features}
        return all(
            may or not noise(self.wire, what).endswith(packed(self.wire, (message_id, b"")))
            for message_id, may in allowed.items()
        )

    # ------------------------------------------------------------------ what must hold

    @invariant()
    def ends_agree(self) -> None:
        for line in self.lines:
            line.check()

    @invariant()
    def device_agrees(self) -> None:
        self.station.check()

    def begin(self, line: Line) -> None:
        """Make a session, and a little more: run mode."""
        line.say(m.Connect())
        line.say(m.Start())
        self.carry(line)

    def teardown(self) -> None:
        """Whatever happened, a fresh link makes a session and a trigger gives a result."""
        if sys.exception() is not None:
            return
        self.station.operate("set_condition", Status.SYSTEM_ERROR, False)
        self.station.pass_time(A_WHILE)
        line = self.fresh_line()
        self.lines.append(line)
        conversation: tuple[tuple[m.Message, int], ...] = (
            (m.Connect(), 0),
            (m.Stop(), 0),
            (m.SwitchApplication(application=1), A_WHILE),
            (m.SetSequenceNumber(number=4711), 0),
            (m.Start(), 0),
            (m.Trigger(), A_WHILE),
        )
        if self.wire.is_bid:
            conversation = (conversation[0], conversation[2], conversation[-1])
            self.station.operate("start")
            while self.station.model.status & Status.BUSY:
                self.station.pass_time(1)
        for message, milliseconds in conversation:
            number = self.station.model.number
            line.say(message)
            self.carry(line)
            self.station.pass_time(milliseconds)
            self.carry(line)
            self.ends_agree()
            self.device_agrees()
        results = [one for one in line.heard if isinstance(one, m.ResultContainer)]
        assert number == 4711 or self.wire.is_bid
        data = number.to_bytes(4, "big" if self.station.device.endian == 1 else "little")
        assert results[-1] == m.ResultContainer(application=1, data=data)
        assert line.client_end.owed == set()


class TcpCores(Cores):
    """Streams: pieces of any size, noise anywhere, and ends."""

    transport = Transport.TCP

    def may_connect(self, line: Line) -> bool:
        """A Connect may stand behind requests in the same bytes, but not behind a Disconnect.

        The camera's machine knows of that Connect before the requests in front of both are
        answered, and an answer is not legal then.
        """
        return line.client_end.phase != "disconnected" or (
            not line.pipes["up"].size and not line.camera_end.rest
        )

    @rule(which=_WHICH, way=_WAYS, size=st.integers(1, 40) | st.none(), bytewise=st.booleans())
    def deliver_some(self, which: int, way: Way, size: int | None, bytewise: bool) -> None:
        """Deliver ``size`` bytes or all, in one piece or each byte alone."""
        line = self.line(which)
        size = min(size or line.pipes[way].size, line.pipes[way].size)
        for part in [1] * size if bytewise else [size]:
            self.deliver(line, way, part)

    @only_with("noise")
    @rule(
        which=_WHICH,
        way=_WAYS,
        orders=WORK,
        what=NOISE,
        place=st.integers(0, 3),
        offset=_OFFSETS,
        promptly=st.booleans(),
    )
    def disturb(
        self,
        which: int,
        way: Way,
        orders: list[m.Message],
        what: Any,
        place: int,
        offset: int,
        promptly: bool,
    ) -> None:
        """Put noise between two writes, or inside one."""
        line = self.line(which)
        pipe = line.pipes[way]
        for message in orders:
            line.say(message)
        if pipe.ended or (way == "up" and not self.harmless(line, what)):
            return
        if way == "up" and not self.wire.magic:  # what is read behind it could be a Connect
            return
        if way == "down":
            self.deliver(line, "up", line.pipes["up"].size)
        at = min(place, len(pipe.pieces))
        piece = pipe.pieces[at] if at < len(pipe.pieces) else b""
        pipe.pieces[at : at + 1] = [piece[:offset], noise(self.wire, what), piece[offset:]]
        pipe.disturbed = True
        if promptly:
            self.carry(line)

    @only_with("hang up")
    @rule(which=_WHICH, orders=WORK, keep=_KEEP, promptly=st.booleans())
    def hang_up(
        self, which: int, orders: list[m.Message], keep: int | None, promptly: bool
    ) -> None:
        """The client closes its sending side, perhaps by a reset."""
        line = self.line(which)
        for message in orders:
            line.say(message)
        line.pipes["up"].end(keep)
        if promptly:
            self.carry(line)

    def over(self) -> list[Line]:
        """The lines that are of no more use to their clients."""
        return [
            one
            for one in self.lines
            if one.client_end.phase in ENDED or (one.pipes["up"].ended and one.pipes["down"].told)
        ]

    @precondition(lambda self: self.over() and not self.station.device.rebooting)
    @rule(keep=_KEEP)
    def come_again(self, keep: int | None) -> None:
        """A client whose link has ended lets go of it and comes again on a fresh one."""
        line = self.over()[0]
        up = line.pipes["up"]
        up.end(keep)
        while not up.told:
            self.deliver(line, "up", up.size)
        line.check()
        self.lines[self.lines.index(line)] = self.fresh_line()

    def deliver(self, line: Line, way: Way, size: int) -> None:
        pipe = line.pipes[way]
        data = pipe.take(size)
        if data:
            if way == "down":
                line.give_client(data)
            else:
                self.station.give_camera(line, data)
        elif pipe.ended and not pipe.told:
            pipe.told = True
            if way == "down":
                line.end_client()
            else:
                self.end_camera(line)

    def end_camera(self, line: Line) -> None:
        """The client's end came: the camera closes its side too."""
        expected = line.camera_end.hear_end()
        line.camera.receive_eof()
        assert line.camera.events() == expected
        if line is self.station.served:
            self.station.end_session()
        self.drop(line)

    def drop(self, line: Line) -> None:
        if not line.pipes["down"].ended:
            line.pipes["down"].end(self.keep)
        line.pipes["up"].end(keep=0)
        line.pipes["up"].told = True

    def carry(self, line: Line) -> None:
        for way in _THERE_AND_BACK:
            pipe = line.pipes[way]
            while pipe.size:
                self.deliver(line, way, next(self.cuts))
            self.deliver(line, way, 0)


class UdpCores(Cores):
    """Datagrams: lost, doubled, overtaken, broken."""

    transport = Transport.UDP

    def may_connect(self, line: Line) -> bool:
        return True

    @rule(which=_WHICH, way=_WAYS)
    def deliver_next(self, which: int, way: Way) -> None:
        self.deliver(self.line(which), way, 0)

    @only_with("loss")
    @rule(which=_WHICH, way=_WAYS, place=st.integers(0, 3))
    def deliver_overtaking(self, which: int, way: Way, place: int) -> None:
        self.deliver(self.line(which), way, place)

    @only_with("loss")
    @rule(which=_WHICH, way=_WAYS, place=st.integers(0, 3))
    def lose(self, which: int, way: Way, place: int) -> None:
        pipe = self.line(which).pipes[way]
        del pipe.pieces[place : place + 1]
        pipe.disturbed = True

    @only_with("loss")
    @rule(which=_WHICH, way=_WAYS, place=st.integers(0, 3))
    def double(self, which: int, way: Way, place: int) -> None:
        pipe = self.line(which).pipes[way]
        pipe.pieces += pipe.pieces[place : place + 1]
        pipe.disturbed = True

    @only_with("noise")
    @rule(which=_WHICH, way=_WAYS, what=NOISE | st.just(b""))
    def disturb(self, which: int, way: Way, what: Any) -> None:
        line = self.line(which)
        if way == "down" or self.harmless(line, what):
            line.pipes[way].pieces.append(noise(self.wire, what))

    @only_with("noise")
    @rule(which=_WHICH, way=_WAYS, size=st.integers(1, 15))
    def cut_short(self, which: int, way: Way, size: int) -> None:
        pieces = self.line(which).pipes[way].pieces
        if pieces:
            pieces[0] = pieces[0][:-size]

    @only_with("noise")
    @rule(which=_WHICH, way=_WAYS)
    def glue(self, which: int, way: Way) -> None:
        pieces = self.line(which).pipes[way].pieces
        pieces[:2] = [b"".join(pieces[:2])]

    @only_with("hang up")
    @rule(which=_WHICH)
    def vanish(self, which: int) -> None:
        """A client is gone without a message, another comes; the camera sends on to no client."""
        line = self.line(which)
        self.lines[self.lines.index(line)] = self.fresh_line()

    def deliver(self, line: Line, way: Way, place: int) -> None:
        pieces = line.pipes[way].pieces
        if not pieces:
            return
        data = pieces.pop(min(place, len(pieces) - 1))
        if way == "down":
            line.give_client(data)
        elif not self.station.device.rebooting:
            self.station.give_camera(line, data)

    def drop(self, line: Line) -> None:
        line.renew_camera_end()

    def carry(self, line: Line) -> None:
        for way in _THERE_AND_BACK:
            for _ in range(len(line.pipes[way].pieces)):
                self.deliver(line, way, 0)


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("run", range(RUNS))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("cores", [TcpCores, UdpCores])
def test_cores_agree_with_the_model_in_any_history(
    cores: type[Cores], family: str, kind: str, run: int
) -> None:
    own = {"features": KINDS[kind], "dialects": FAMILIES[family]}
    histories: Any = type(cores.__name__, (cores,), own)
    if PROFILE.derandomize:
        histories = seed(run)(histories)
    run_state_machine_as_test(histories, settings=RUN)
