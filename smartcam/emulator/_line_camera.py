"""Emulate cameras that use lines of text: the base for cameras of plug-ins, and for In-Sight's."""

from __future__ import annotations

import copy
import heapq
import itertools
import logging
import re
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from smartcam.emulator._clock import nanoseconds
from smartcam.emulator._line_codec import HeardLine, LineCodec, LineServer, SaidLine
from smartcam.emulator._makes import check_options
from smartcam.emulator._scenario.states import DeviceState
from smartcam.emulator._scenario.timeline import Cue
from smartcam.emulator._wire_camera import WireCamera
from smartcam.emulator.faults._matching import find_unsupported
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import LineDialect
from smartcam.protocols import messages as m
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from typing import Self

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._client_link import ClientLink, Trace
    from smartcam.emulator._clock import Clock
    from smartcam.emulator._scenario.scenario import Mistake, Scenario
    from smartcam.emulator.faults._base import BaseFault
    from smartcam.protocols import Protocol, Transport

_log = logging.getLogger("smartcam.emulator")

MAX_INPUT_BYTES = 1 << 16
"""Largest number of bytes of lines that wait after a client's current line; more are not read yet.
"""

MAX_SCHEDULED_CALLS = 10_000
"""Largest number of calls that may be scheduled for later at one time."""


_COMMON_FIELDS = frozenset({"name", "protocol", "port", "seed", "timeline", "options", "cameras"})
"""The fields of a scenario that apply to every camera that uses lines."""

_PROGRAM_FIELDS = frozenset({"active", "running"})
"""Fields of a scenario that apply only to cameras with programs."""


class LineClient:
    """A client of an emulated camera that uses lines.

    Attributes:
        peer: address and port of the client.
        has_session: True once the client has sent the line that begins a session; if the dialect
            has none, any line of the dialect.
    """

    def __init__(self, camera: LineCamera, link: ClientLink, server: LineServer) -> None:
        self.peer: str = link.peer
        self.has_session: bool = False
        self._camera = camera
        self._link = link
        self._server = server
        self._row_number = 0  # number of the current line's row of the dialect, 0 for none
        self._answers_later = False

    def answer_later(self) -> Self:
        """Return a copy that will answer the current line; this client reads the next line now."""
        self._answers_later = True
        copied_client = copy.copy(self)
        self._answers_later = False
        self.end_line()
        return copied_client

    @property
    def is_closed(self) -> bool:
        """True once the connection has ended."""
        return self._link.closed

    def pack(self, text: str) -> bytes:
        """Return an answer to the current line as bytes."""
        return self._camera.lines.data(text)

    def say(self, text: str) -> None:
        """Send a line that is not an answer."""
        self.say_bytes(self._camera.lines.data(text), row=0)

    def answer(self, text: str | None) -> None:
        """Answer the current line (None: send nothing), and read the next line."""
        if text is not None:
            self.say_bytes(self.pack(text))
        if not self._answers_later:
            self.end_line()

    def say_bytes(self, data: bytes, *, row: int | None = None) -> None:
        """Send bytes unchanged: part of an answer, or a prompt."""
        if not self._link.closed:
            message = SaidLine(row=self._row_number if row is None else row, data=data)
            self._camera.say(self._link, message)

    def say_recorded(self, data: bytes) -> None:
        """Send recorded bytes of a camera as the answer to the current line."""
        self.say_bytes(data)

    def end_line(self) -> None:
        """End the current line, and read the next."""
        self._server.busy = False
        if not self._server.is_reading and not self._link.closed:
            with self._camera.step():
                self._link.feed(b"")

    def hide_next_line(self) -> None:
        """Keep the next line, a password, out of the log."""
        self._server.hides_next_line = True

    def close(self, reason: str) -> None:
        """End the connection at once."""
        self._link.close(reason)

    def end(self, reason: str) -> None:
        """Close the connection after the sent lines; nothing more is read."""
        self._link.flush()
        self._link.end_link("close", reason)

    def begin(self, message: HeardLine) -> None:
        """Note that a line has become the current one."""
        self.has_session = self.has_session or self._camera.begins_session(message)
        self._row_number, self._server.busy = message.row, True


