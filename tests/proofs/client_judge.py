"""A real client and the emulated camera on one loop, and somebody who judges what comes of it.

For the stateful test of the client: its rules start calls and meddle; what must hold stands here.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import smartcam
from smartcam import (
    Backoff,
    Camera,
    CameraEvent,
    Connected,
    ConnectionTakenError,
    Disconnected,
    Observer,
    Reconnected,
    Result,
    Status,
    StatusChanged,
)
from smartcam.emulator import EmulatedCamera, Run
from smartcam.emulator._inside import LogEntry
from smartcam.observers import TraceEntry
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ResultCode
from smartcam.settings import CameraOptions
from smartcam.streams import Subscription
from tests.client.clientkit import balance
from tests.insides import inside
from tests.proofs.books import LINK_LOST, TRIGGER_OUTCOMES
from tests.protocols.camera_model import CameraModel, Options, Program
from tests.timed_loop import TimedLoop

LINE, OTHER, FREE, FED = 7, 3, 9, 5

SECOND = 1_000_000_000
"""The model's time is nanoseconds."""

TOLERANCE = 1_000
"""By which sums of the same times may differ here and there."""


@dataclass(slots=True)
class Inspection:
    began: float  # when it began, seconds
    number: int  # its sequence number
    application: int  # the one that ran
    # the client's address and which of its Trigger messages, from 0; None for the camera's own
    # doing and the operator's
    by: tuple[str, int] | None
    # ``sent`` once its result was seen on the wire
    fate: Literal["under way", "finished", "void", "sent"] = "under way"
    peer: str | None = None  # who got the result


