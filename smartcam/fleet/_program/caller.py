"""Find and call the agent of a fleet's camera; track its presence and its clock."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client._inside import new_tuple
from smartcam.exceptions import (
    ConnectionClosedError,
    ConnectionLostError,
    LinkError,
    NotAllowedError,
    RemoteProtocolError,
    ReservationLostError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet._bus.errors import from_fields
from smartcam.fleet._bus.keys import COMMANDS, FENCED
from smartcam.fleet._bus.wire import (
    BusMessage,
    TriggerOrder,
    TriggerReply,
    encode,
    encode_order,
    grace,
)
from smartcam.fleet._security.certificates import may_command

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam._client._inside import Outcome, TriggerRequest
    from smartcam.fleet._bus.bus import Handle
    from smartcam.fleet._program.program import Program, Reply
    from smartcam.protocols._inside import Counters

MAX_DRIFT_RATIO = 1e-4
"""Largest drift between two clocks, seconds per second."""

HELLO_TIMEOUT = 2.0
"""Seconds for the answer to a hello, which is then sent again while the agent is present."""


SWITCHES = {"ensure": "switch_application", "enter": "switch_application"}
"""Names of calls in texts for users, if they differ from the call's own."""
OTHER_AGENT_INTERVAL = 0.25
"""Seconds between two searches for another agent with a session, if the current agent has none."""

SESSION_QUESTION_INTERVAL = 5.0
"""Seconds between two questions to an agent without a session whether it has one now: its message
may be lost, and a camera without triggers causes no further ones."""

MAX_AGENTS_REMEMBERED = 16
"""Largest number of agents of a camera that are remembered."""

RESEND_DELAY = 1.0
"""Seconds until an unconfirmed message, which may be lost, is sent again."""


class Met:
    """An agent that has answered.

    Attributes:
        agent: name of the agent.
        epoch: number of the agent's start.
        hello: fields on the camera in the agent's answer.
    """

    def __init__(self, agent: str, epoch: int, hello: dict[str, Any]) -> None:
        self.agent: str = agent
        self.epoch: int = epoch
        self.hello: dict[str, Any] = hello


class Lease:
    """A reservation whose block has not ended.

    Attributes:
        epoch: number of the start of the agent that made the reservation.
        lost: reason why the reservation is lost; empty while no loss is known.
        reported: whether an event has reported the loss.
    """

    __slots__ = ("epoch", "lost", "reported")

    def __init__(self, epoch: int) -> None:
        self.epoch: int = epoch
        self.lost: str = ""
        self.reported: bool = False


class _HelloHeard(NamedTuple):
    """An agent's answer to a hello, with the loop times before and after its clock's time."""

    agent: str
    epoch: int
    hello: dict[str, Any]
    clock: float
    begun: float
    at: float


