"""Define a program's connection to the bus: it sends calls to agents, and receives replies."""

from __future__ import annotations

import asyncio
import logging
import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from smartcam._client._inside import AnyFuture, DeadlineTimer, make_doorbell, new_tuple
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    ConnectionClosedError,
    ProtocolError,
)
from smartcam.fleet._bus.keys import ANYONE, Keys
from smartcam.fleet._bus.wire import BusMessage, TriggerReply, decode, decode_trigger_reply, encode
from smartcam.fleet._frames.collector import FrameCollector
from smartcam.fleet._program.program_name import ProgramName

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Self

    from smartcam.exceptions import SmartCamError
    from smartcam.fleet._bus.bus import Bus, Handle

logger: logging.Logger = logging.getLogger("smartcam.fleet")


AGENT_SEARCH_INTERVAL = 0.1
"""Seconds between two checks for an agent."""

SIMILAR_NAMES_TIMEOUT = 1.0
"""Seconds to find cameras with similar names, for an error text."""


Reply = BusMessage | TriggerReply


class CalledCamera(Protocol):
    """A camera that receives calls.

    Attributes:
        streams_results: whether this program subscribes to all results of the camera. The results
            of a trigger are then passed to the subscribers before the trigger returns.
    """

    streams_results: bool


class Pending(NamedTuple):
    """A call whose reply has not arrived yet.

    Attributes:
        camera: the camera that is called.
        reply_future: future of the reply.
        deadline: loop time at which the call fails without a reply.
    """

    camera: CalledCamera
    reply_future: AnyFuture
    deadline: float


