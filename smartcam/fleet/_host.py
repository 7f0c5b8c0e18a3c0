"""A camera at its agent: the session with it, what it said last, and who may command it."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import math
from typing import TYPE_CHECKING, Any

from smartcam._client.deadline import DeadlineTimer
from smartcam._client.interpretation import Interpretation
from smartcam.exceptions import ConnectionLostError, SmartCamError
from smartcam.fleet._errors import late, to_fields
from smartcam.fleet._gate import Gate
from smartcam.fleet._log import AgentLog
from smartcam.fleet._shared import SharedCamera, Tap
from smartcam.fleet._topics import CameraTopics
from smartcam.fleet._trigger_counts import RESULT, outcome_of
from smartcam.fleet._wire import (
    CURRENT,
    LATE,
    ResultRun,
    encode,
    encode_runs,
    encode_state,
    encode_status,
    timestamp,
)
from smartcam.models import Connected, Reconnected, StatusChanged, jsonable

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Sequence

    from smartcam.fleet._bundle import AgentBundle
    from smartcam.fleet._bus import Bus, Publisher
    from smartcam.fleet._frames import SharedFrames
    from smartcam.fleet._keys import Keys
    from smartcam.fleet._shared import Carried, Owner
    from smartcam.fleet._topics import Topics
    from smartcam.models import CameraEvent, Result, Status
    from smartcam.observers import Observer
    from smartcam.settings import CameraSettings

MOST_STATES = 1000
MOST_STATE_BYTES = 1 << 19
HOLD = 0.005
"""Seconds that a status may wait for others, so that one message tells them. The program whose
trigger it belongs to hears of it with the reply."""

CATCH_UP = 0.2
"""Seconds behind such a reply after which the number of the next state is told where no state was:
the reply may have been lost, and nothing else would tell."""

GATHER = 0.002
"""Seconds between two messages with results, at least: those that come faster go together."""

FULL = 1 << 16
"""Bytes of results that go at once, however soon after the last."""

REMINDERS = (0.05, 0.2, 1.0, 5.0)
"""Seconds behind the last results after which their numbers are told again: the last of them may
have been lost on the way, and nothing else would tell."""


class Host:
    """One camera of an agent.

    Args:
        name: in the fleet.
        settings: of the client that has the session.
        bus: where it is said what comes.
        keys: of the fleet.
        epoch: of the agent.
        history: results that are kept, and their bytes.
        on_event: is told what happens to the camera.
        topics: where it is said in JSON.
        frames: its frames.
        bundle: says its results with those of others.
        observers: see what its sessions see.

    Attributes:
        epoch: of the agent, or of this time that it has the camera.
        began: the number of the first result since then.
        final: no other agent takes the camera over when there will be no session any more.
        gate: whose commands may pass.
        results: the last results.
        states: the last things that happened.
        outcomes: the runs of triggers under way, by whose they are; for who has put a list there.
        topics: says in JSON what comes, for other programs.
        frames: its frames.
        failure: why there is no session yet, None where there is or was one.
        triggers: how those of programs ended, by a word of ``OUTCOMES``.
    """

    def __init__(
        self,
        name: str,
        settings: CameraSettings,
        bus: Bus,
        keys: Keys,
        epoch: int,
        history: tuple[int, int],
        on_event: Callable[[CameraEvent], None],
        topics: Topics,
        frames: SharedFrames,
        bundle: AgentBundle,
        observers: Sequence[Observer] = (),
    ) -> None:
        self.name = name
        self.frames = frames
        self.settings = settings
        self.gate: Gate = Gate()
        self.results: AgentLog = AgentLog(*history)
        self.states: AgentLog = AgentLog(MOST_STATES, MOST_STATE_BYTES)
        self.outcomes: dict[Owner, list[bytes]] = {}
        self.failure: SmartCamError | None = None
        self.triggers: collections.Counter[str] = collections.Counter()
        self.epoch: int = epoch
        self.began: int = 1
        self.final: bool = True
        self._tell, self._bundle, self._observers = on_event, bundle, observers
        Interpretation(settings.interpret_as, lenient=True, y_down=False)  # it is the programs'
        self.topics: CameraTopics = CameraTopics(self, topics)
        self._camera = self._make()
        self._fresh: list[bytes] = []  # runs that are not said yet
        self._fresh_states: list[bytes] = []
        self._fresh_bytes = 0
        self._due: asyncio.Handle | None = None  # says the results
        self._said_at = -math.inf
        self._held = DeadlineTimer(self._flush_states)
        self._catch_up = DeadlineTimer(self._put_states)
        self._reminder: asyncio.TimerHandle | None = None
        self._opened = asyncio.Event()
        self._over = False  # there will be no session any more
        self._states_out: Publisher = bus.publisher(keys.states(name), urgent=True)
        self._results_out: Publisher = bus.publisher(keys.results(name), self._on_heard)

    @property
    def camera(self) -> SharedCamera:
        """The client that has the session."""
        return self._camera

    @property
    def was_tried(self) -> bool:
        """Whether the first try has come to an end, well or not."""
        return self._opened.is_set()

    @property
    def connected(self) -> bool:
        """Whether there is a session."""
        return self._camera.connected

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers that what is said next has."""
        topics = self.topics
        return self.results.following, self.states.following, topics.statuses, topics.events

    @numbers.setter
    def numbers(self, numbers: tuple[int, ...]) -> None:
        topics = self.topics
        self.results.following, self.states.following, topics.statuses, topics.events = numbers

    def _make(self) -> SharedCamera:
        tap = Tap(self._on_results, self._on_status, self._on_event, self._on_end)
        return SharedCamera(self.settings, tap, self._observers)

    # ------------------------------------------------------------------ life

    async def run(self) -> None:
        """Have a session, as soon as there is a camera; ends when there will be none."""
        backoff = self.settings.reconnect
        delays = iter(()) if backoff is None else backoff.delays()
        try:
            while True:
                try:
                    await self._camera.open()
                except (SmartCamError, OSError) as error:
                    self._fail(error)
                    delay = next(delays, None)
                    if delay is None or backoff is None or not backoff.transient(error):
                        self._over = True
                        return
                    await asyncio.sleep(delay)
                    self._camera = self._make()
                else:
                    self.failure = None
                    return
        finally:
            self._opened.set()
            self._say({"kind": "Tried"})

    async def tried(self, timeout: float) -> None:
        """Wait until the first try has come to an end, well or not; bounded."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._opened.wait()

    async def close(self) -> None:
        """End the session with Disconnect; bounded."""
        self._opened.clear()  # what is said from now on is no news
        try:
            await self.frames.close()
        finally:
            await self._camera.close()
        if self._reminder is not None:
            self._reminder.cancel()
        self.flush()
        self._held.cancel()
        self._catch_up.cancel()
        self._states_out.close()
        self._results_out.close()
        self.topics.close()

    def _fail(self, error: BaseException) -> None:
        if not isinstance(error, SmartCamError):
            error = ConnectionLostError(f"{self.name}: {error}")
        self.failure = error
        self._opened.set()
        self._say({"kind": "Absent"})

    def require(self) -> SharedCamera:
        """Return the camera.

        Raises:
            LinkError: there is no session, and why.
        """
        if self.failure is not None or not (self._opened.is_set() or self.connected):
            why = self.failure or "it tries for the first time"
            raise ConnectionLostError(
                f"{self.name}: the agent has no session with the camera: {why}"
            ) from self.failure
        return self._camera

    @contextlib.contextmanager
    def counted(self, said: str) -> Iterator[None]:
        """Count how a trigger in here ends, if ``said`` is one."""
        outcome = RESULT
        try:
            yield
        except BaseException as exc:
            outcome = outcome_of(exc)
            raise
        finally:
            if "trigger" in said.lower():
                self.triggers[outcome] += 1

    async def enter(self, program: str, said: str, timeout: float) -> None:
        """Let a command of ``program`` begin, as :meth:`Gate.enter` does.

        Raises:
            ResponseTimeoutError, TriggerTimeoutError: another program has reserved the camera for
                ``timeout`` seconds more.
        """
        try:
            await self.gate.enter(program, timeout)
        except TimeoutError as exc:
            raise self._not_granted(said, timeout) from exc

    async def reserve(self, program: str, reservation: Hashable, timeout: float) -> None:
        """Keep the commands of other programs out, as :meth:`Gate.reserve` does.

        Raises:
            ResponseTimeoutError: another program has it for ``timeout`` seconds more.
        """
        try:
            await self.gate.reserve(program, reservation, timeout)
        except TimeoutError as exc:
            raise self._not_granted("reserve", timeout) from exc

    def _not_granted(self, said: str, timeout: float) -> SmartCamError:
        """Return the error of who waited in vain for others to let go of the camera."""
        holder = self.gate.holder
        who = "commands of others" if holder is None else f"reserved by {holder}, which"
        text = f"{self.name}: {who} did not let go within {timeout:.3g} s; {said} was not done"
        return late(said, text)

    # ------------------------------------------------------------------ what the camera is

    def state(self) -> dict[str, Any]:
        """Return what every state message says of the camera."""
        camera = self._camera
        try:
            status: int | None = int(camera.status)
        except SmartCamError:
            status = None
        # a link that has just ended is no loss yet: what came before is not all told
        trouble = self.failure or camera.trouble
        fields: dict[str, Any] = {
            "connected": trouble is None,
            "status": status,
            "endian": camera.endian,
            "application": camera.active_application,
        }
        if not self._opened.is_set():
            fields["trying"] = True
        elif trouble is not None:
            fields |= {"error": to_fields(trouble), "over": self._over and self.final}
        return fields

    def known(self) -> tuple[bool, int | None, int | None, str | None]:
        """Return whether there is a session, its status, its application, and why there is none."""
        camera, trouble = self._camera, self.failure or self._camera.trouble
        try:
            status: int | None = int(camera.status)
        except SmartCamError:
            status = None
        why = None if trouble is None else str(trouble)
        return trouble is None, status, camera.active_application, why

    def about(self) -> dict[str, Any]:
        """Return what else there is to know of it, the same for a whole session."""
        camera, settings = self._camera, self.settings
        fields: dict[str, Any] = {
            "camera": self.name,
            "url": camera.url,
            "protocol_version": camera.protocol_version,
            "interpret_as": jsonable(settings.interpret_as),
            "y_down": settings.y_down,
            "lenient": settings.lenient,
        }
        with contextlib.suppress(SmartCamError):
            fields["capabilities"] = jsonable(camera.capabilities)
        return fields

    # ------------------------------------------------------------------ what comes

    def _on_status(self, status: Status) -> None:
        self.topics.on_status(status)
        camera, number = self._camera, self.states.following
        if not (camera.connected and self._opened.is_set()):
            self._say({"kind": "Status"}, hold=HOLD)
            return
        data = encode_status(number, int(status), camera.endian, camera.active_application)
        self._have_said(data, asyncio.get_running_loop().time(), HOLD)

    def _on_event(self, event: CameraEvent) -> None:
        self._tell(event)
        if isinstance(event, StatusChanged):
            return  # a status tells that
        self.topics.on_event(event)
        fields: dict[str, Any] = jsonable(event)
        del fields["camera"]
        said: dict[str, Any] = {"kind": type(event).__name__, "event": fields}
        if isinstance(event, (Connected, Reconnected)):
            said["about"] = self.about()
        self._say(said)

    def _on_end(self) -> None:
        if self._opened.is_set() and self.failure is None:
            self._over = True
            self._say({"kind": "Over"})

    def _say(self, fields: dict[str, Any], *, hold: float = 0.0) -> None:
        """Say what happened, and what the camera is now; in ``hold`` seconds, or with the next."""
        clock = asyncio.get_running_loop().time()
        said = {**fields, **self.state(), "number": self.states.following, "clock": clock}
        self._have_said(encode_state(said), clock, hold)

    def _have_said(self, data: bytes, clock: float, hold: float) -> None:
        self.states.add(1, clock, data)
        self._fresh_states.append(data)
        if not hold:
            self._flush_states()
        elif len(self._fresh_states) == 1:
            self._held.set(clock + hold)
        self.topics.on_state()

    def _on_results(self, results: Sequence[Result[Carried]], current: bool, late: bool) -> None:
        """Keep results that came together, and say them: soon, with what comes meanwhile."""
        first = results[0]
        owner = first.value.owner
        flags = (CURRENT if current else 0) | (LATE if late else 0)
        cells = first.value.cells
        clock = asyncio.get_running_loop().time()
        run = ResultRun(
            self.results.following,
            first.application,
            self._camera.endian,
            flags,
            owner.program,
            owner.call,
            clock,
            first.received_at.timestamp(),
            timestamp(first.triggered_at),
            timestamp(None) if first.latency is None else first.latency,
            [one.raw for one in results],
            cells,
        )
        data = run.encode()
        self.results.add(len(run.payloads), clock, data)
        if owner in self.outcomes:
            self.outcomes[owner].append(data)
        if self._results_out.heard or self._bundle.heard:
            self._fresh.append(data)
            self._fresh_bytes += len(data)
            if self._fresh_bytes >= FULL:
                self._flush_results()
            elif self._due is None:
                loop = asyncio.get_running_loop()
                at = self._said_at + GATHER
                call = self._flush_results
                self._due = loop.call_at(at, call) if at > loop.time() else loop.call_soon(call)
        self.topics.on_run(run)

    def untold(self, since: int) -> list[bytes]:
        """Return the states that are not said yet, from number ``since`` on."""
        fresh = self._fresh_states
        return fresh[max(0, since - self.states.following + len(fresh)) :]

    def forget_fresh(self) -> None:
        """The states that are not said yet need not be: whoever hears them was told."""
        self._held.clear()
        self._fresh_states.clear()
        self._catch_up.set(asyncio.get_running_loop().time() + CATCH_UP)

    def flush(self, *, states: bool = True) -> None:
        """Say what is not said yet; without ``states`` only results."""
        if states:
            self._flush_states()
        self._flush_results()
        self._bundle.flush()

    def _flush_states(self) -> None:
        self._held.clear()
        if self._fresh_states:
            self._put_states()

    def _put_states(self) -> None:
        self._catch_up.clear()
        fresh, self._fresh_states = self._fresh_states, []
        following = self.states.following
        self._states_out.put(encode({"epoch": self.epoch, "following": following}, fresh))

    def _flush_results(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None
        if self._fresh:
            self._said_at, self._fresh_bytes = asyncio.get_running_loop().time(), 0
            fresh, self._fresh = self._fresh, []
            said = encode_runs(self.epoch, self.results.following, fresh)
            if self._bundle.heard:
                self._bundle.add(self.name, said)
            if self._results_out.heard:
                self._results_out.put(said)
                self._remind(0)

    def _on_heard(self, heard: bool) -> None:
        if heard:
            self._remind(0)

    def _remind(self, step: int) -> None:
        """Tell the last number again in a while; after the last reminder, no more."""
        if self._reminder is not None:
            self._reminder.cancel()
            self._reminder = None
        if step < len(REMINDERS):
            loop = asyncio.get_running_loop()
            self._reminder = loop.call_later(REMINDERS[step], self._say_number, step + 1)

    def _say_number(self, step: int) -> None:
        self._reminder = None
        if self._results_out.heard:
            self._results_out.put(encode_runs(self.epoch, self.results.following, []))
            self._remind(step)
