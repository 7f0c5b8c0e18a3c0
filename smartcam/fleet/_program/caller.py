"""Find the agent of a fleet's camera, make calls to it, and estimate the agent's clock."""

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
from smartcam.fleet._bus.keys import COMMANDS, COMMANDS_WITH_RESERVATION
from smartcam.fleet._bus.wire import (
    BusMessage,
    TriggerCall,
    TriggerReply,
    encode,
    encode_trigger,
    reply_grace,
)
from smartcam.fleet._security.certificates import may_command

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam._client._inside import AnyFuture, TriggerRequest
    from smartcam.fleet._bus.bus import Handle
    from smartcam.fleet._program.program import Program, Reply
    from smartcam.protocols._inside import Counters

MAX_DRIFT_RATIO = 1e-4
"""Largest drift between the program's and the agent's clock, seconds per second."""

HELLO_TIMEOUT = 2.0
"""Seconds for the answer to a hello (a program's first call to an agent). After that, the hello is
sent again if the agent is still present."""


PUBLIC_NAMES = {
    "ensure_application": "switch_application",
    "enter_application": "switch_application",
}
"""Public names of calls that have another name on the bus, for error texts."""

OTHER_AGENT_INTERVAL = 0.25
"""Seconds between two searches for an agent that has a session, while the current agent has
none."""

SESSION_QUESTION_INTERVAL = 5.0
"""Seconds between two questions to an agent whether it has a session by now. The agent's message
about a new session may be lost, and a camera that is not triggered causes no further messages."""

MAX_AGENTS_REMEMBERED = 16
"""Largest number of agents of a camera that are remembered."""

RESEND_DELAY = 1.0
"""Seconds until an unconfirmed message, which may be lost, is sent again."""


class CameraAgent:
    """The agent that answers for a camera.

    Attributes:
        name: name of the agent.
        epoch: number of the agent's start.
        hello: fields about the camera in the agent's answer.
    """

    def __init__(self, name: str, epoch: int, hello: dict[str, Any]) -> None:
        self.name: str = name
        self.epoch: int = epoch
        self.hello: dict[str, Any] = hello


