"""A real client and the emulated camera over the loopback in any history, against a plain model.

Long form: ``HYPOTHESIS_PROFILE=nightly pytest -m "" tests/proofs/test_stateful_client.py``.

The rules start calls of the client, meddle as an operator, cut links and let time pass, and look at
what came of it between any two steps of the loop. Each result carries when its inspection began, so
it shows whose it is, whatever its number.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Iterator
from datetime import datetime
from typing import Any, ClassVar, Literal

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from smartcam import Result, Status, UnsupportedError
from tests.insides import inside
from tests.proofs.books import TRIGGER_OUTCOMES
from tests.proofs.client_judge import (
    COMMAND_ERRORS,
    FED,
    FREE,
    LACKING,
    LINE,
    OTHER,
    ClientJudge,
    RecordedCamera,
)
from tests.protocols.camera_model import Options

pytestmark = pytest.mark.long

PROFILE = settings()
HISTORIES = settings(max_examples=max(1, PROFILE.max_examples // 2), stateful_step_count=40)

turns = st.sampled_from([None, None, None, 0, 1, 2, 3, 5, 8, 13])
"""Steps of the loop after a rule; None until nothing more happens at once."""

patience = st.sampled_from([0.02, 0.05, 0.3, 2.0])
HANDBOOK, _, _, BID = range(4)
DEEDS = ["trigger", "trigger", "trigger", "start", "start", "stop", "overheat"]
applications = st.sampled_from([LINE, OTHER, FED, FREE])


class ClientMachine(ClientJudge, RuleBasedStateMachine):
    """Events that may happen to client and camera."""

    dialects: ClassVar[tuple[str, ...]] = ("handbook", "thesis", "b16", "bid")

    def __init__(self) -> None:
        RuleBasedStateMachine.__init__(self)
        ClientJudge.__init__(self)

    @initialize(
        dialect=st.integers(0, 3),
        application=st.sampled_from([None, LINE, FED]),
        restore=st.booleans(),
        quirks=st.fixed_dictionaries(
            {},
            optional={
                "waiting_before_result": st.just(value=True),
                "busy_while_processing": st.just(value=True),
                "switch_answer": st.just("before_status"),
            },
        ),
    )
    def switched_on(
        self, dialect: int, application: int | None, quirks: dict[str, Any], *, restore: bool
    ) -> None:
        name = self.dialects[dialect % len(self.dialects)]
        if name == "bid":  # the model does not say when it is too busy for a switch
            quirks.pop("busy_while_processing", None)
        self.box = self._make_box(name, quirks)
        self.model = RecordedCamera(Options(**quirks), is_bid=name == "bid")
        self.run(self.box.start())
        self.origin = self.loop.time()
        self.act(None, *self._deed("start"))
        self.connect(application, restore=restore)

    @precondition(lambda self: not self.is_alive)
    @rule(application=st.sampled_from([None, LINE, FED]), restore=st.booleans())
    def another_client(self, application: int | None, *, restore: bool) -> None:
        """A client that has ended makes room for the next."""
        self.close()
        self.run(asyncio.sleep(1.0))
        self.connect(application, restore=restore)

    # ------------------------------------------------------------------ calls

    @precondition(lambda self: self.can_call)
    @rule(
        count=st.sampled_from([1, 1, 1, 2, 3]),
        timeout=patience,
        fed=st.booleans(),
        wait=st.booleans(),
        steps=turns,
    )
    def trigger(
        self, count: int, timeout: float, steps: int | None, *, fed: bool, wait: bool
    ) -> None:
        assert self.camera is not None
        for _ in range(count):
            part = self.count + 1 if fed else None
            call = self.camera.trigger(
                timeout=timeout,
                input=None if part is None else part.to_bytes(4, "little"),
                when_busy="wait" if wait else "refuse",
            )
            self.begin("trigger", call, TRIGGER_OUTCOMES, part=part)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(timeout=patience, steps=turns)
    def one_trigger(self, timeout: float, steps: int | None) -> None:
        self._begin_trigger(timeout)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(seconds=st.sampled_from([0.01, 0.03, 0.05, 0.1]), steps=turns)
    def trigger_cancelled(self, seconds: float, steps: int | None) -> None:
        self._begin_trigger(2.0)
        call = self.calls[-1]
        self.run(asyncio.sleep(seconds))
        self._cancel(call)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(
        waits=st.lists(st.integers(1, 8), min_size=1, max_size=4),
        seconds=st.sampled_from([0.0, 0.03, 0.09]),
        steps=turns,
    )
    def impatience(self, waits: list[int], seconds: float, steps: int | None) -> None:
        """Triggers that are cancelled just when they were sent, and one that is not."""

        async def script() -> None:
            for wait in waits:
                self._begin_trigger(0.3)
                await self._go(wait)
                self._cancel(self.calls[-1])
                await asyncio.sleep(seconds)
            self._begin_trigger(0.3)

        self.run(script())
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(seconds=st.sampled_from([0.0, 0.01, 0.04]), again=st.booleans(), steps=turns)
    def loss_of_a_result(self, seconds: float, steps: int | None, *, again: bool) -> None:
        """The link is lost during an inspection; its result may come over the next one."""

        async def script() -> None:
            assert self.camera is not None
            self._begin_trigger(0.3)
            await asyncio.sleep(seconds)
            self._act(self._cut, self._note_cut)
            await asyncio.sleep(0.032)
            if self.camera.connected:
                self._begin_next_result(0.3)
            if again:
                self._begin_trigger(0.3)

        self.run(script())
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(application=applications, timeout=patience, steps=turns)
    def trigger_in(self, application: int, timeout: float, steps: int | None) -> None:
        assert self.camera is not None
        call = self.camera.trigger(application, timeout=timeout)
        self.begin("trigger", call, TRIGGER_OUTCOMES)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(application=applications, timeout=patience, fails=st.booleans(), steps=turns)
    def temporary(
        self, application: int, timeout: float, steps: int | None, *, fails: bool
    ) -> None:
        camera = self.camera
        assert camera is not None

        async def body() -> None:
            async with camera.application(application):
                await asyncio.sleep(timeout)
                if fails:
                    raise ZeroDivisionError

        self.begin("application", body(), (ZeroDivisionError, *COMMAND_ERRORS), outlives=True)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(application=applications | st.just(99), steps=turns)
    def switch(self, application: int, steps: int | None) -> None:
        assert self.camera is not None
        self.begin("switch", self.camera.switch_application(application), COMMAND_ERRORS)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(
        what=st.sampled_from(
            [
                *("start", "stop", "query_application", "get_clock", "wait_ready", "reboot"),
                *("set_clock", "query_status", "reset_errors"),
            ]
        ),
        steps=turns,
    )
    def command(self, what: str, steps: int | None) -> None:
        arguments = [datetime(2024, 1, 1)] if what == "set_clock" else []  # noqa: DTZ001
        self._begin_command(what, *arguments)
        self.go(steps)

    def _begin_command(self, what: str, *arguments: object) -> None:
        lacking = (UnsupportedError,) if what in LACKING[self.box.dialect] else ()
        call = getattr(self.camera, what)(*arguments)
        self.begin(what, call, (*COMMAND_ERRORS, *lacking))

    @precondition(lambda self: self.can_call)
    @rule(steps=turns)
    def set_sequence_number(self, steps: int | None) -> None:
        self.numbers += 1
        self._begin_command("set_sequence_number", (1 << 30) + 1_000_003 * self.numbers)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(timeout=patience, rises=st.booleans(), steps=turns)
    def wait_status(self, timeout: float, steps: int | None, *, rises: bool) -> None:
        def predicate(status: Status) -> bool:
            return (Status.WAITING_FOR_TRIGGER in status) == rises

        assert self.camera is not None
        self.begin("wait_status", self.camera.wait_status(predicate, timeout), COMMAND_ERRORS)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(timeout=patience, steps=turns)
    def next_result(self, timeout: float, steps: int | None) -> None:
        self._begin_next_result(timeout)
        self.go(steps)

    @precondition(lambda self: self.can_call)
    @rule(timeout=patience, steps=turns)
    def wait_connected(self, timeout: float, steps: int | None) -> None:
        assert self.camera is not None
        call = self.camera.wait_connected(timeout)
        self.begin("wait_connected", call, COMMAND_ERRORS, outlives=True)
        self.go(steps)

    @precondition(lambda self: self.calls)
    @rule(data=st.data(), steps=turns)
    def cancel(self, data: st.DataObject, steps: int | None) -> None:
        self._cancel(data.draw(st.sampled_from(self.calls), "call"))
        self.go(steps)

    # ------------------------------------------------------------------ streams

    @precondition(lambda self: self.is_alive and len(self.streams) < 3)
    @rule(size=st.sampled_from([1, 3, 100]), overflow=st.sampled_from(["drop_oldest", "error"]))
    def subscribe(self, size: int, overflow: Literal["drop_oldest", "error"]) -> None:
        assert self.camera is not None
        self.streams.append(self.camera.results(max_queue=size, overflow=overflow))

    @precondition(lambda self: self.streams)
    @rule(data=st.data(), closes=st.booleans())
    def take(self, data: st.DataObject, *, closes: bool) -> None:
        """A slow reader takes what is there; perhaps it goes away then."""
        stream = data.draw(st.sampled_from(self.streams), "stream")
        seen: list[Result] = []

        async def read() -> None:
            while stream.statistics().queued:
                seen.append(await anext(stream))

        self.run(read())
        numbers = self.taken.setdefault(id(stream), [])
        numbers += [result.number for result in seen]
        assert numbers == sorted(set(numbers))
        for result in seen:
            self._run_of(result)
        if closes:
            stream.close()
        if stream.ended:
            self.taken.pop(id(stream))
            self.streams.remove(stream)

    # ------------------------------------------------------------------ the operator

    def act(
        self, steps: int | None, does: Callable[[], object], is_noted: Callable[[float], object]
    ) -> None:
        """Do something to the camera, and tell the model at the same instant."""

        async def at_once() -> None:
            self._act(does, is_noted)

        self.run(at_once())
        self.go(steps)

    @rule(what=st.sampled_from(DEEDS), steps=turns)
    def operator(self, what: str, steps: int | None) -> None:
        self.act(steps, *self._deed(what))

    @precondition(lambda self: self.can_call)
    @rule(
        seconds=st.sampled_from([None, 0.0, 0.02]),
        between=st.integers(0, 5),
        what=st.sampled_from(DEEDS),
        steps=turns,
    )
    def collision(self, seconds: float | None, between: int, what: str, steps: int | None) -> None:
        """The operator does something while a trigger is on its way, perhaps before it, too."""

        async def script() -> None:
            if seconds is not None:
                self._act(*self._deed(what))
                await asyncio.sleep(seconds)
            self._begin_trigger(0.3)
            await self._go(between)
            self._act(*self._deed(what))

        self.run(script())
        self.go(steps)

    @rule(application=applications, running=st.booleans(), steps=turns)
    def operator_switches(self, application: int, steps: int | None, *, running: bool) -> None:
        self.act(
            steps,
            lambda: self.box.device.switch_application(application, running=running),
            lambda now: self.model.at(now).switch_application(application, running=running),
        )

    @rule(seconds=st.sampled_from([0.05, 0.3]), steps=turns)
    def system_error(self, seconds: float, steps: int | None) -> None:
        """It lasts for a while."""
        for on in (True, False):
            self.act(
                steps,
                functools.partial(self.box.device.set_condition, Status.SYSTEM_ERROR, on),
                functools.partial(self._note_error, on),
            )
            self.run(asyncio.sleep(seconds if on else 0))

    @rule(what=st.sampled_from(["cut", "cut", "reboot", "visit", "close"]), steps=turns)
    def disturbance(self, what: str, steps: int | None) -> None:
        """The session ends, one way or another; sometimes the next one lasts."""
        match what:
            case "cut":
                self.act(steps, self._cut, self._note_cut)
            case "reboot":
                self.act(steps, self.box.device.reboot, lambda now: self.model.at(now).reboot())
            case "visit":
                self.run(self._visit())
                self.go(steps)
            case _:
                self.close()
                self.connect(LINE, restore=True)

    @rule(what=st.sampled_from(["cut", "reboot"]))
    def disturbance_survived(self, what: str) -> None:
        """The session ends and the next one has lasted long enough not to be taken."""
        self.disturbance(what, None)
        self.run(asyncio.sleep(11.0))
        self.act(None, *self._deed("start"))

    # ------------------------------------------------------------------ time

    @rule(seconds=st.sampled_from([0.01, 0.02, 0.05, 0.1, 0.3]))
    def a_little_time_passes(self, seconds: float) -> None:
        self.time_passes(seconds)

    @rule(seconds=st.sampled_from([0.1, 0.3, 1.0, 3.0, 11.0]))
    def time_passes(self, seconds: float) -> None:
        self.run(asyncio.sleep(seconds))
        self.go(None)

    @rule(steps=turns)
    def steps(self, steps: int | None) -> None:
        self.go(steps)

    # ------------------------------------------------------------------ what must hold

    @precondition(lambda self: self.is_alive)
    @rule()
    def agree(self) -> None:
        """With nobody in between, both sides agree, and a trigger gives its own result."""
        camera, device = self.camera, self.box.device
        assert camera is not None
        if not self._is_alone() or not self._agrees():
            return
        assert not inside(camera)._waits.status_waiters
        assert not inside(camera)._lock._lock.locked()
        takes_one = device.running and device.applications[device.active_application].triggered
        if takes_one and Status.SYSTEM_ERROR not in device.status:
            self._begin_trigger(5.0)
            task = self.calls[-1].task
            self.run(asyncio.wait({task}))
            if inside(camera)._state.wanted.application in {None, camera.active_application}:
                assert task.exception() is None, repr(task.exception())

    @precondition(lambda self: self.is_alive)
    @rule(
        application=applications,
        how=st.sampled_from(["trigger", "inside"]),
        ending=st.sampled_from(["done", "failed", "cancelled", "lost"]),
        seconds=st.sampled_from([0.0, 0.01, 0.06, 0.15, 0.2, 0.3, 0.5]),
        between=st.integers(0, 8),
    )
    def there_and_back(
        self, application: int, how: str, ending: str, seconds: float, between: int
    ) -> None:
        """With nobody in between, a temporary application leaves the camera as it was."""
        camera, device = self.camera, self.box.device
        assert camera is not None
        if not self._is_alone() or not self._agrees():
            return
        expected, runs = (
            inside(camera)._state.wanted.application,
            inside(camera)._state.wanted.running,
        )
        before = (device.active_application, device.running, expected)
        allowed = [before]
        if camera.settings.restore and ending == "lost":
            allowed.append((expected or before[0], before[1] if runs is None else runs, expected))
        if how == "trigger":
            self.trigger_in(application, 0.3, None)
        else:
            self.temporary(application, 0.1, None, fails=ending == "failed")
        self.run(asyncio.sleep(seconds if ending in {"cancelled", "lost"} else 1.0))
        self.go(between)
        if ending == "cancelled":
            for call in self.calls:
                self._cancel(call)
        elif ending == "lost":
            self.act(None, self._cut, self._note_cut)
        self.run(asyncio.sleep(11.0))  # a loss over UDP has shown by then
        self._settle_calls()
        assert not self.calls
        if camera.connected and self._agrees():
            after = (
                device.active_application,
                device.running,
                inside(camera)._state.wanted.application,
            )
            assert after in allowed, (allowed, after)

    @invariant()
    def all_is_well(self) -> None:
        self.model.read(self.box)
        self._settle_calls()
        if self.camera is None:
            return
        self._check_accounts()
        if self.quiet:
            self._check_losses()
            self._check_received()
            self._check_tasks()
            self._check_events()

    def teardown(self) -> None:
        try:
            if self.camera is not None:
                self.close()
            self.run(self.box.stop())
            assert not self.box.links
            self.go(None)
            assert not asyncio.all_tasks(self.loop)
        finally:
            self.runner.close()


class OverTcp(ClientMachine):
    """Without a number: the status and the order of what comes tell."""


class OverTcpNumbered(ClientMachine):
    """Each container carries its number."""

    dialects = ("handbook", "thesis", "b16")
    numbered = True


class OverUdpNumbered(ClientMachine):
    """Datagrams; each container carries its number."""

    transport = "udp"
    dialects = ("handbook", "thesis", "b16")
    numbered = True


class OverUdpAsked(ClientMachine):
    """Datagrams, none of them lost or overtaken; the status comes when it is asked for."""

    transport = "udp"
    dialects = ("bid",)


TestOverTcp = OverTcp.TestCase
TestOverTcp.settings = HISTORIES
TestOverTcpNumbered = OverTcpNumbered.TestCase
TestOverTcpNumbered.settings = HISTORIES
TestOverUdpNumbered = OverUdpNumbered.TestCase
TestOverUdpNumbered.settings = HISTORIES
TestOverUdpAsked = OverUdpAsked.TestCase
TestOverUdpAsked.settings = settings(HISTORIES, max_examples=max(1, HISTORIES.max_examples // 2))


# ---------------------------------------------------------------------- histories that were wrong


@pytest.fixture
def history() -> Iterator[ClientMachine]:
    machine = OverTcp()
    yield machine
    machine.teardown()


def test_camera_that_somebody_else_loads_while_a_trigger_has_it_stopped_stays_stopped(
    history: ClientMachine,
) -> None:
    history.switched_on(dialect=HANDBOOK, application=None, quirks={}, restore=False)
    history.loss_of_a_result(seconds=0.0, steps=0, again=True)
    history.operator_switches(application=LINE, running=False, steps=None)
    history.there_and_back(application=LINE, how="trigger", ending="done", seconds=0.0, between=0)
    assert not history.box.device.running


def test_switch_of_a_camera_that_is_too_busy_ends_at_once_with_the_client(
    history: ClientMachine,
) -> None:
    history.switched_on(dialect=BID, application=None, quirks={}, restore=False)
    history.operator("stop", steps=None)
    history.switch(OTHER, steps=None)
    history.a_little_time_passes(0.05)
    history.close()
    assert history.calls == []
