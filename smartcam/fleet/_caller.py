"""How a fleet's camera calls its agent: who that is, whether it is there, what its clock says."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import (
    ConnectionClosedError,
    ConnectionLostError,
    LinkError,
    NotAllowedError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet._certificates import may_command
from smartcam.fleet._errors import from_fields
from smartcam.fleet._keys import COMMANDS
from smartcam.fleet._wire import BusMessage, TriggerOrder, TriggerReply, encode, encode_order, grace

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam._client.triggering import TriggerRequest
    from smartcam.fleet._bus import Handle
    from smartcam.fleet._program import Program, Reply
    from smartcam.protocols._framed.machine import Counters

DRIFT = 1e-4
"""How far two clocks go apart at most: seconds in a second."""

HELLO_TIMEOUT = 2.0
"""Seconds for the answer to a hello; then it is said again, as long as the agent is there."""


SWITCHES = {"ensure": "switch_application", "enter": "switch_application"}
"""What a user calls these calls."""
LOOK_ELSEWHERE = 0.25
"""Seconds between two looks whether another agent has a session, where the one that was met has
none."""

ASK_ANEW = 5.0
"""Seconds until the one that was met is asked whether it has one by now: that it said so may be
lost, and a camera that nobody triggers says nothing more."""

MOST_EPOCHS = 16
"""Agents of a camera that are remembered."""

INSIST_AFTER = 1.0
"""Seconds until something is said again that the agent has to know: it may have been lost."""


class Met:
    """An agent that has answered.

    Attributes:
        agent: its name.
        epoch: which start of it.
        hello: what it said of the camera.
    """

    def __init__(self, agent: str, epoch: int, hello: dict[str, Any]) -> None:
        self.agent: str = agent
        self.epoch: int = epoch
        self.hello: dict[str, Any] = hello


class _HelloHeard(NamedTuple):
    """What an agent answered to a hello, and when: loop times, its clock in between."""

    agent: str
    epoch: int
    hello: dict[str, Any]
    clock: float
    begun: float
    at: float


class Caller:
    """Calls one camera's agent.

    Args:
        name: the camera's, for texts.
        camera: the camera's name in the fleet.
        program: whose calls they are.
        counters: count the messages.
        on_met: is told of an agent that has answered, before anything else is called.
        on_lost: is told why it is gone.

    Attributes:
        met: the agent, None while there is none.
        trouble: why there is none.
        end: why there will be none any more.
        linked: whether the agent has a session with the camera, as far as it has said.
    """

    def __init__(
        self,
        name: str,
        camera: str,
        program: Program,
        counters: Counters,
        on_met: Callable[[Met], None],
        on_lost: Callable[[LinkError], None],
    ) -> None:
        self.name: str = name
        self.camera: str = camera
        self.program: Program = program
        self.counters: Counters = counters
        self.met: Met | None = None
        self.trouble: LinkError | None = None
        self.end: LinkError | None = None
        self.linked: bool = False
        self._epochs: dict[str, int] = {}  # of agents that were met
        self._on_met, self._on_lost = on_met, on_lost
        self._agents: dict[str, None] = {}
        self._stirred = asyncio.Event()
        self._watch: Handle | None = None
        self._task: asyncio.Task[None] | None = None
        self._ahead = 0.0  # the agent's clock is at least so far ahead of the loop's
        self._measured = 0.0
        self._most = math.inf  # and at most so far
        self._bounded = 0.0
        self._insisting: set[asyncio.Task[None]] = set()

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Look for the agent from now on."""
        keys, bus = self.program.keys, self.program.bus
        self._watch = bus.watch(keys.camera("*", self.camera), self._on_presence)
        self._task = asyncio.get_running_loop().create_task(
            self._attend(), name=f"smartcam.fleet.{self.camera}"
        )

    async def close(self, error: LinkError | None = None) -> None:
        """Look for it no more. Idempotent."""
        self.finish(error or ConnectionClosedError(f"{self.name}: the connection is closed"))
        if self._watch is not None:
            self._watch.close()
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        await asyncio.gather(*self._insisting)  # what they wait for has failed

    def finish(self, error: LinkError) -> None:
        """There will be no agent any more."""
        if self.end is None:
            self.end = error
        self.met = None
        self.program.fail(self, lambda: error)

    # ------------------------------------------------------------------ the agent

    def require(self) -> Met:
        """Return the agent.

        Raises:
            ConnectionLostError: it is away.
            ConnectionClosedError: not opened, or closed.
        """
        if self.met is not None:
            return self.met
        if self.end is not None:
            raise self.end.with_traceback(None)
        if self.trouble is not None:
            identity = self.program.bus.identity
            if identity is not None and identity.expired:
                raise ConnectionLostError(f"{self.trouble}; {identity.expired}") from self.trouble
            raise self.trouble.with_traceback(None)
        if self._task is not None:
            raise ConnectionLostError(f"{self.name}: no agent has answered yet")
        raise ConnectionClosedError(f"{self.name}: not connected: open it first")

    def _on_presence(self, key: str, present: bool) -> None:
        agent = self.program.keys.tail(key, "presence/camera")[0]
        if present:
            self._agents[agent] = None
        else:
            self._agents.pop(agent, None)
            if self.met is not None and self.met.agent == agent:
                self.lose(f"the agent {agent} is gone, or the way to it")
        self._stirred.set()

    def lose(self, why: str) -> None:
        """The agent is gone: every call under way ends, and nobody knows what became of it."""
        if self.met is None:
            return
        self.met, self.linked = None, False
        error = self.trouble = ConnectionLostError(f"{self.name}: {why}")
        self.program.fail(self, lambda: _unknown(error))
        self._stirred.set()
        self._on_lost(error)

    async def _attend(self) -> None:
        """Meet the agent whenever there is one; of several, the one that has a session."""
        loop, quiet_since = asyncio.get_running_loop(), 0.0
        while True:
            look = None
            if self.met is not None and not self.linked:
                look = LOOK_ELSEWHERE if len(self._agents) > 1 else ASK_ANEW
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(look):
                    await self._stirred.wait()
                    quiet_since = loop.time()
            self._stirred.clear()
            met = self.met
            if met is not None and self.linked:
                continue
            if met is not None and loop.time() - quiet_since >= ASK_ANEW:
                quiet_since = loop.time()
                await self._ask_anew(met)
                continue
            others = sorted(self._agents.keys() - ({met.agent} if met is not None else set()))
            if not others:
                continue
            try:
                await self._choose(others, met)
            except SmartCamError as error:
                if met is None:
                    self.trouble = ConnectionLostError(f"{self.name}: {error}")
                    if self._agents:
                        await asyncio.sleep(HELLO_TIMEOUT / 10)
                        self._stirred.set()

    async def _choose(self, agents: list[str], met: Met | None) -> None:
        """Meet one of the agents: with several, or instead of another, one that has a session."""
        only_linked = met is not None
        heard: list[_HelloHeard] = []
        failed: SmartCamError | None = None
        for agent in agents:
            try:
                heard.append(await self._say_hello(agent))
            except SmartCamError as error:
                failed = error
                continue
            if heard[-1].hello.get("connected") and not heard[-1].hello.get("trying"):
                break  # a camera has one session
        if self.met is not met:
            return  # it came or went meanwhile
        if not heard:
            if failed is not None:
                raise failed
            return
        best = heard[-1] if heard[-1].hello.get("connected") else heard[0]
        if only_linked and not best.hello.get("connected"):
            return
        if met is not None:
            self.lose(f"the agent {met.agent} has no session with the camera, {best.agent} has one")
        self._meet(best)

    async def _ask_anew(self, met: Met) -> None:
        """Meet the agent again if it has a session by now."""
        with contextlib.suppress(SmartCamError):
            heard = await self._say_hello(met.agent)
            if self.met is met and not self.linked and heard.hello.get("connected"):
                self._meet(heard)

    async def _say_hello(self, agent: str) -> _HelloHeard:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        reply = await self._exchange("hello", begun + HELLO_TIMEOUT, agent)
        fields = reply.fields
        try:
            epoch, clock = int(fields["epoch"]), float(fields["clock"])
            hello = dict(fields["answer"])
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"the agent {agent} says no proper hello: {exc}") from exc
        return _HelloHeard(agent, epoch, hello, clock, begun, loop.time())

    def _meet(self, heard: _HelloHeard) -> None:
        self._ahead, self._measured = heard.clock - heard.at, heard.at
        self._most = math.inf
        self.bound(heard.clock, heard.begun)
        if heard.agent in self._agents:
            self._epochs[heard.agent] = heard.epoch
            if len(self._epochs) > MOST_EPOCHS:
                del self._epochs[next(iter(self._epochs))]
            self.met = Met(heard.agent, heard.epoch, heard.hello)
            self.trouble = None
            self._on_met(self.met)

    def restarted(self, epoch: int) -> bool:
        """Whether a newer start of the agent that was met says something, and no other agent."""
        met = self.met
        if met is None or epoch <= met.epoch or len(self._agents) > 1:
            return False
        return all(one != epoch for agent, one in self._epochs.items() if agent != met.agent)

    def unlink(self) -> None:
        """The agent has no session with the camera: another one may have, or it will again."""
        self.linked = False
        self._stirred.set()

    # ------------------------------------------------------------------ the clock

    def sample(self, clock: float) -> None:
        """The agent said just now what its clock was when it spoke."""
        now = asyncio.get_running_loop().time()
        least = self._ahead - DRIFT * (now - self._measured)
        self._ahead, self._measured = max(least, clock - now), now

    def bound(self, clock: float, said: float) -> None:
        """The agent's clock said ``clock`` after it had heard what was said at a time of ours."""
        now = asyncio.get_running_loop().time()
        most = self._most + DRIFT * (now - self._bounded)
        self._most, self._bounded = min(most, clock - said), now

    def here(self, clock: float) -> tuple[float, float]:
        """Return between which times of the loop's it was when the agent's clock said ``clock``."""
        if self.program.bus.local:
            return clock, clock
        now = asyncio.get_running_loop().time()
        least = self._ahead - DRIFT * max(0.0, now - self._measured)
        most = max(least, self._most + DRIFT * max(0.0, now - self._bounded))
        return clock - most, clock - least

    def clock_at_most(self, at: float) -> float:
        """Return what the agent's clock says at a time of the loop's: that, or a little more."""
        self.require()
        earliest, _ = self.here(0.0)
        return at - earliest

    def clock(self, at: float) -> float:
        """Return what the agent's clock says at a time of the loop's: that, or a little less."""
        return at + self._ahead - DRIFT * max(0.0, at - self._measured)

    # ------------------------------------------------------------------ calls

    async def call(
        self,
        do: str,
        deadline: float,
        arguments: dict[str, Any] | None = None,
        blobs: Sequence[bytes] = (),
        number: int | None = None,
        timeout: float | None = None,
    ) -> BusMessage:
        """Have something done by the agent; return its reply.

        Args:
            do: what.
            deadline: loop time.
            arguments: by name.
            blobs: byte strings that belong to it.
            number: of the call; the next one by default.
            timeout: seconds that the user gave; what there is until ``deadline`` by default.

        Raises:
            SmartCamError: as the agent says; or the agent is gone, or silent.

        Cancellation: the agent is told.
        """
        met = self.require()
        reply = await self._exchange(
            do, deadline, met.agent, met, arguments, blobs, number, timeout
        )
        self.sample(float(reply.fields.get("clock", -1e300)))
        return reply

    async def _exchange(
        self,
        do: str,
        deadline: float,
        agent: str,
        met: Met | None = None,
        arguments: dict[str, Any] | None = None,
        blobs: Sequence[bytes] = (),
        number: int | None = None,
        timeout: float | None = None,
    ) -> BusMessage:
        begun = asyncio.get_running_loop().time()
        number = number or self.program.next_call()
        fields: dict[str, Any] = {
            "program": self.program.name,
            "call": number,
            "do": do,
            "arguments": arguments or {},
        }
        if met is not None:
            timeout = deadline - begun if timeout is None else timeout
            fields |= {"epoch": met.epoch, "deadline": self.clock(deadline), "timeout": timeout}
            deadline += grace(timeout)
        reply = await self._ask(do, number, encode(fields, blobs), begun, deadline, agent, met)
        if not isinstance(reply, BusMessage):
            raise RemoteProtocolError(f"{self.name}: the agent {agent} answers {do} as a trigger")
        return reply

    async def trigger(
        self,
        request: TriggerRequest,
        application: int | None,
        expected: int | None,
        number: int,
        timeout: float,
    ) -> TriggerReply:
        """Have the agent trigger; return its reply.

        Args:
            request: what the trigger is to do.
            application: have this one running for it.
            expected: the one that its results are to be of.
            number: of the call.
            timeout: seconds.

        Raises:
            SmartCamError: as :meth:`call`.

        Cancellation: the agent is told.
        """
        met = self.require()
        begun = asyncio.get_running_loop().time()
        deadline = begun + timeout
        interpretation = request.interpretation
        order = TriggerOrder(
            number,
            met.epoch,
            self.clock(deadline),
            timeout,
            application,
            expected,
            request.results,
            request.wait,
            interpretation.by_application,
            request.input_data,
            interpretation.numbered_layouts(),
        )
        payload = encode_order(self.program.name, order)
        reply = await self._ask(
            "trigger", number, payload, begun, deadline + grace(timeout), met.agent, met
        )
        if not isinstance(reply, TriggerReply):
            raise RemoteProtocolError(f"{self.name}: the agent's reply has no results")
        self.sample(reply.clock)
        return reply

    async def _ask(
        self,
        do: str,
        number: int,
        payload: bytes,
        begun: float,
        deadline: float,
        agent: str,
        met: Met | None,
    ) -> Reply:
        """Say a call, and return the reply to it; ``deadline`` is this side's."""
        self._check_allowed(do)
        program, key = self.program, self._key(agent, do)
        waiting = program.expect(number, self)
        timer = asyncio.get_running_loop().call_at(deadline, _expire, waiting)
        try:
            self.counters.bytes_sent += program.put(key, payload)
            self.counters.frames_sent += 1
            reply = await waiting
        except TimeoutError as exc:
            self._cancel(key, number)
            raise self._silence(do, deadline - begun) from exc
        except asyncio.CancelledError:
            self._cancel(key, number)
            raise
        finally:
            timer.cancel()
            program.forget(number)
        self.counters.frames_received += 1
        if isinstance(reply, TriggerReply):
            return reply
        if reply.fields.get("stranger") and self.met is met and met is not None:
            self.lose(f"the agent {met.agent} was restarted, or took this program for gone")
        if "error" in reply.fields:
            raise from_fields(reply.fields["error"])
        return reply

    def tell(self, do: str, arguments: dict[str, Any]) -> None:
        """Have something done without waiting for it, if there is an agent."""
        if self.met is not None and self._allowed(do):
            fields = {"do": do, "arguments": arguments, "epoch": self.met.epoch}
            self._insist(self._key(self.met.agent, do), fields)

    def come(self, number: int, offset: int | None) -> None:
        """Say up to where the frame of a call has come; None: no more of it is wanted."""
        if self.met is not None:
            fields = {"call": number, "come": offset}
            self.program.send(self._key(self.met.agent, "frame"), fields)

    def _cancel(self, key: str, number: int) -> None:
        self._insist(key, {"cancel": number})

    def _insist(self, key: str, fields: dict[str, Any]) -> None:
        """Say what does no harm when it comes twice, now, and until the agent says it has it.

        An agent that is gone, or has been, knows nothing any more that would have to end.
        """
        program, met = self.program, self.met

        def say() -> tuple[int, asyncio.Future[Reply]]:
            number = program.next_call()
            program.send(key, {"call": number, **fields})
            return number, program.expect(number, self)

        async def repeat(number: int, answer: asyncio.Future[Reply]) -> None:
            while True:
                try:
                    async with asyncio.timeout(INSIST_AFTER):
                        await answer
                except TimeoutError:
                    if self.met is not met or met is None:
                        return
                except SmartCamError:
                    return
                else:
                    return
                finally:
                    program.forget(number)
                number, answer = say()

        task = asyncio.get_running_loop().create_task(
            repeat(*say()), name=f"smartcam.fleet.{self.camera}.insist"
        )
        self._insisting.add(task)
        task.add_done_callback(self._insisting.discard)

    def _allowed(self, do: str) -> bool:
        identity = self.program.bus.identity
        return do not in COMMANDS or identity is None or may_command(identity.role)

    def _check_allowed(self, do: str) -> None:
        """Refuse what the bus would swallow.

        Raises:
            NotAllowedError: the role of this program's certificate forbids it.
        """
        identity = self.program.bus.identity
        if identity is not None and not self._allowed(do):
            what = SWITCHES.get(do, do)
            raise NotAllowedError(
                f"{self.name}: {what} is a command, and this program's certificate is that of "
                f"{identity}, who may look; nothing was sent",
                role=identity.role,
                certificate=identity.name,
            )

    def _perhaps(self, do: str) -> str:
        """Return what else silence may mean."""
        identity = self.program.bus.identity
        if identity is None:
            return ""
        return f"; nobody is there, or {do} is not allowed for {identity}"

    def _key(self, agent: str, do: str) -> str:
        return self.program.keys.call(agent, self.camera, command=do in COMMANDS)

    def _silence(self, do: str, waited: float) -> SmartCamError:
        agent = self.met.agent if self.met is not None else "agent"
        if do == "trigger":
            return TriggerTimeoutError(
                f"{self.name}: the {agent} said nothing within {waited:.3g} s; whether the camera "
                f"was triggered is unknown{self._perhaps(do)}",
                waited=waited,
            )
        return ResponseTimeoutError(
            f"{self.name}: the {agent} said nothing to {do} within {waited:.3g} s; whether it was "
            f"done is unknown{self._perhaps(do)}",
            waited=waited,
        )


def _expire(waiting: asyncio.Future[Reply]) -> None:
    if not waiting.done():
        waiting.set_exception(TimeoutError())


def _unknown(error: LinkError) -> LinkError:
    return ConnectionLostError(f"{error}; whether what was under way was done is unknown")