class Lease:
    """A reservation of the camera by this program, while its ``async with`` block runs.

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


class _HelloReply(NamedTuple):
    """An agent's answer to a hello: its clock's time, and the loop times of question and answer."""

    agent: str
    epoch: int
    hello: dict[str, Any]
    clock: float
    asked_at: float
    answered_at: float


class Caller:
    """Calls one camera's agent.

    Args:
        name: the camera's name, for texts.
        camera: the camera's name in the fleet.
        program: program that makes the calls.
        counters: counters of the messages.
        on_agent_found: callback for an agent that has answered the hello, before other calls.
        on_lost: callback for the loss of the agent, with its error.
        on_lease_lost: callback for the loss of this program's reservations, once for each loss.

    Attributes:
        agent: the agent that answered; None while there is none.
        no_agent_error: reason why there is no agent now.
        final_error: reason why there will be no further agent.
        has_session: whether the agent had a session with the camera when it last reported.
        leases: the reservations whose blocks run, oldest first, by the numbers of their calls.
        streams_results: whether this program subscribes to all results of the camera.
    """

    def __init__(
        self,
        name: str,
        camera: str,
        program: Program,
        counters: Counters,
        on_agent_found: Callable[[CameraAgent], None],
        on_lost: Callable[[LinkError], None],
        on_lease_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self._on_lease_lost = on_lease_lost
        self.name: str = name
        self.camera: str = camera
        self.program: Program = program
        self.counters: Counters = counters
        self.agent: CameraAgent | None = None
        self.no_agent_error: LinkError | None = None
        self.final_error: LinkError | None = None
        self.has_session: bool = False
        self.leases: dict[int, Lease] = {}
        self.streams_results: bool = False
        self._command_key = "", ""  # the agent of the last command, and the key of commands to it
        self._epochs: dict[str, int] = {}  # epoch of each agent that has answered
        self._on_agent_found, self._on_lost = on_agent_found, on_lost
        self._agents: dict[str, None] = {}  # present agents that share the camera
        self._changed = asyncio.Event()
        self._presence_watch: Handle | None = None
        self._task: asyncio.Task[None] | None = None
        self._min_clock_lead = (
            0.0  # least number of seconds by which the agent's clock is ahead of the loop's
        )
        self._min_lead_at = 0.0
        self._max_clock_lead = math.inf  # largest number of these seconds
        self._max_lead_at = 0.0
        self._removal_reason = ""  # reason why the current agent no longer shares the camera
        self._resending_tasks: set[asyncio.Task[None]] = set()

    # ------------------------------------------------------------------ open and close

    def open(self) -> None:
        """Start looking for the agent."""
        keys, bus = self.program.keys, self.program.bus
        self._presence_watch = bus.watch(keys.camera("*", self.camera), self._on_presence)
        self._task = asyncio.get_running_loop().create_task(
            self._keep_agent(), name=f"smartcam.fleet.{self.camera}"
        )

    async def close(self, error: LinkError | None = None) -> None:
        """Stop looking for the agent. Idempotent."""
        self.end_for_good(error or ConnectionClosedError(f"{self.name}: the connection is closed"))
        if self._presence_watch is not None:
            self._presence_watch.close()
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        if self._resending_tasks:
            # the futures of their answers have failed, so these tasks end now
            await asyncio.wait(self._resending_tasks)

    def end_for_good(self, error: LinkError) -> None:
        """End all calls, and refuse further ones with this error."""
        if self.final_error is None:
            self.final_error = error
        self.agent = None
        self.program.fail_calls(self, lambda: error)

    # ------------------------------------------------------------------ the agent

    def require(self) -> CameraAgent:
        """Return the agent.

        Raises:
            ConnectionLostError: there is no agent now.
            ConnectionClosedError: the caller is not open, or closed.
        """
        if self.agent is not None:
            return self.agent
        if self.final_error is not None:
            raise self.final_error.with_traceback(None)
        if self.no_agent_error is not None:
            identity = self.program.bus.identity
            if identity is not None and identity.expired_text:
                raise ConnectionLostError(
                    f"{self.no_agent_error}; {identity.expired_text}"
                ) from self.no_agent_error
            raise self.no_agent_error.with_traceback(None)
        if self._task is not None:
            raise ConnectionLostError(f"{self.name}: no agent has answered yet")
        raise ConnectionClosedError(f"{self.name}: not connected: open it first")

    def _on_presence(self, key: str, present: bool) -> None:
        agent = self.program.keys.tail(key, "presence/camera")[0]
        if present:
            self._agents[agent] = None
            self._changed.set()
        else:
            self.agent_left(agent)

    def agent_left(self, agent: str) -> None:
        """End the calls of an agent that no longer shares the camera. Idempotent."""
        self._agents.pop(agent, None)
        if self.agent is not None and self.agent.name == agent:
            reason = self._removal_reason
            lost = f"the agent {agent} is gone, or the way to it"
            removed = f"the agent {agent} shares the camera no more: {reason}"
            self.lose_agent(removed if reason else lost)
        self._changed.set()

    def note_removal(self, reason: str) -> None:
        """Note why the agent will no longer share the camera; :meth:`agent_left` follows."""
        self._removal_reason = reason

    def lose_agent(self, reason: str) -> None:
        """Forget the lost agent, and end every running call with an unknown outcome."""
        if self.agent is None:
            return
        self.agent, self.has_session = None, False
        error = self.no_agent_error = ConnectionLostError(f"{self.name}: {reason}")
        self.program.fail_calls(self, lambda: _unknown_outcome_error(error))
        self._changed.set()
        self._on_lost(error)

    async def _keep_agent(self) -> None:
        """Connect to an agent whenever there is one; prefer an agent that has a session."""
        loop, quiet_since = asyncio.get_running_loop(), 0.0
        while True:
            wait_timeout = None
            if self.agent is not None and not self.has_session:
                wait_timeout = (
                    OTHER_AGENT_INTERVAL if len(self._agents) > 1 else SESSION_QUESTION_INTERVAL
                )
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_timeout):
                    await self._changed.wait()
                    quiet_since = loop.time()
            self._changed.clear()
            current = self.agent
            if current is not None and self.has_session:
                continue
            if current is not None and loop.time() - quiet_since >= SESSION_QUESTION_INTERVAL:
                quiet_since = loop.time()
                await self._greet_again(current)
                continue
            own = set[str]() if current is None else {current.name}
            others = sorted(self._agents.keys() - own)
            if not others:
                continue
            try:
                await self._choose_agent(others, current)
            except SmartCamError as error:
                if current is None:
                    self.no_agent_error = ConnectionLostError(f"{self.name}: {error}")
                    if self._agents:
                        await asyncio.sleep(HELLO_TIMEOUT / 10)
                        self._changed.set()

    async def _choose_agent(self, agents: list[str], current: CameraAgent | None) -> None:
        """Choose an agent, if possible one with a session; it may replace the current agent."""
        needs_session = current is not None
        replies: list[_HelloReply] = []
        failed: SmartCamError | None = None
        for agent in agents:
            try:
                replies.append(await self._greet_agent(agent))
            except SmartCamError as error:
                failed = error
                continue
            if replies[-1].hello.get("connected") and not replies[-1].hello.get("trying"):
                break  # it has a session, and a camera has only one
        if self.agent is not current:
            return  # an agent appeared or disappeared
        if not replies:
            if failed is not None:
                raise failed
            return
        best = replies[-1] if replies[-1].hello.get("connected") else replies[0]
        if needs_session and not best.hello.get("connected"):
            return
        if current is not None:
            self.lose_agent(
                f"the agent {current.name} has no session with the camera, {best.agent} has one"
            )
        self._accept_agent(best)

    async def _greet_again(self, current: CameraAgent) -> None:
        """Send the agent another hello, and use the state in its answer if it has a session now."""
        with contextlib.suppress(SmartCamError):
            reply = await self._greet_agent(current.name)
            if self.agent is current and not self.has_session and reply.hello.get("connected"):
                self._accept_agent(reply)

    async def _greet_agent(self, agent: str) -> _HelloReply:
        loop = asyncio.get_running_loop()
        asked_at = loop.time()
        reply = await self._exchange("hello", asked_at + HELLO_TIMEOUT, agent)
        fields = reply.fields
        try:
            epoch, clock = int(fields["epoch"]), float(fields["clock"])
            hello = dict(fields["answer"])
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"the agent {agent} sent an invalid hello: {exc}") from exc
        return _HelloReply(agent, epoch, hello, clock, asked_at, loop.time())

    def _accept_agent(self, reply: _HelloReply) -> None:
        self._min_clock_lead, self._min_lead_at = reply.clock - reply.answered_at, reply.answered_at
        self._max_clock_lead = math.inf
        self.narrow_clock_lead(reply.clock, reply.asked_at)
        if reply.agent in self._agents:
            self._epochs[reply.agent] = reply.epoch
            if len(self._epochs) > MAX_AGENTS_REMEMBERED:
                del self._epochs[next(iter(self._epochs))]
            self.agent = CameraAgent(reply.agent, reply.epoch, reply.hello)
            self._removal_reason = ""
            self.no_agent_error = None
            self._on_agent_found(self.agent)

    def has_restarted(self, epoch: int) -> bool:
        """Return True if a received epoch shows that the current agent has been started again."""
        current = self.agent
        if current is None or epoch <= current.epoch or len(self._agents) > 1:
            return False
        return all(known != epoch for agent, known in self._epochs.items() if agent != current.name)

    def note_session_end(self) -> None:
        """Note that the agent has no session, and look for an agent that has one."""
        self.has_session = False
        self._changed.set()

    # ------------------------------------------------------------------ the clock

    def sample_clock(self, clock: float) -> None:
        """Improve the estimate of the agent's clock by its time in a message just received."""
        now = asyncio.get_running_loop().time()
        min_lead = self._min_clock_lead - MAX_DRIFT_RATIO * (now - self._min_lead_at)
        self._min_clock_lead, self._min_lead_at = max(min_lead, clock - now), now

    def narrow_clock_lead(self, clock: float, sent_at: float) -> None:
        """Narrow the clock's lead: it showed ``clock`` after a message was sent at ``sent_at``."""
        now = asyncio.get_running_loop().time()
        max_lead = self._max_clock_lead + MAX_DRIFT_RATIO * (now - self._max_lead_at)
        self._max_clock_lead, self._max_lead_at = min(max_lead, clock - sent_at), now

    def local_times(self, clock: float) -> tuple[float, float]:
        """Return the earliest and latest loop time at which the agent's clock showed ``clock``."""
        if self.program.bus.local:
            return clock, clock
        now = asyncio.get_running_loop().time()
        min_lead = self._min_clock_lead - MAX_DRIFT_RATIO * max(0.0, now - self._min_lead_at)
        max_lead = self._max_clock_lead + MAX_DRIFT_RATIO * max(0.0, now - self._max_lead_at)
        return clock - max(min_lead, max_lead), clock - min_lead

    def latest_agent_time(self, at: float) -> float:
        """Return the latest time that the agent's clock can show at a loop time."""
        self.require()
        earliest, _ = self.local_times(0.0)
        return at - earliest

    def earliest_agent_time(self, at: float) -> float:
        """Return the earliest time that the agent's clock can show at a loop time."""
        return at + self._min_clock_lead - MAX_DRIFT_RATIO * max(0.0, at - self._min_lead_at)

    # ------------------------------------------------------------------ reservations

    def require_lease(self, number: int) -> Lease:
        """Return a reservation of this program whose block runs; refuse a lost one.

        Raises:
            ReservationLostError: the reservation is known to be lost.
        """
        lease, current = self.leases[number], self.agent
        if not lease.lost and current is not None and current.epoch != lease.epoch:
            reason = f"its agent is now {current.name}, which was started after the reservation"
            self.lose_lease(number, reason)
        if lease.lost:
            raise ReservationLostError(
                f"{self.name}: the reservation was lost: {lease.lost}; commands of others may have "
                "come between"
            )
        return lease

    def lose_lease(self, number: int, reason: str) -> None:
        """Note that a reservation is lost; later commands of its block are refused."""
        self.leases[number].lost = reason
        self.report_leases_lost()

    def report_leases_lost(self) -> None:
        """Report that this program's reservations are lost, unless that was reported before."""
        unreported = [lease for lease in self.leases.values() if not lease.reported]
        for lease in unreported:
            lease.reported = True
        if unreported:
            self._on_lease_lost()

    def check_leases(self) -> None:
        """Check whether reservations are lost, now that an agent has answered."""
        for number in self.leases:
            with contextlib.suppress(ReservationLostError):
                self.require_lease(number)

    def _reservation_of(self, do: str) -> int | None:
        """Return the number of the oldest reservation that a call uses; None if it uses none.

        Raises:
            ReservationLostError: one of the reservations is lost; nothing was sent.
        """
        if not self.leases or do not in COMMANDS_WITH_RESERVATION:
            return None
        for number in self.leases:
            self.require_lease(number)
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
        agent = self.require()
        reply = await self._exchange(
            do, deadline, agent.name, agent, arguments, blobs, number, timeout
        )
        self.sample_clock(float(reply.fields.get("clock", -1e300)))
        return reply

    async def _exchange(
        self,
        do: str,
        deadline: float,
        agent: str,
        current: CameraAgent | None = None,
        arguments: dict[str, Any] | None = None,
        blobs: Sequence[bytes] = (),
        number: int | None = None,
        timeout: float | None = None,
    ) -> BusMessage:
        asked_at = asyncio.get_running_loop().time()
        number = number or self.program.next_call()
        fields: dict[str, Any] = {
            "program": self.program.token,
            "call": number,
            "do": do,
            "arguments": arguments or {},
        }
        if current is not None:
            timeout = deadline - asked_at if timeout is None else timeout
            fields |= {
                "epoch": current.epoch,
                "deadline": self.earliest_agent_time(deadline),
                "timeout": timeout,
            }
            if (reservation := self._reservation_of(do)) is not None:
                fields["reservation"] = reservation
            deadline += reply_grace(timeout)
        reply = await self._await_reply(
            do, number, encode(fields, blobs), asked_at, deadline, agent, current
        )
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
        current = self.require()
        interpretation = request.interpretation
        call: TriggerCall = new_tuple(
            TriggerCall,
            (
                number,
                current.epoch,
                self.earliest_agent_time(deadline),
                timeout,
                application,
                expected,
                request.results,
                request.wait,
                interpretation.by_application,
                request.input_data,
                interpretation.numbered_layouts(),
                self._reservation_of("trigger"),
            ),
        )
        payload = encode_trigger(self.program.token, call)
        asked_at, reply_deadline = deadline - timeout, deadline + reply_grace(timeout)
        reply = await self._await_reply(
            "trigger", number, payload, asked_at, reply_deadline, current.name, current
        )
        if not isinstance(reply, TriggerReply):
            raise RemoteProtocolError(f"{self.name}: the agent's reply has no results")
        self.sample_clock(reply.clock)
        return reply

    async def _await_reply(
        self,
        do: str,
        number: int,
        payload: bytes,
        asked_at: float,
        deadline: float,
        agent: str,
        current: CameraAgent | None,
    ) -> Reply:
        """Send a call, and wait for the reply until ``deadline``, a time of this program's loop."""
        self._check_allowed(do)
        program, key = self.program, self._key_of_call(agent, do)
        reply_future = program.expect_reply(number, self, deadline)
        try:
            self.counters.bytes_sent += program.put(key, payload)
            self.counters.frames_sent += 1
            reply: Reply = await reply_future
        except TimeoutError as exc:
            self._cancel(key, number)
            raise self._no_answer_error(do, deadline - asked_at) from exc
        except asyncio.CancelledError:
            self._cancel(key, number)
            raise
        finally:
            program.forget_call(number)
        self.counters.frames_received += 1
        if isinstance(reply, TriggerReply):
            return reply
        if reply.fields.get("stranger") and self.agent is current and current is not None:
            self.lose_agent(f"the agent {agent} was restarted, or took this program for gone")
        if "error" in reply.fields:
            error = from_fields(reply.fields["error"])
            if isinstance(error, ReservationLostError) and self.leases:
                self.lose_lease(next(iter(self.leases)), "its agent reported it")
            raise error
        return reply

    def notify(self, do: str, arguments: dict[str, Any]) -> None:
        """Make a call without waiting for its reply; do nothing if there is no agent."""
        if self.agent is not None and self._is_allowed(do):
            fields = {"do": do, "arguments": arguments, "epoch": self.agent.epoch}
            self._send_until_confirmed(self._key_of_call(self.agent.name, do), fields)

    def confirm_bytes(self, number: int, offset: int | None) -> None:
        """Report how many bytes of a call's picture were received; None: send no further bytes."""
        if self.agent is not None:
            fields = {"call": number, "received": offset}
            self.program.send(self._key_of_call(self.agent.name, "frame"), fields)

    def _cancel(self, key: str, number: int) -> None:
        self._send_until_confirmed(key, {"cancel": number})

    def _send_until_confirmed(self, key: str, fields: dict[str, Any]) -> None:
        """Send a message now, and repeatedly until the agent confirms it.

        Sending stops when the agent is lost, since a lost agent's work for the program has ended.
        """
        program, current = self.program, self.agent

        def send() -> tuple[int, AnyFuture]:
            number = program.next_call()
            program.send(key, {"call": number, **fields})
            return number, program.expect_reply(number, self)

        async def repeat(number: int, answer: AnyFuture) -> None:
            while True:
                try:
                    async with asyncio.timeout(RESEND_DELAY):
                        await answer
                except TimeoutError:
                    if self.agent is not current or current is None:
                        return
                except SmartCamError:
                    return
                else:
                    return
                finally:
                    program.forget_call(number)
                number, answer = send()

        task = asyncio.get_running_loop().create_task(
            repeat(*send()), name=f"smartcam.fleet.{self.camera}.insist"
        )
        self._resending_tasks.add(task)
        task.add_done_callback(self._resending_tasks.discard)

    def _is_allowed(self, do: str) -> bool:
        identity = self.program.bus.identity
        return do not in COMMANDS or identity is None or may_command(identity.role)

    def _check_allowed(self, do: str) -> None:
        """Refuse a call that the bus would drop silently.

        Raises:
            NotAllowedError: the role of this program's certificate forbids it.
        """
        identity = self.program.bus.identity
        if identity is not None and not self._is_allowed(do):
            what = PUBLIC_NAMES.get(do, do)
            raise NotAllowedError(
                f"{self.name}: {what} is a command, and this program's certificate is that of "
                f"{identity}, which may only read; nothing was sent",
                role=identity.role,
                certificate=identity.name,
            )

    def _possible_cause(self, do: str) -> str:
        """Return a text about another possible reason for a missing answer; empty without one."""
        identity = self.program.bus.identity
        if identity is None:
            return ""
        return f"; nobody is there, or {do} is not allowed for {identity}"

    def _key_of_call(self, agent: str, do: str) -> str:
        program, camera = self.program, self.camera
        if do in COMMANDS:
            if self._command_key[0] != agent:
                self._command_key = agent, program.keys.command(agent, camera)
            return self._command_key[1]
        return program.keys.ask(program.role, agent, camera)

    def _no_answer_error(self, do: str, waited: float) -> SmartCamError:
        agent = "the agent" if self.agent is None else f"the agent {self.agent.name}"
        if do == "trigger":
            return TriggerTimeoutError(
                f"{self.name}: {agent} did not answer within {waited:.3g} s; whether the camera "
                f"was triggered is unknown{self._possible_cause(do)}",
                waited=waited,
            )
        return ResponseTimeoutError(
            f"{self.name}: {agent} did not answer {do} within {waited:.3g} s; whether it was "
            f"done is unknown{self._possible_cause(do)}",
            waited=waited,
        )


def _unknown_outcome_error(error: LinkError) -> LinkError:
    return ConnectionLostError(f"{error}; whether what was under way was done is unknown")
