"""A client, a camera's end and the wire between them, each beside its model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import pytest

from smartcam.emulator import Application, Quirks
from smartcam.exceptions import LocalProtocolError, UnsupportedError
from smartcam.protocols import LinkFailed, Machine, Role, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import POLICIES, Event
from tests.emulator.parts import made_device
from tests.machines import BY_LABEL, one_by_one
from tests.protocols.camera_model import CameraModel, Options
from tests.protocols.core_model import LIMIT, WIRES, CameraEnd, ClientEnd, framed, meaning, surplus

Way = Literal["up", "down"]


class Pipe:
    """One direction of a wire: what is on its way, a piece for each write."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.ended = False  # no more is written
        self.told = False  # and the reader knows
        self.disturbed = False

    @property
    def size(self) -> int:
        return sum(map(len, self.pieces))

    def put(self, data: bytes) -> None:
        if not self.ended:
            self.pieces.append(data)

    def take(self, size: int) -> bytes:
        """Take the first ``size`` bytes, however they were written."""
        flat = b"".join(self.pieces)
        data, rest = flat[:size], size
        while self.pieces and rest >= len(self.pieces[0]):
            rest -= len(self.pieces.pop(0))
        if self.pieces:
            self.pieces[0] = self.pieces[0][rest:]
        return data

    def end(self, keep: int | None = None) -> None:
        """No more is written; a reset loses all but the first ``keep`` bytes of what was."""
        self.ended = True
        if keep is not None:
            kept = self.take(keep)
            self.pieces = [kept] if kept else []
            self.disturbed = True


class Line:
    """A client, the camera's end for it, and the wire between them."""

    def __init__(self, dialect: str, transport: Transport, *, tells: bool) -> None:
        self.wire = WIRES[dialect]
        self.transport = transport  # stream or datagrams
        self.tells = tells  # the camera is told of bodies of a wrong length
        self.dialect = BY_LABEL[dialect]  # its label
        datagrams = transport is Transport.UDP
        self.client = Machine(self.dialect, Role.CLIENT, transport, max_length=LIMIT)
        self.client_end = ClientEnd(self.wire, datagrams=datagrams, limit=LIMIT)
        self.pipes: dict[Way, Pipe] = {"up": Pipe(), "down": Pipe()}
        self.asked = dict.fromkeys(self.wire.answered, 0)
        self.answered = dict.fromkeys(self.wire.answered, 0)
        self.heard: list[m.Message] = []
        self.said: list[m.Message] = []
        self.renew_camera_end()

    def renew_camera_end(self) -> None:
        """Give the camera a new machine, as for a datagram of an address that it has forgotten."""
        datagrams = self.transport is Transport.UDP
        policy = dataclasses.replace(
            POLICIES[Role.CAMERA, self.transport], reports_malformed=self.tells
        )
        self.camera = Machine(
            self.dialect, Role.CAMERA, self.transport, max_length=LIMIT, policy=policy
        )
        self.camera_end = CameraEnd(self.wire, datagrams=datagrams, limit=LIMIT, tells=self.tells)

    @property
    def clean(self) -> bool:
        """True if the wires carried the sent messages and nothing else, in order."""
        stream = self.transport is Transport.TCP
        return stream and not any(pipe.disturbed for pipe in self.pipes.values())

    # ------------------------------------------------------------------ the client says

    def say(self, message: m.Message, answered: bool | None = None) -> None:
        """Send a message; a forbidden one must change nothing."""
        if self.pipes["up"].ended:
            return
        if not self.client_end.may_say(message, answered):
            refused(self.client, message, answered)
            return
        expected = self.client_end.say(message, answered)
        self.client.send(message, answered=answered)
        assert self.client.data_to_send() == [expected]
        self.pipes["up"].put(expected)
        message_id = framed(self.wire, message).message_id
        if message_id in self.asked and answered is not False:
            self.asked[message_id] += 1

    # ------------------------------------------------------------------ the client hears

    def give_client(self, data: bytes) -> None:
        expected = self.client_end.hear(data)
        self.client.receive_data(delivery(data))
        events = one_by_one(self.client.events())
        assert plain(events) == expected
        for event in events:
            if isinstance(event, m.Message):
                self.heard.append(event)
                message_id = framed(self.wire, event).message_id
                if message_id in self.answered:
                    self.answered[message_id] += 1

    def end_client(self) -> None:
        expected = self.client_end.hear_end()
        self.client.receive_eof()
        assert plain(one_by_one(self.client.events())) == expected

    # ------------------------------------------------------------------ what must hold

    def check(self) -> None:
        check_end(self.client, self.client_end)
        check_end(self.camera, self.camera_end)
        end, counters = self.client_end, self.client.counters
        assert counters.unknown_ids == end.unknown
        assert counters.unexpected_messages == end.unasked
        assert counters.long_bodies == end.long
        assert self.camera.error is None
        assert (self.camera.counters.long_bodies, self.camera.counters.unknown_ids) == (0, 0)
        for message_id, asked in self.asked.items():
            assert 0 <= asked - self.answered[message_id] <= 1
        if self.clean:
            self.check_order()

    def check_order(self) -> None:
        """On an undisturbed stream the client receives the sent messages, in order, none twice."""
        said = iter(self.said)
        assert all(message in said for message in self.heard)
        unasked = self.client.counters.unexpected_messages
        if self.client.error is None:
            assert len(self.heard) + unasked == self.client.counters.frames_received
            if not self.pipes["down"].pieces:
                assert len(self.heard) + unasked == len(self.said)