class RecordedCamera(CameraModel):
    """The plain camera, told by the emulator's log what clients did; it keeps its inspections."""

    # These times end in odd microseconds, those of the rules do not: so the model never has to say
    # which of two things comes first at one instant.
    programs: ClassVar = {
        LINE: Program(processing=80_137_000, loading=120_311_000),
        OTHER: Program(processing=20_731_000, loading=50_173_000),
        FREE: Program(processing=10_937_000, loading=50_419_000, period=SECOND // 3),
        FED: Program(processing=30_517_000, loading=70_829_000),
    }
    reboot_time = 400_631_000
    calm_after = 100_213_000

    def __init__(self, options: Options, *, is_bid: bool) -> None:
        self.inspections: list[Inspection] = []
        self.sent: list[Inspection] = []  # those whose result was seen on the wire, in order
        self._peer = ""
        self._by: tuple[str, int] | None = None
        self._triggers: Counter[str] = Counter()
        super().__init__(options, is_bid=is_bid, coded=is_bid)

    def at(self, seconds: float) -> RecordedCamera:
        """Let everything happen that is due until then."""
        ticks = round(seconds * SECOND) - self.now
        while self.due and min(self.due.values()) <= self.now + ticks + TOLERANCE:
            before = self.now
            self.pass_time(max(0, min(self.due.values()) - before))
            ticks -= self.now - before
        self.pass_time(max(0, ticks))
        return self

    def read(self, box: EmulatedCamera) -> None:
        """Take what was said out of a camera's log."""
        log = box.log
        assert len(log) < (log.maxlen or 0), "something may have gone by"
        while log:
            entry = log.popleft()
            self.at(entry.time)
            if entry.direction == "out":
                self._note_result(entry)
            elif entry.message is not None:
                self._hear_from(entry.peer, entry.message)
        self.take()

    def _hear_from(self, peer: str, message: m.Message) -> None:
        if isinstance(message, m.Connect) and self.mode != "rebooting":
            self._peer, self.session = peer, True
        if self._peer != peer or not self.session:
            return
        if isinstance(message, m.Trigger):
            self._by = (peer, self._triggers[peer])
            self._triggers[peer] += self.mode != "rebooting"
        self.hear(message)
        self._by = None

    def _note_result(self, entry: LogEntry) -> None:
        container = entry.message
        if not isinstance(container, m.ResultContainer):
            return
        over = (one for one in reversed(self.inspections) if one.fate != "under way")
        last = next(over, None)
        assert last is not None, f"a result came that no inspection made: {entry}"
        assert last.fate == "finished", f"a result came of an inspection that was over: {last}"
        number = int.from_bytes(container.data[:4], "little")
        assert (last.number, last.application) == (number, container.application), (last, entry)
        last.fate, last.peer = "sent", entry.peer
        self.sent.append(last)

    def _begin_run(self) -> None:
        began = self.now / SECOND
        self.inspections.append(Inspection(began, self.number, self.active, self._by))
        super()._begin_run()

    def _inspected(self) -> None:
        self.inspections[-1].fate = "finished"
        super()._inspected()

    def _void(self) -> None:
        if self.run is not None:
            self.inspections[-1].fate = "void"
        super()._void()

    def reboot(self) -> None:
        if self.mode != "rebooting":
            self._void()
        super().reboot()


TAKEN_WITHIN = 10.0
A_MOMENT = 1e-5
"""Seconds of the loop's time in which nothing happens but what can happen at once."""
MAX_CALLS = 8

COMMAND_ERRORS = (smartcam.ResponseTimeoutError, smartcam.CommandRejectedError, *LINK_LOST)

LACKING = {
    "bid": frozenset({"start", "stop", "reboot", "set_sequence_number"}),
    **dict.fromkeys(("handbook", "thesis", "b16"), frozenset({"query_status", "reset_errors"})),
}
"""Commands that a dialect does not have."""

CALLER: contextvars.ContextVar[int] = contextvars.ContextVar("CALLER", default=-1)


@dataclass(eq=False, slots=True)
class Call:
    """A call of the client that goes on beside the rules."""

    kind: str  # name of the method
    key: int  # which call it is
    task: asyncio.Task[Any]  # that runs it
    errors: tuple[type[BaseException], ...]  # what it may end with
    losses: int  # how many links were lost before it
    part: int | None = None  # input data sent with a trigger
    cancelled: bool = False  # whether a rule cancelled it
    # it may go on after a loss: what waits for a session, and the user's own code
    outlives: bool = False


@dataclass(slots=True)
class Witness(Observer):
    """Sees which call sends a trigger, over which link, and what happens to the links."""

    loop: asyncio.AbstractEventLoop
    camera: Camera | None = None
    peers: list[str] = field(default_factory=list[str])
    received_before: int = 0
    sends: dict[str, list[int]] = field(default_factory=dict[str, list[int]])
    events: list[tuple[float, CameraEvent]] = field(
        default_factory=list[tuple[float, "CameraEvent"]]
    )
    losses: int = 0
    refused: int = 0
    heard_at: float = 0.0  # when the camera sent the last message

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction != ">":
            self.heard_at = self.loop.time()
        if entry.direction == ">" and entry.message == "Trigger":
            self.sends[self.peers[-1]].append(CALLER.get())
        elif entry.message == "TriggerAnswer" and entry.fields is not None:
            self.refused += entry.fields["code"] == ResultCode.BUSY

    def on_state(self, event: CameraEvent) -> None:
        assert self.camera is not None
        self.events.append((self.loop.time(), event))
        if isinstance(event, Connected | Reconnected):
            session = inside(self.camera)._supervisor.session
            assert session is not None
            host, port = session.link._transport.get_extra_info("sockname")
            self.peers.append(f"{host}:{port}")
            self.sends[self.peers[-1]] = []
            self.received_before = self.camera.statistics().received
        elif isinstance(event, Disconnected):
            self.losses += 1


class ClientJudge:
    """Client, camera and model, on a loop of their own."""

    transport: ClassVar[Literal["tcp", "udp"]] = "tcp"
    numbered: ClassVar[bool] = False

    def __init__(self) -> None:
        self.runner = asyncio.Runner(loop_factory=lambda: TimedLoop(turn=0.0))
        self.loop = self.runner.get_loop()
        self.calls: list[Call] = []  # those that have not ended yet
        self.count = 0
        self.numbers = 0
        self.camera: Camera | None = None
        self.witness: Witness | None = None
        self.streams: list[Subscription[Result]] = []
        self.taken: dict[int, list[int]] = {}  # numbers of the results that each stream gave
        self.delivered = 0  # triggers of the present client that gave a result
        self.undecided = 0  # those that did not, though the client may have counted their result
        self.given_up: set[int] = set()  # keys of the triggers that ended without a result
        self.box: EmulatedCamera
        self.model: RecordedCamera
        self.origin = 0.0
        self.quiet = True  # nothing more happens at once

    def _make_box(self, dialect: str, quirks: dict[str, Any]) -> EmulatedCamera:
        def values(run: Run) -> dict[str, int]:
            part = (run.input or {}).get("part", 0)
            return {"n": run.number, "part": part, "at": round(run.time * 1e6) % (1 << 32)}

        return EmulatedCamera(
            [
                {
                    "id": key,
                    "layout": "n: int32, part: int32, at: uint32",
                    "generator": values,
                    "input": "part: int32" if key == FED else None,
                    "load_time": program.loading / SECOND,
                    "processing_time": program.processing / SECOND,
                    "rate": 3.0 if program.period else None,
                }
                for key, program in RecordedCamera.programs.items()
            ],
            transport=self.transport,
            dialect=dialect,
            builtins=False,
            quirks={
                "reboot_time": RecordedCamera.reboot_time / SECOND,
                "overtriggered_time": RecordedCamera.calm_after / SECOND,
                **quirks,
            },
        )

    # ------------------------------------------------------------------ the loop

    def run(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return self.runner.run(coroutine)

    def go(self, steps: int | None) -> None:
        """Let the loop run for some steps, or until nothing more happens at once."""
        self.run(self._go(steps))
        self.quiet = steps is None

    async def _go(self, steps: int | None) -> None:
        if steps is None:
            await asyncio.sleep(A_MOMENT)
        for _ in range(steps or 0):
            await asyncio.sleep(0)

    def begin(
        self,
        kind: str,
        call: Coroutine[Any, Any, Any],
        errors: tuple[type[BaseException], ...],
        *,
        part: int | None = None,
        outlives: bool = False,
    ) -> None:
        """Start a call; it goes on beside the rules."""
        assert self.witness is not None
        self.count += 1
        context = contextvars.copy_context()
        context.run(CALLER.set, self.count)
        task = self.loop.create_task(call, name=f"call {self.count}: {kind}", context=context)
        self.calls.append(
            Call(kind, self.count, task, errors, self.witness.losses, part, outlives=outlives)
        )

    @property
    def is_alive(self) -> bool:
        """There is a client, and another has not taken its camera."""
        if self.camera is None:
            return False
        return not isinstance(inside(self.camera)._waits.end_reason, ConnectionTakenError)

    @property
    def can_call(self) -> bool:
        return self.is_alive and len(self.calls) < MAX_CALLS

    # ------------------------------------------------------------------ the client's life

    # ------------------------------------------------------------------ what is done

    def connect(self, application: int | None, *, restore: bool) -> None:
        layout = "n: int32 @sequence" if self.numbered else "n: int32"
        self.witness = Witness(self.loop)
        camera = smartcam.connect(
            self.box.url,
            application=application,
            restore=restore,
            interpret_as=f"{layout}, part: int32, at: uint32",
            reconnect=Backoff(initial=0.03, maximum=1.0, jitter=0),
            connect_timeout=2.0,
            request_timeout=1.0,
            switch_timeout=2.0,
            observers=[self.witness],
        )
        self.witness.camera = camera
        self.events = camera.events()
        try:
            self.run(camera.open())
        except (smartcam.ConnectFailedError, *COMMAND_ERRORS):
            assert not camera.connected
            return
        self.camera = camera
        self.delivered = self.undecided = 0
        self.go(None)

    def close(self) -> None:
        if self.camera is None:
            return
        began = self.loop.time()
        self.run(self.camera.close())
        assert self.loop.time() - began < 5
        self.go(None)
        self._settle_calls()
        left = [call for call in self.calls if not call.outlives]
        assert not left, left
        for call in self.calls:
            self._cancel(call)
        self.go(None)
        self._settle_calls()
        assert not self.calls
        self._check_accounts()
        self._check_events()
        for stream in self.streams:
            assert stream.ended
        self.streams.clear()
        self.camera = None

    def _begin_trigger(self, timeout: float) -> None:
        assert self.camera is not None
        self.begin("trigger", self.camera.trigger(timeout=timeout), TRIGGER_OUTCOMES)

    def _cancel(self, call: Call) -> None:
        call.cancelled = True
        call.task.cancel()

    def _begin_next_result(self, timeout: float) -> None:
        camera = self.camera
        assert camera is not None

        async def registered() -> Result:
            return await camera.next_result(timeout=timeout)

        errors = (smartcam.TriggerTimeoutError, *LINK_LOST)
        self.begin("next_result", registered(), errors)

    def _act(self, does: Callable[[], object], is_noted: Callable[[float], object]) -> None:
        self.model.read(self.box)
        does()
        is_noted(self.loop.time())

    def _note_cut(self, now: float) -> None:
        self.model.at(now).end_session()

    def _note_error(self, on: bool, now: float) -> None:
        self.model.at(now).set_condition(Status.SYSTEM_ERROR, on)

    def _deed(self, what: str) -> tuple[Callable[[], object], Callable[[float], object]]:
        device, model = self.box.device, self.model
        deeds: dict[str, tuple[Callable[[], object], Callable[[float], object]]] = {
            "trigger": (device.trigger, lambda now: model.at(now).trigger()),
            "start": (device.start, lambda now: model.at(now).start()),
            "stop": (device.stop, lambda now: model.at(now).stop()),
            "overheat": (lambda: device.set_condition(Status.OVERHEAT, True), model.at),
        }
        return deeds[what]

    def _cut(self) -> None:
        """Every link breaks; over UDP the camera forgets who it spoke to."""
        with self.box.step():
            for link in self.box._listener.all_links:
                link.close("cut")

    async def _visit(self) -> None:
        """Somebody else takes the camera for a moment."""
        options: CameraOptions = {"reconnect": None, "connect_timeout": 0.2, "connect_attempts": 1}
        try:
            async with smartcam.connect(self.box.url, **options):
                pass
        except smartcam.ConnectFailedError:
            # one that is asked does not name its application while it loads another one, and our
            # own client takes it back meanwhile
            assert self.box.device.rebooting or self.model.is_bid

    # ------------------------------------------------------------------ what must hold

    def _is_alone(self) -> bool:
        """Wait until nobody is in between; whether client and camera are there then."""
        self.run(asyncio.sleep(5.0))  # whatever is under way ends in it
        self._settle_calls()
        if self.box.device.mode.value in {"switching", "rebooting"} or self.calls:
            return False
        camera = self.camera
        # a way back that failed is told to the next command
        return camera is not None and camera.connected and inside(camera)._lock._job_error is None

    def _agrees(self) -> bool:
        """Assert that the client knows the camera's state; whether there is a session."""
        camera, device = self.camera, self.box.device
        assert camera is not None
        try:
            if not camera.capabilities.unasked_status:
                self.run(camera.query_status())
            active = self.run(camera.query_application())
        except (smartcam.ResponseTimeoutError, *LINK_LOST):
            return False  # the next session tells
        self.go(None)
        assert active == camera.active_application == device.active_application
        bits = self.box.wire_dialect.status_bits
        assert camera.status == bits.read(bits.write(device.status))
        assert not inside(camera)._waits.pending_answers
        return True

    def _settle_calls(self) -> None:
        """Judge every call that has ended."""
        self.model.read(self.box)
        for call in [call for call in self.calls if call.task.done()]:
            self.calls.remove(call)
            if call.kind == "trigger" and (call.task.cancelled() or call.task.exception()):
                self.given_up.add(call.key)
            if call.task.cancelled():
                assert call.cancelled, call
                self.undecided += call.kind == "trigger"
            elif (error := call.task.exception()) is not None:
                assert isinstance(error, call.errors), (call, repr(error))
                if isinstance(error, ConnectionTakenError):
                    self._check_taken()
                # with what was lost at that moment its result may have come
                self.undecided += call.kind == "trigger"
                assert len(self._runs_by(call)) <= 1
            else:
                self._check_value(call)

    def _check_value(self, call: Call) -> None:
        assert call.kind not in LACKING[self.box.dialect], "it cannot be done"
        if call.kind == "trigger":
            self._check_own(call, call.task.result())
        elif call.kind == "next_result":
            run = self._run_of(call.task.result())
            assert self._owner(run) not in self.given_up, "nobody waited for it any more"

    def _runs_by(self, call: Call) -> list[Inspection]:
        assert self.witness is not None
        sent = sum(keys.count(call.key) for keys in self.witness.sends.values())
        assert sent <= 1 + self.witness.refused, "a trigger was sent twice"
        return [run for run in self.model.inspections if self._owner(run) == call.key]

    def _owner(self, run: Inspection) -> int | None:
        """Return the call of the present client that triggered an inspection."""
        assert self.witness is not None
        peer, index = run.by or ("", 0)
        keys = self.witness.sends.get(peer)
        return keys[index] if keys is not None else None

    def _run_of(self, result: Result) -> Inspection:
        """Return the inspection that a result is from."""
        for run in self.model.sent:
            at = round((run.began - self.origin) * 1e6)
            if abs(at - result.value.at) <= 2 and run.application == result.application:
                assert run.number == result.value.n
                return run
        raise AssertionError(f"no inspection made {result}")

    def _check_own(self, call: Call, result: Result) -> None:
        runs = self._runs_by(call)
        run = self._run_of(result)
        assert [run] == runs, f"{call.kind} {call.key}: {result} is of {run}, not of {runs}"
        if call.part is not None and result.application == FED:
            assert result.value.part == call.part
        if self.numbered:
            assert result.sequence == run.number
        self.delivered += 1

    def _check_accounts(self) -> None:
        assert self.camera is not None
        count = self.camera.statistics()
        balance(count)
        assert (
            self.delivered <= count.triggered <= self.delivered + self.undecided + len(self.calls)
        )
        for stream in self.streams:
            one = stream.statistics()
            assert one.offered == one.taken + one.dropped + one.queued

    def _check_losses(self) -> None:
        """Whoever waited when a link was lost has been told."""
        assert self.camera is not None
        assert self.witness is not None
        for call in self.calls:
            assert call.outlives or call.losses == self.witness.losses, call
            assert call.outlives or self.camera.connected, call

    def _check_received(self) -> None:
        """Every container that the camera sent over the present link has come."""
        assert self.camera is not None
        assert self.witness is not None
        peer = self.witness.peers[-1]
        sent = sum(run.peer == peer for run in self.model.sent)
        received = self.camera.statistics().received - self.witness.received_before
        assert received == sent if self.camera.connected else received <= sent

    def _check_tasks(self) -> None:
        names = [task.get_name() for task in asyncio.all_tasks(self.loop)]
        ours = [name for name in names if name.startswith("smartcam[")]
        supervisors = [name for name in ours if name.endswith(".supervisor")]
        receivers = [name for name in ours if name.endswith(".receive")]
        jobs = [name for name in ours if name not in {*supervisors, *receivers}]
        assert self.camera is not None
        ended = isinstance(inside(self.camera)._waits.end_reason, ConnectionTakenError)
        assert len(supervisors) == (0 if ended else 1)
        assert len(receivers) <= len(supervisors)
        assert len(jobs) <= MAX_CALLS + 1
        rest = [n for n in names if not n.startswith(("smartcam[", "smartcam.emulator", "call "))]
        assert not rest

    def _check_events(self) -> None:
        """Sessions begin and end by turns, and each status follows on the one before."""
        assert self.camera is not None
        assert self.witness is not None
        seen: list[CameraEvent] = []

        async def read() -> None:
            while self.events.statistics().queued:
                seen.append(await anext(self.events))

        self.run(read())
        told = [event for _, event in self.witness.events]
        assert seen == told[len(told) - len(seen) :]
        begin: type[CameraEvent] = Connected
        linked, status = False, None
        for event in told:
            match event:
                case Connected() | Reconnected():
                    assert type(event) is begin
                    assert not linked
                    linked, begin = True, Reconnected
                case Disconnected():
                    assert linked
                    linked = False
                case StatusChanged():
                    assert linked
                    assert event.previous == status
                    status = event.status
                case _:
                    assert linked
        assert linked or not self.camera.connected
        assert status == self.camera.status

    def _check_taken(self) -> None:
        """Only a session that was lost soon after a reconnect says that somebody took it.

        Over UDP it was lost when the camera fell silent, which the client knows only later.
        """
        assert self.witness is not None
        began = [at for at, e in self.witness.events if isinstance(e, Reconnected)]
        ended = [at for at, e in self.witness.events if isinstance(e, Disconnected)]
        lost_at = ended[-1] if self.transport == "tcp" else self.witness.heard_at
        assert lost_at - began[-1] < TAKEN_WITHIN