class Program:
    """One program's connection to the bus.

    Args:
        bus: the program's own connection to the bus.
        fleet: name of the fleet; None for the only fleet that has the camera.
        camera: name or pattern of the camera, to find the fleet.
        bus_is_shared: whether another object opens and closes the connection.
        display_name: name of the program for people; None: the name of its script.

    Attributes:
        keys: keys of the fleet, once the program is open.
        frames: collector of the bytes of frames.
    """

    keys: Keys

    def __init__(
        self,
        bus: Bus,
        fleet: str | None,
        camera: str = "**",
        *,
        bus_is_shared: bool = False,
        display_name: str | None = None,
    ) -> None:
        self.bus: Bus = bus
        self._bus_is_shared = bus_is_shared
        self._fleet, self._camera = fleet, camera
        self._display_name = display_name
        self._set_name(ProgramName.new(ANYONE, display_name))
        self._call_count = 0
        self._pending_calls: dict[int, Pending] = {}
        self._deadline_timer = DeadlineTimer(self._expire)
        self._timer_at = math.inf  # no later than the first deadline of the pending calls
        self._handles: list[Handle] = []
        self.frames: FrameCollector = FrameCollector(self)

    async def open(self, timeout: float) -> Self:
        """Connect to the bus.

        Raises:
            ConnectFailedError: no bus is found within ``timeout`` seconds, or no fleet on it.
            ConfigurationError: there are several fleets.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        self._bell = make_doorbell(loop)
        if not self._bus_is_shared:
            await self.bus.open(timeout)
        self.keys = Keys(self._fleet or await self._find_fleet(deadline, timeout))
        if self.bus.identity is not None:
            display_name = self._display_name or self.bus.identity.name or None
            self._set_name(ProgramName.new(self.bus.identity.role, display_name))
        self._handles = [
            self.bus.subscribe(self.keys.reply(self.name), self._on_reply),
            self.bus.announce(self.keys.program(self.token)),
        ]
        return self

    def _set_name(self, name: ProgramName) -> None:
        self._name, self._token = name, name.token

    @property
    def name(self) -> str:
        """The program's unique name: its role, and its name for people."""
        return self._name.name

    @property
    def token(self) -> str:
        """The program's name and secret, in the form for agents."""
        return self._token

    @property
    def role(self) -> str:
        """The role at the start of the program's name."""
        return self._name.role

    async def _find_fleet(self, deadline: float, timeout: float) -> str:
        """Return the name of the only fleet that has the camera."""
        loop = asyncio.get_running_loop()
        # there may be thousands of cameras, but only a few agents
        keys_of = Keys("*")
        pattern = keys_of.camera("*", self._camera)
        if self._camera == "**":
            pattern = keys_of.agent("*")
        while (remaining := deadline - loop.time()) > 0:
            keys = await self.bus.present_keys(pattern, remaining)
            fleets = sorted({key.split("/")[1] for key in keys})
            if len(fleets) == 1:
                return fleets[0]
            if fleets:
                raise ConfigurationError(
                    f"{self._camera}: there are several fleets: {', '.join(fleets)}; choose one: "
                    f"?fleet={fleets[0]}"
                )
            await asyncio.sleep(min(AGENT_SEARCH_INTERVAL, remaining))
        wanted, suggestion = "camera", ""
        if "*" not in self._camera:
            keys = await self.bus.present_keys(Keys("*").camera("*", "**"), SIMILAR_NAMES_TIMEOUT)
            suggestion = did_you_mean(self._camera, sorted({key.split("/", 5)[5] for key in keys}))
            wanted = f"camera {self._camera}"
        identity = self.bus.identity
        hidden = "" if identity is None else f"; or {identity} may not see it"
        late = f"none came within {timeout:g} s{suggestion}{hidden}"
        reason = f"no agent there has a {wanted}: {late}"
        raise ConnectFailedError(reason, attempts=(reason,))

    async def close(self) -> None:
        """Leave the bus, and end running calls. Idempotent."""
        for pending in [*self._pending_calls.values()]:
            if not pending.reply_future.done():
                pending.reply_future.set_exception(ConnectionClosedError("closed"))
        self._deadline_timer.cancel()
        handles, self._handles = self._handles, []
        self.frames.close()
        for handle in handles:
            handle.close()
        if not self._bus_is_shared:
            await self.bus.close()

    def next_call(self) -> int:
        """Return a new number for a call."""
        self._call_count += 1
        return self._call_count

    def send(self, key: str, fields: dict[str, Any], blobs: Sequence[bytes] = ()) -> int:
        """Send a message to an agent; return its number of bytes."""
        return self.put(key, encode({"program": self.token, **fields}, blobs))

    def put(self, key: str, payload: bytes) -> int:
        """Send an encoded message, like :meth:`send`."""
        self.bus.put(key, payload)
        return len(payload)

    def expect_reply(
        self, number: int, camera: CalledCamera, deadline: float = math.inf
    ) -> AnyFuture:
        """Return the future of the reply to a call; :meth:`forget_call` must follow in the end.

        Without a reply by ``deadline`` (loop time) the future raises :exc:`TimeoutError`.
        """
        reply = self._bell.make_future()
        self._pending_calls[number] = new_tuple(Pending, (camera, reply, deadline))
        if deadline < self._timer_at:
            self._timer_at = deadline
            self._deadline_timer.set(deadline)
        return reply

    def forget_call(self, number: int) -> None:
        """Drop a call whose reply is not awaited any more."""
        self._pending_calls.pop(number, None)
        if not self._pending_calls:
            self._timer_at = math.inf
            self._deadline_timer.clear()

    def _expire(self) -> None:
        """End the calls whose deadline has passed, and set the timer to the next deadline."""
        now, next_deadline = asyncio.get_running_loop().time(), math.inf
        for _, reply, deadline in self._pending_calls.values():
            if reply.done():
                continue
            if deadline <= now:
                reply.set_exception(TimeoutError())
            else:
                next_deadline = min(next_deadline, deadline)
        self._timer_at = next_deadline
        if next_deadline < math.inf:
            self._deadline_timer.set(next_deadline)

    def fail_calls(self, camera: CalledCamera, error: Callable[[], SmartCamError]) -> None:
        """End all calls to a camera with an error, since there will be no replies."""
        for called_camera, reply, _ in self._pending_calls.values():
            if called_camera is camera and not reply.done():
                reply.set_exception(error())

    def _on_reply(self, key: str, payload: bytes) -> None:
        try:
            trigger_reply = decode_trigger_reply(payload, "a reply")
            if trigger_reply is not None:
                message: Reply = trigger_reply
                number = trigger_reply.call
            else:
                message = decoded = decode(payload, "a reply")
                number = decoded.fields["call"]
            pending = self._pending_calls.get(number)
        except (ProtocolError, KeyError, TypeError) as exc:
            logger.warning("%s ! a reply that cannot be read: %s", self.name, exc)
            return
        if pending is None or pending.reply_future.done():
            return
        if pending.camera.streams_results:
            pending.reply_future.set_result(message)
        else:
            self._bell.set_future(pending.reply_future, message)