class LineCamera(WireCamera):
    """An emulated camera that reads lines from several clients, and answers each with a line.

    Subclass it for a camera of your own, and name the class in ``Protocol(emulator=...)``::

        class AcmeCamera(LineCamera):
            protocol = ACME

            def answer(self, line: str) -> str | None:
                return {"HELLO": "ACME", "STATE": "run"}.get(line, "what?")

    A subclass with its own options also takes ``**options`` and passes them on. A client has one
    current line; its next lines wait. All methods are called in the event loop's thread.

    Args:
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        name: name of the camera in logs.
        clock: clock of the camera; a :class:`ManualClock` in tests. Default: real time.
        seed: seed of the random numbers that a timeline uses.
        faults: exact misbehaviour, in order: faults of :mod:`smartcam.emulator.faults`, or mappings
            of their fields with ``kind``. ``on`` names a request of the dialect's rows, or its
            answer.
        timeline: events without a client: cues, or mappings of their fields.

    Attributes:
        protocol: protocol of the camera, which speaks its first dialect.
        device: object with the operator's actions, if a subclass has any: ``start()``, ``stop()``,
            ``trigger()``, ``reboot(seconds)``, ``switch_application(id, running=False)``. Faults,
            scenarios and the page use those that exist.
        fault_kinds: the faults that the camera supports.
        lines: codec of the lines.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    protocol: Protocol
    device: Any = None
    accepted_options: ClassVar[frozenset[str]] = frozenset({"scenario", "seed", "web", "replay"})
    states: ClassVar[frozenset[DeviceState]] = frozenset(
        {DeviceState.CONNECTED, DeviceState.DISCONNECTED}
    )

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        name: str | None = None,
        clock: Clock | None = None,
        seed: int = 0,
        faults: Iterable[BaseFault | Mapping[str, Any]] = (),
        timeline: Iterable[Cue | Mapping[str, Any]] = (),
    ) -> None:
        self._clients: dict[ClientLink, LineClient] = {}  # the oldest is first
        self._scheduled_calls: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._links_to_flush: dict[ClientLink, None] = {}  # links with lines to write
        cues = [validated(Cue, cue, f"cue {at}") for at, cue in enumerate(timeline, start=1)]
        self.lines: LineCodec = self.make_codec()
        super().__init__(
            codec=self.lines,
            device=self.device,
            host=host,
            port=port,
            transport="tcp",
            dialect=next(iter(self.protocol.dialects)),
            name=name or self.protocol.name,
            clock=clock,
            seed=seed,
            timeline=cues,
            applications=self.application_ids,
        )
        mistake = self.mistake_in(cues)
        if mistake is not None:
            path, text = mistake
            raise ConfigurationError(f"{self.name}: {'.'.join(map(str, path))}: {text}")
        self.queue.add(faults)

    @classmethod
    def from_scenario(
        cls,
        plan: Scenario,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        clock: Clock | None = None,
        seed: int | None = None,
    ) -> Self:
        """Return a camera of a scenario; arguments win over the scenario's fields.

        Raises:
            ConfigurationError: an argument is wrong, or not supported by this kind of camera.
        """
        options = dict(plan.options)
        if plan.active is not None or plan.running:
            options = {**cls.state_options(plan.active, running=plan.running), **options}
        if quirks:
            options["quirks"] = {**options.get("quirks", {}), **quirks}
        given = {"transport": transport, "dialect": dialect}
        options |= {
            name: value for name, value in given.items() if value not in {None, getattr(plan, name)}
        }
        check_options(cls, options)
        return cls(
            host=host,
            port=plan.port if port is None else port,
            name=plan.name,
            clock=clock,
            seed=plan.seed if seed is None else seed,
            timeline=plan.timeline,
            **options,
        )

    @classmethod
    def mistake(cls, plan: Scenario) -> Mistake | None:
        """Return the path of an unsupported field in a scenario, and the reason; or None."""
        fields = _COMMON_FIELDS | (
            _PROGRAM_FIELDS if cls.state_options(None, running=True) else frozenset()
        )
        for name in sorted(plan.changed() - fields):
            if name != "dialect" or plan.dialect not in cls.protocol.dialects:
                takes = ", ".join(sorted(fields))
                return (name,), f"a camera of {cls.protocol.name} has no such field; it has {takes}"
        try:
            camera = cls.from_scenario(plan.model_copy(update={"timeline": ()}))
        except ConfigurationError as exc:
            return ("options",), str(exc)
        return camera.mistake_in(plan.timeline)

    def mistake_in(self, cues: Sequence[Cue]) -> Mistake | None:
        """Return the path of an unsupported field in a timeline, and the reason; or None."""
        for number, cue in enumerate(cues):
            if cue.entering is not None and cue.entering not in self.states:
                supported = ", ".join(sorted(state.value for state in self.states))
                return ("timeline", number, "entering"), f"its states are {supported}"
            for fault_index, fault in enumerate(cue.do):
                mistake = find_unsupported(
                    fault, self.codec, self.application_ids, self.fault_kinds
                )
                if mistake is not None:
                    return ("timeline", number, "do", fault_index, mistake[0]), mistake[1]
        return None

    @classmethod
    def image_answer(cls, image: NDArray[np.uint8]) -> bytes | None:
        """Return the answer to a request for a picture; None: the camera has no pictures.

        A replay uses it if a picture was recorded and the line was not.

        Args:
            image: (H, W), the brightness.
        """
        return None

    def make_codec(self) -> LineCodec:
        """Return the codec of its lines, by its protocol's first dialect.

        Raises:
            ConfigurationError: the protocol does not use lines.
        """
        dialect = next(iter(self.protocol.dialects.values()))
        if not isinstance(dialect, LineDialect):
            raise ConfigurationError(
                f"{type(self).__name__}: dialect {dialect.name} is no LineDialect"
            )
        return LineCodec(
            dialect.name,
            dialect.rows,
            line_end=dialect.line_end,
            client_line_end=re.compile(re.escape(dialect.line_end)),
            max_line=dialect.max_line,
            encoding=dialect.encoding,
            split=dialect.split,
        )

    # ------------------------------------------------------------------ for subclasses

    def answer(self, line: str) -> str | None:
        """Return the answer to a line, None for none; override this or :meth:`hear`."""
        raise NotImplementedError(f"{type(self).__name__} has no answer()")

    def hear(self, client: LineClient, line: str) -> None:
        """Carry out a line, and call ``client.answer()`` once, now or later."""
        client.answer(self.answer(line))

    def on_raw_line(self, client: LineClient, message: HeardLine) -> None:
        """Receive a client's raw line, before it is carried out; override to use it."""

    def greet(self, client: LineClient) -> None:
        """Greet a client that has just connected; override to send something."""

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Call a function later, by the camera's clock.

        Raises:
            ConfigurationError: 10,000 calls wait already.
        """
        if len(self._scheduled_calls) >= MAX_SCHEDULED_CALLS:
            raise ConfigurationError(
                f"{self.name}: {MAX_SCHEDULED_CALLS} things wait for their time"
            )
        when = nanoseconds(self.clock.now) + nanoseconds(seconds)
        with self.step():
            heapq.heappush(self._scheduled_calls, (when, next(self._numbers), action))

    # ------------------------------------------------------------------ properties

    @property
    def url(self) -> str:
        """The camera's address."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{next(iter(self.protocol.schemes))}://{host}:{self.port}"

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.url}>"

    @property
    def application_ids(self) -> list[int]:
        """Ids of the camera's programs; a subclass with programs overrides it."""
        return []

    @property
    def sessions(self) -> list[str]:
        """Address and port of the served clients, the oldest first."""
        return [client.peer for link, client in self._clients.items() if self.serves(link)]

    # ------------------------------------------------------------------ links

    def make_machine(self, transport: Transport, trace: Trace) -> LineServer:
        """Return the machine of a new link."""
        return LineServer(self.lines, transport, trace)

    def connection_begun(self, link: ClientLink) -> None:
        """Note that a connection was made."""
        assert isinstance(link.machine, LineServer)  # noqa: S101 - it is what make_machine made
        client = self._clients[link] = self.make_client(link, link.machine)
        with self.step():
            self.greet(client)
            self._timeline.note_entered(DeviceState.CONNECTED)

    def make_client(self, link: ClientLink, server: LineServer) -> LineClient:
        """Return a new client."""
        return LineClient(self, link, server)

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Take a line of a link."""
        client = self._clients.get(link)
        if client is None or not isinstance(message, HeardLine):
            return
        faults = self._fire_before(self.queue.client_device_faults, message)
        client.begin(message)
        self.on_raw_line(client, message)
        self.hear(client, self.lines.text(message.data))
        self._run_device_faults(faults, "after")

    def begins_session(self, message: HeardLine) -> bool:
        """Return True if a line begins a session: Connect, or without Connect any known line."""
        if not message.row:
            return False
        kind = self.lines.message_type(m.Sender.CLIENT, message.row)
        return kind is m.Connect or not self.lines.has(m.Connect)

    def serves(self, link: ClientLink) -> bool:
        """Return True if the client of the link has begun a session."""
        client = self._clients.get(link)
        return client is not None and client.has_session

    def forget_link(self, link: ClientLink) -> None:
        """Forget a lost link; a second call does nothing."""
        self._links_to_flush.pop(link, None)
        if self._clients.pop(link, None) is not None:
            self._timeline.note_entered(DeviceState.DISCONNECTED)

    def say(self, link: ClientLink, message: SaidLine) -> None:
        """Send a message to a link; it is written at the end of the step."""
        with self.step():
            faults = self._fire_before(self.queue.camera_device_faults, message)
            link.send(message)
            self._links_to_flush[link] = None
            self._run_device_faults(faults, "after")

    # ------------------------------------------------------------------ steps

    def _advance_device(self, now: float) -> None:
        instant = nanoseconds(now)
        while self._scheduled_calls and self._scheduled_calls[0][0] <= instant:
            heapq.heappop(self._scheduled_calls)[2]()

    def _collect(self) -> None:
        pass  # messages go to their links at once

    def _finish_step(self) -> None:
        for link in list(self._links_to_flush):
            if not link.closed:
                link.flush()
        self._links_to_flush.clear()
        for link in self._clients:
            link.set_paused(link.machine.buffered > MAX_INPUT_BYTES)
        self._timer.set(self._next_call_at())

    def _next_call_at(self) -> int | None:
        """Return the time of the next scheduled call, nanoseconds of the clock; None for never."""
        return self._scheduled_calls[0][0] if self._scheduled_calls else None

    def _before_stop(self) -> None:
        self._scheduled_calls.clear()