class Caller:
    """Calls one camera's agent.

    Args:
        name: the camera's name, for texts.
        camera: the camera's name in the fleet.
        program: program that makes the calls.
        counters: counters of the messages.
        on_met: callback for an agent that has answered, before any other call.
        on_lost: callback for the loss of the agent, with its error.
        on_lease_lost: callback for the loss of this program's reservations, once for each loss.

    Attributes:
        met: the agent; None while there is none.
        trouble: reason why there is no agent.
        end: reason why there will be no further agent.
        linked: whether the agent had a session with the camera when it last reported.
        leases: the reservations whose blocks run, oldest first, by the calls that made them.
        streamed: whether this program takes all results of the camera.
    """

    def __init__(
        self,
        name: str,
        camera: str,
        program: Program,
        counters: Counters,
        on_met: Callable[[Met], None],
        on_lost: Callable[[LinkError], None],
        on_lease_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self._on_lease_lost = on_lease_lost
        self.name: str = name
        self.camera: str = camera
        self.program: Program = program
        self.counters: Counters = counters
        self.met: Met | None = None
        self.trouble: LinkError | None = None
        self.end: LinkError | None = None
        self.linked: bool = False
        self.leases: dict[int, Lease] = {}
        self.streamed: bool = False
        self._commands_to = "", ""  # the agent of the last call, and the key of commands to it
        self._epochs: dict[str, int] = {}  # epochs of agents that have answered
        self._on_met, self._on_lost = on_met, on_lost
        self._agents: dict[str, None] = {}
        self._stirred = asyncio.Event()
        self._watch: Handle | None = None
        self._task: asyncio.Task[None] | None = None
        self._ahead = 0.0  # least seconds by which the agent's clock is ahead of the loop's
        self._measured = 0.0
        self._most = math.inf  # most seconds by which the agent's clock is ahead
        self._bounded = 0.0
        self._removed = ""  # reason why the current agent no longer shares the camera
        self._insisting: set[asyncio.Task[None]] = set()

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Start looking for the agent."""
        keys, bus = self.program.keys, self.program.bus
        self._watch = bus.watch(keys.camera("*", self.camera), self._on_presence)
        self._task = asyncio.get_running_loop().create_task(
            self._attend(), name=f"smartcam.fleet.{self.camera}"
        )

    async def close(self, error: LinkError | None = None) -> None:
        """Stop looking for the agent. Idempotent."""
        self.finish(error or ConnectionClosedError(f"{self.name}: the connection is closed"))
        if self._watch is not None:
            self._watch.close()
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        if self._insisting:
            # repeated messages wait for answers that have failed
            await asyncio.wait(self._insisting)

    def finish(self, error: LinkError) -> None:
        """End for good: there will be no further agent."""
        if self.end is None:
            self.end = error
        self.met = None
        self.program.fail(self, lambda: error)

    # ------------------------------------------------------------------ the agent

    def require(self) -> Met:
        """Return the agent.

        Raises:
            ConnectionLostError: there is no agent now.
            ConnectionClosedError: the caller is not open, or closed.
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
            self._stirred.set()
        else:
            self.agent_left(agent)

    def agent_left(self, agent: str) -> None:
        """End the calls of an agent that no longer shares the camera. Idempotent."""
        self._agents.pop(agent, None)
        if self.met is not None and self.met.agent == agent:
            why = self._removed
            gone = f"the agent {agent} is gone, or the way to it"
            self.lose(f"the agent {agent} shares the camera no more: {why}" if why else gone)
        self._stirred.set()

    def removed(self, why: str) -> None:
        """Note why the agent no longer shares the camera; the agent's presence ends next."""
        self._removed = why

    def lose(self, why: str) -> None:
        """End every running call with an unknown outcome, since the agent was lost."""
        if self.met is None:
            return
        self.met, self.linked = None, False
        error = self.trouble = ConnectionLostError(f"{self.name}: {why}")
        self.program.fail(self, lambda: _unknown_outcome_error(error))
        self._stirred.set()
        self._on_lost(error)

    async def _attend(self) -> None:
        """Connect to an agent whenever there is one; of several, to the agent with a session."""
        loop, quiet_since = asyncio.get_running_loop(), 0.0
        while True:
            look = None
            if self.met is not None and not self.linked:
                look = OTHER_AGENT_INTERVAL if len(self._agents) > 1 else SESSION_QUESTION_INTERVAL
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(look):
                    await self._stirred.wait()
                    quiet_since = loop.time()
            self._stirred.clear()
            met = self.met
            if met is not None and self.linked:
                continue
            if met is not None and loop.time() - quiet_since >= SESSION_QUESTION_INTERVAL:
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
        """Choose an agent, if possible with a session; it may replace the current one."""
        only_linked = met is not None
        replies: list[_HelloHeard] = []
        failed: SmartCamError | None = None
        for agent in agents:
            try:
                replies.append(await self._greet_agent(agent))
            except SmartCamError as error:
                failed = error
                continue
            if replies[-1].hello.get("connected") and not replies[-1].hello.get("trying"):
                break  # a camera has one session
        if self.met is not met:
            return  # an agent appeared or disappeared
        if not replies:
            if failed is not None:
                raise failed
            return
        best = replies[-1] if replies[-1].hello.get("connected") else replies[0]
        if only_linked and not best.hello.get("connected"):
            return
        if met is not None:
            self.lose(f"the agent {met.agent} has no session with the camera, {best.agent} has one")
        self._meet(best)

    async def _ask_anew(self, met: Met) -> None:
        """Ask the agent again, and take its state if it has a session now."""
        with contextlib.suppress(SmartCamError):
            reply = await self._greet_agent(met.agent)
            if self.met is met and not self.linked and reply.hello.get("connected"):
                self._meet(reply)

    async def _greet_agent(self, agent: str) -> _HelloHeard:
        loop = asyncio.get_running_loop()
        begun = loop.time()
        reply = await self._exchange("hello", begun + HELLO_TIMEOUT, agent)
        fields = reply.fields
        try:
            epoch, clock = int(fields["epoch"]), float(fields["clock"])
            hello = dict(fields["answer"])
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"the agent {agent} sent an invalid hello: {exc}") from exc
        return _HelloHeard(agent, epoch, hello, clock, begun, loop.time())

    def _meet(self, reply: _HelloHeard) -> None:
        self._ahead, self._measured = reply.clock - reply.at, reply.at
        self._most = math.inf
        self.bound(reply.clock, reply.begun)
        if reply.agent in self._agents:
            self._epochs[reply.agent] = reply.epoch
            if len(self._epochs) > MAX_AGENTS_REMEMBERED:
                del self._epochs[next(iter(self._epochs))]
            self.met = Met(reply.agent, reply.epoch, reply.hello)
            self._removed = ""
            self.trouble = None
            self._on_met(self.met)

    def restarted(self, epoch: int) -> bool:
        """Return True if an epoch belongs to a newer start of the current agent."""
        met = self.met
        if met is None or epoch <= met.epoch or len(self._agents) > 1:
            return False
        return all(known != epoch for agent, known in self._epochs.items() if agent != met.agent)

    def unlink(self) -> None:
        """Note that the agent has no session, and look for an agent that has one."""
        self.linked = False
        self._stirred.set()

    # ------------------------------------------------------------------ the clock

    def sample(self, clock: float) -> None:
        """Use the agent's time in a message that has just arrived for its clock."""
        now = asyncio.get_running_loop().time()
        least = self._ahead - MAX_DRIFT_RATIO * (now - self._measured)
        self._ahead, self._measured = max(least, clock - now), now

    def bound(self, clock: float, sent: float) -> None:
        """Bound the agent's clock, which showed ``clock`` after a message from this program."""
        now = asyncio.get_running_loop().time()
        most = self._most + MAX_DRIFT_RATIO * (now - self._bounded)
        self._most, self._bounded = min(most, clock - sent), now

    def here(self, clock: float) -> tuple[float, float]:
        """Return the loop's times between which the agent's clock showed ``clock``."""
        if self.program.bus.local:
            return clock, clock
        now = asyncio.get_running_loop().time()
        least = self._ahead - MAX_DRIFT_RATIO * max(0.0, now - self._measured)
        most = max(least, self._most + MAX_DRIFT_RATIO * max(0.0, now - self._bounded))
        return clock - most, clock - least

    def clock_at_most(self, at: float) -> float:
        """Return the agent's time at a time of the loop's clock, or one a little later."""
        self.require()
        earliest, _ = self.here(0.0)
        return at - earliest

    def clock(self, at: float) -> float:
        """Return the agent's time at a time of the loop's clock, or one a little earlier."""
        return at + self._ahead - MAX_DRIFT_RATIO * max(0.0, at - self._measured)

    # ------------------------------------------------------------------ reservations

    def lease(self, number: int) -> Lease:
        """Return a reservation of this program whose block runs.

        Raises:
            ReservationLostError: the reservation is known to be lost.
        """
        lease, met = self.leases[number], self.met
        if not lease.lost and met is not None and met.epoch != lease.epoch:
            why = f"the agent {met.agent} has the camera now, which was started since"
            self.lose_lease(number, why)
        if lease.lost:
            raise ReservationLostError(
                f"{self.name}: the reservation was lost: {lease.lost}; commands of others may have "
                "come between"
            )
        return lease

    def lose_lease(self, number: int, why: str) -> None:
        """Note that a reservation is lost; later commands of its block are refused."""
        self.leases[number].lost = why
        self.report_leases_lost()

    def report_leases_lost(self) -> None:
        """Report that this program's reservations are lost, unless that was reported before."""
        unreported = [lease for lease in self.leases.values() if not lease.reported]
        for lease in unreported:
            lease.reported = True
        if unreported:
            self._on_lease_lost()

    def look_at_leases(self) -> None:
        """Check whether reservations are lost, now that an agent has answered."""
        for number in self.leases:
            with contextlib.suppress(ReservationLostError):
                self.lease(number)

    def _fence(self, do: str) -> int | None:
        """Return the oldest reservation whose block makes the call; None without one.

        Raises:
            ReservationLostError: one of the reservations is lost; nothing was sent.
        """
        if not self.leases or do not in FENCED:
            return None
        for number in self.leases:
            self.lease(number)
        return next(iter(self.leases))

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
        """Make a call at the agent; return its reply.

        Args:
            do: name of the call.
            deadline: loop time.
            arguments: arguments of the call, by name.
            blobs: byte strings that belong to the call.
            number: number of the call; the next one by default.
            timeout: seconds that the user gave; by default the time until ``deadline``.

        Raises:
            SmartCamError: the agent replied with this error, was lost, or did not answer.

        Cancellation: the agent receives a cancelling message.
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
            "program": self.program.token,
            "call": number,
            "do": do,
            "arguments": arguments or {},
        }
        if met is not None:
            timeout = deadline - begun if timeout is None else timeout
            fields |= {"epoch": met.epoch, "deadline": self.clock(deadline), "timeout": timeout}
            if (reservation := self._fence(do)) is not None:
                fields["reservation"] = reservation
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
        deadline: float,
        timeout: float,
    ) -> TriggerReply:
        """Trigger by the agent; return its reply.

        Args:
            request: options of the trigger.
            application: application that must run for the trigger; None for any.
            expected: application whose results are expected; None for any.
            number: number of the call.
            deadline: loop time.
            timeout: seconds that the user gave.

        Raises:
            SmartCamError: like :meth:`call`.

        Cancellation: the agent receives a cancelling message.
        """
        met = self.require()
        interpretation = request.interpretation
        order: TriggerOrder = new_tuple(
            TriggerOrder,
            (
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
                self._fence("trigger"),
            ),
        )
        payload = encode_order(self.program.token, order)
        begun, until = deadline - timeout, deadline + grace(timeout)
        reply = await self._ask("trigger", number, payload, begun, until, met.agent, met)
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
        """Send a call, and return the reply; ``deadline`` is this side's."""
        self._check_allowed(do)
        program, key = self.program, self._key(agent, do)
        waiting = program.expect(number, self, deadline)
        try:
            self.counters.bytes_sent += program.put(key, payload)
            self.counters.frames_sent += 1
            reply: Reply = await waiting
        except TimeoutError as exc:
            self._cancel(key, number)
            raise self._silence_error(do, deadline - begun) from exc
        except asyncio.CancelledError:
            self._cancel(key, number)
            raise
        finally:
            program.forget(number)
        self.counters.frames_received += 1
        if isinstance(reply, TriggerReply):
            return reply
        if reply.fields.get("stranger") and self.met is met and met is not None:
            self.lose(f"the agent {met.agent} was restarted, or took this program for gone")
        if "error" in reply.fields:
            error = from_fields(reply.fields["error"])
            if isinstance(error, ReservationLostError) and self.leases:
                self.lose_lease(next(iter(self.leases)), "its agent reported it")
            raise error
        return reply

    def notify(self, do: str, arguments: dict[str, Any]) -> None:
        """Make a call without waiting for it, if there is an agent."""
        if self.met is not None and self._allowed(do):
            fields = {"do": do, "arguments": arguments, "epoch": self.met.epoch}
            self._insist(self._key(self.met.agent, do), fields)

    def come(self, number: int, offset: int | None) -> None:
        """Report the number of received bytes of a call's frame; None: send no further bytes."""
        if self.met is not None:
            fields = {"call": number, "come": offset}
            self.program.send(self._key(self.met.agent, "frame"), fields)

    def _cancel(self, key: str, number: int) -> None:
        self._insist(key, {"cancel": number})

    def _insist(self, key: str, fields: dict[str, Any]) -> None:
        """Send a message now, and repeatedly until the agent confirms it.

        A lost agent has already ended the program's work.
        """
        program, met = self.program, self.met

        def send() -> tuple[int, Outcome]:
            number = program.next_call()
            program.send(key, {"call": number, **fields})
            return number, program.expect(number, self)

        async def repeat(number: int, answer: Outcome) -> None:
            while True:
                try:
                    async with asyncio.timeout(RESEND_DELAY):
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
                number, answer = send()

        task = asyncio.get_running_loop().create_task(
            repeat(*send()), name=f"smartcam.fleet.{self.camera}.insist"
        )
        self._insisting.add(task)
        task.add_done_callback(self._insisting.discard)

    def _allowed(self, do: str) -> bool:
        identity = self.program.bus.identity
        return do not in COMMANDS or identity is None or may_command(identity.role)

    def _check_allowed(self, do: str) -> None:
        """Refuse a call that the bus would drop silently.

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
        """Return a text on another possible reason for silence; empty if there is none."""
        identity = self.program.bus.identity
        if identity is None:
            return ""
        return f"; nobody is there, or {do} is not allowed for {identity}"

    def _key(self, agent: str, do: str) -> str:
        program, camera = self.program, self.camera
        if do in COMMANDS:
            if self._commands_to[0] != agent:
                self._commands_to = agent, program.keys.command(agent, camera)
            return self._commands_to[1]
        return program.keys.ask(program.role, agent, camera)

    def _silence_error(self, do: str, waited: float) -> SmartCamError:
        agent = "the agent" if self.met is None else f"the agent {self.met.agent}"
        if do == "trigger":
            return TriggerTimeoutError(
                f"{self.name}: {agent} did not answer within {waited:.3g} s; whether the camera "
                f"was triggered is unknown{self._perhaps(do)}",
                waited=waited,
            )
        return ResponseTimeoutError(
            f"{self.name}: {agent} did not answer {do} within {waited:.3g} s; whether it was "
            f"done is unknown{self._perhaps(do)}",
            waited=waited,
        )


def _unknown_outcome_error(error: LinkError) -> LinkError:
    return ConnectionLostError(f"{error}; whether what was under way was done is unknown")