def check_end(machine: Machine, end: ClientEnd | CameraEnd) -> None:
    """Compare a machine with its model."""
    counters = machine.counters
    assert machine.state.value == end.phase
    assert machine.buffered == end.rest <= end.wire.header + LIMIT
    assert (counters.bytes_received, counters.bytes_sent) == (end.bytes_received, end.bytes_sent)
    assert (counters.frames_received, counters.frames_sent) == (
        end.frames_received,
        end.frames_sent,
    )
    least, most = (0, 0) if isinstance(end, ClientEnd) else end.noise
    assert least <= counters.ignored_frames - end.bad_frames <= most
    assert (machine.error is not None) == (end.phase == "failed")
    assert machine.events() == []
    assert machine.data_to_send() == []


def refused(machine: Machine, message: m.Message, answered: bool | None = None) -> None:
    """Send a forbidden message: it is refused, and nothing has changed."""
    before = (machine.state, machine.buffered, dataclasses.replace(machine.counters))
    with pytest.raises((LocalProtocolError, UnsupportedError)):
        machine.send(message, answered=answered)
    assert (machine.state, machine.buffered, machine.counters) == before
    assert machine.data_to_send() == []


def plain(events: list[Event]) -> list[object]:
    """Return events with the kind of a failure in its place."""
    return [type(one.error) if isinstance(one, LinkFailed) else one for one in events]


def delivery(data: bytes) -> bytes | bytearray | memoryview:
    """Return data as a socket may give it."""
    kinds: tuple[type[bytes | bytearray | memoryview], ...] = (bytes, bytearray, memoryview)
    return kinds[len(data) % 3](data)


COUNTING: dict[str, Any] = {"layout": "n: int32 @sequence", "generator": "sequence"}
ECHOING: dict[str, Any] = {"layout": "n: int32", "input": "n: int32", "generator": "input"}
TURNS: dict[str, Any] = {"layout": "n: int32", "cycle": [{"n": 10}, {"n": -20}, {"n": 30}]}
APPLICATIONS = (
    Application(id=1, **COUNTING, load_time=0.1, processing_time=0.04),
    Application(id=2, **ECHOING, load_time=0.06, processing_time=0.03),
    Application(id=3, **COUNTING, rate=20.0, load_time=0.1, processing_time=0.01),
    Application(id=4, load_time=0.0, processing_time=0.025),
    Application(id=5, **TURNS, load_time=0.15, processing_time=0.0),
)
"""The emulator's side of ``PROGRAMS``."""


class Station:
    """Passes messages from lines to the device and back, as the emulator does."""

    def __init__(self, dialect: str, options: Options, drop: Callable[[Line], None]) -> None:
        self.model = CameraModel(
            options, is_bid=dialect == "bid", coded=dialect in {"bid", "b16 with quirk code"}
        )
        quirks = Quirks(
            reboot_time=0.3, overtriggered_time=0.1, input_queue_depth=2, **options._asdict()
        )
        self.device = made_device(APPLICATIONS, BY_LABEL[dialect], quirks)
        self.lines: list[Line] = []
        self.served: Line | None = None
        self._drop = drop  # what happens to a line that the camera lets go of

    def pass_time(self, milliseconds: int) -> None:
        self.device.tick(milliseconds / 1000)
        self.model.pass_time(milliseconds)
        self.collect()

    def operate(self, action: str, *args: Any, **options: Any) -> None:
        """Do the same to both."""
        done = getattr(self.device, action)(*args, **options)
        assert done == getattr(self.model, action)(*args, **options)
        self.collect()

    def give_camera(self, line: Line, data: bytes) -> None:
        expected = line.camera_end.hear(data)
        line.camera.receive_data(delivery(data))
        assert line.camera.events() == expected
        for message in expected:
            self.route(line, message)
        if self.model.mode == "rebooting":
            self.go_down()

    def route(self, line: Line, message: m.Message) -> None:
        """Pass a message on: the newcomer has the session from its Connect."""
        if isinstance(message, m.Connect) and line is not self.served:
            self.end_session()
            self.served = line
        if line is self.served:
            self.device.handle(message)
            self.model.hear(message)
            self.collect()
        if isinstance(message, m.Disconnect) and line is self.served:
            self.served = None

    def end_session(self) -> None:
        """End the session, and with it the link."""
        line, self.served = self.served, None
        if line is not None:
            self.device.disconnect()
            self.model.end_session()
            self._drop(line)

    def go_down(self) -> None:
        """The camera is off the network: every link is lost."""
        self.served = None
        for line in self.lines:
            self._drop(line)

    def collect(self) -> None:
        """Compare the device's messages with the model's, and put them on the wire."""
        said = self.device.take_output()
        assert said == self.model.take()
        assert self.served is not None or not said
        for message in said:
            self.put(message)

    def put(self, message: m.Message) -> None:
        line = self.served
        assert line is not None
        expected = line.camera_end.say(message)
        line.camera.send(message)
        assert line.camera.data_to_send() == [expected]
        line.pipes["down"].put(expected)
        frame = framed(line.wire, message)
        if surplus(line.wire, m.Sender.CAMERA, frame) < 0:
            line.said.append(message)  # a code alone, where an answer has more: nobody reads it
        else:
            line.said.append(meaning(line.wire, m.Sender.CAMERA, frame))

    def check(self) -> None:
        """Compare the device with its model."""
        device, model = self.device, self.model
        assert device.mode.value == model.mode
        assert device.status == model.status
        assert device.active_application == model.active
        assert device.connected == model.session
        assert device.next_number == model.number
        assert device.processing == (model.run is not None)
        assert device.queued_inputs == len(model.inputs)
        assert device.clock_time == model.clock
        due = device.next_event_in()
        assert (None if due is None else round(due * 1000)) == model.next_event_in
