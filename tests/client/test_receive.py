"""The receive task: bounded work and memory, its sleep, no error of users' to the transport."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import pytest

import smartcam
from smartcam import Camera, CameraEvent, InterpretationError, Result, SmartCamError, Status
from smartcam.observers import Observer, TraceEntry
from tests.client.camera_by_hand import READY, RUNNING
from tests.client.clientkit import balance, by_hand
from tests.client.inside import (
    MAX_CHUNK_FRAMES,
    DirectFuture,
    Doorbell,
    LinksOfLoop,
    handshake,
    link,
)
from tests.handmade import CONNECT_ANSWER, OPENING, QUERY, RESULT, STATUS, Peer, scripted, until

# ---------------------------------------------------------------------- what comes early


@pytest.mark.parametrize(
    ("begins", "step"),
    [
        (CONNECT_ANSWER, "waiting for the first status"),
        (CONNECT_ANSWER + STATUS, "waiting for the answer to Query"),
    ],
)
async def test_camera_that_floods_while_a_session_is_made_ends_the_attempt(
    begins: bytes, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(handshake, "MAX_EARLY_BYTES", 100_000)
    written: list[int] = []

    async def talk(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING) if number == 0 else 12)
        peer.write(begins)
        written.append(0)
        while not peer.writer.is_closing():
            peer.write(RESULT * 1000)
            written[-1] += 1000 * len(RESULT)
            try:
                await peer.writer.drain()
            except ConnectionError:
                return

    async with scripted(talk) as listener:
        url = f"bvs://127.0.0.1:{listener.port}?dialect=handbook"
        camera = smartcam.connect(url, connect_attempts=2, max_length=50_000)
        with pytest.raises(smartcam.ConnectFailedError, match="before there was a session") as got:
            await camera.open()
    assert len(got.value.attempts) == 2
    assert all(step in attempt for attempt in got.value.attempts)
    assert "150000 are accepted" in got.value.attempts[0]


async def test_results_that_come_early_are_kept_up_to_the_bound() -> None:
    async def talk(peer: Peer, number: int) -> None:
        await peer.read(len(OPENING))
        peer.write(CONNECT_ANSWER + RESULT * 500 + STATUS)
        assert await peer.read(12) == QUERY
        peer.write(RESULT * 500 + bytes.fromhex("50535642 04000000 30000000 15000000"))
        await peer.rest()
        peer.close()

    async with scripted(talk) as listener:
        url = f"bvs://127.0.0.1:{listener.port}?dialect=handbook"
        camera = smartcam.connect(url)
        results = camera.results()
        async with camera:
            assert camera.statistics().received == 1000
            assert results.statistics().queued == 1000


# ---------------------------------------------------------------------- what users' code raises


class Rude(Observer):
    """Raises whatever it is told, at everything."""

    def __init__(self, kind: type[BaseException]) -> None:
        self.kind = kind

    def on_frame(self, entry: TraceEntry) -> None:
        raise self.kind

    def on_state(self, event: CameraEvent) -> None:
        raise self.kind

    def on_result(self, result: Result) -> None:
        raise self.kind

    def on_error(self, camera: str, error: SmartCamError, triggered_at: Any = None) -> None:
        raise self.kind


KINDS = pytest.mark.parametrize("kind", [ZeroDivisionError, asyncio.CancelledError])


@KINDS
async def test_observer_that_raises_disturbs_nothing(kind: type[BaseException]) -> None:
    async with by_hand(observers=[Rude(kind)], reconnect=None) as (_, camera):
        for _ in range(3):
            assert (await camera.trigger()).raw == b"found"
        assert camera.connected
        assert camera.statistics().sessions == 1


@KINDS
async def test_interpreter_that_raises_is_an_outcome(kind: type[BaseException]) -> None:
    def fail(reader: object) -> object:
        raise kind

    async with by_hand(interpret_as=fail, reconnect=None) as (_, camera):
        for _ in range(2):
            with pytest.raises(InterpretationError, match=kind.__name__):
                await camera.trigger()
        assert (await camera.trigger(interpret_as="raw")).raw == b"found"
        assert camera.statistics().sessions == 1


@KINDS
async def test_interpreter_of_a_burst_that_raises_is_an_error_in_the_stream(
    kind: type[BaseException],
) -> None:
    class Calibration:
        def to_robot(self, parts: list[Any]) -> list[Any]:
            raise kind

    async with by_hand(interpret_as="localizations", calibration=Calibration(), reconnect=None) as (
        box,
        camera,
    ):
        results = camera.results()
        part = b"a".ljust(50, b"\0") + bytes(4 * 5 - 1) + b"\x3f"
        box.send(box.result_frame(part) * 3)
        for _ in range(3):
            with pytest.raises(InterpretationError, match=kind.__name__):
                await anext(results)
        assert camera.connected
        balance(camera.statistics())


@KINDS
async def test_predicate_that_raises_tells_its_caller(kind: type[BaseException]) -> None:
    def fail(status: Status) -> bool:
        if status == Status.BUSY:
            raise kind
        return False

    async with by_hand(reconnect=None) as (box, camera):
        waiting = asyncio.create_task(camera.wait_status(fail))
        await asyncio.sleep(0)
        box.report(0x10, READY)
        with pytest.raises(kind):
            await waiting
        assert (await camera.trigger()).raw == b"found"
        assert camera.statistics().sessions == 1


# ---------------------------------------------------------------------- the account


async def test_account_balances_while_an_interpreter_runs() -> None:
    seen: list[int] = []
    cameras: list[Camera] = []

    def look(reader: object) -> int:
        statistics = cameras[0].statistics()
        balance(statistics)
        seen.append(statistics.received)
        return 0

    async with by_hand(interpret_as=look) as (box, camera):
        cameras.append(camera)
        results = camera.results()
        await camera.trigger()
        box.send(box.result_frame() + box.status_frame(RUNNING) + box.result_frame())
        for _ in range(3):
            await anext(results)
        assert seen == [0, 1, 2]
        assert camera.statistics().received == 3


# ---------------------------------------------------------------------- fairness


async def test_flood_of_statuses_leaves_others_their_turns() -> None:
    """While one camera's statuses are worked off, the loop goes round many times."""
    async with by_hand() as (box, camera):
        turns = 0

        async def count() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        heard = camera.statistics().frames_received
        counting = asyncio.create_task(count())
        flood = box.status_frame(RUNNING) + box.status_frame(READY)
        box.send(flood * 5000)
        async with asyncio.timeout(60):
            while camera.statistics().frames_received < heard + 10_000:  # noqa: ASYNC110
                await asyncio.sleep(0)
        counting.cancel()
        assert turns > 10_000 / MAX_CHUNK_FRAMES
        await until(lambda: camera.status == Status(READY))


@pytest.mark.parametrize(("shared", "piece"), [(False, 20), (True, 5)])
async def test_flood_is_worked_off_in_smaller_pieces_where_others_share_the_loop(
    shared: bool, piece: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of results that take 10 us each: 200 us of them in a turn, or 50 us."""
    now = 0.0
    monkeypatch.setattr(link, "thread_time", lambda: now)

    class Slow(Observer):
        def on_result(self, result: Result) -> None:
            nonlocal now
            now += 10e-6

    async with contextlib.AsyncExitStack() as stack:
        box, camera = await stack.enter_async_context(by_hand(observers=[Slow()]))
        stack.push_async_exit(camera.results())
        if shared:
            await stack.enter_async_context(by_hand())
        box.send(box.result_frame(b"") * 2000)
        pieces: list[float] = []
        async with asyncio.timeout(60):
            while now < 2000 * 10e-6 * 0.999:
                before = now
                await asyncio.sleep(0)
                pieces.append(round((now - before) / 10e-6))
    assert max(pieces[len(pieces) // 2 :]) == piece


async def test_flood_gives_way_again_while_others_are_at_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Other links that take more than a piece of time have four turns to one of a flood."""
    now = 0.0
    monkeypatch.setattr(link, "thread_time", lambda: now)
    monkeypatch.setattr(link, "perf_counter", lambda: now)

    class Slow(Observer):
        def on_result(self, result: Result) -> None:
            nonlocal now
            now += 10e-6

    async with by_hand(observers=[Slow()]) as (box, camera), by_hand(), camera.results():
        box.send(box.result_frame(b"") * 2000)
        turns: list[bool] = []
        async with asyncio.timeout(60):
            while camera.statistics().received < 2000:
                now, before = now + 60e-6, camera.statistics().received
                await asyncio.sleep(0)
                turns.append(camera.statistics().received > before)
    behind = turns[len(turns) // 2 :]
    assert behind.count(True) * link.MAX_TURNS_PER_CHUNK < 1.1 * len(behind)


async def test_link_that_has_ended_shares_no_loop() -> None:
    loop = asyncio.get_running_loop()
    async with by_hand(), by_hand():
        assert LinksOfLoop.of(loop).open == 2
    assert LinksOfLoop.of(loop).open == 0


# ----------------------------------------------------------------------
# What the receive task sleeps on.


async def asleep(bell: Doorbell, heard: list[str], times: int = 1) -> str:
    for _ in range(times):
        await bell
        heard.append("ring")
    return "done"


async def test_ring_from_a_callback_of_the_loop_wakes_the_task_at_once() -> None:
    loop = asyncio.get_running_loop()
    bell, heard, seen = Doorbell(loop), list[str](), list[list[str]]()
    task = asyncio.create_task(asleep(bell, heard, 2))
    await asyncio.sleep(0)

    def ring() -> None:
        bell.ring()
        seen.append(list(heard))

    loop.call_soon(ring)
    loop.call_soon(ring)
    assert await task == "done"
    assert seen == [["ring"], ["ring", "ring"]]


async def test_ring_from_a_task_wakes_in_the_next_turn() -> None:
    bell, heard = Doorbell(asyncio.get_running_loop()), list[str]()
    task = asyncio.create_task(asleep(bell, heard))
    await asyncio.sleep(0)
    bell.ring()
    bell.ring()  # nobody sleeps on it any more
    assert heard == []
    assert await task == "done"
    assert heard == ["ring"]


async def test_ring_without_anybody_is_nothing() -> None:
    bell = Doorbell(asyncio.get_running_loop())
    bell.ring()
    task = asyncio.create_task(asleep(bell, []))
    await asyncio.sleep(0)
    assert not task.done()
    bell.ring()
    await task


async def test_what_the_woken_task_raises_ends_it_and_not_who_rang() -> None:
    bell = Doorbell(asyncio.get_running_loop())

    async def fail() -> None:
        await bell
        raise ZeroDivisionError

    task = asyncio.create_task(fail())
    await asyncio.sleep(0)
    went_on = asyncio.get_running_loop().create_future()

    def ring() -> None:
        bell.ring()
        went_on.set_result(None)

    asyncio.get_running_loop().call_soon(ring)
    await went_on
    with pytest.raises(ZeroDivisionError):
        await task


@pytest.mark.parametrize("rings", [False, True])
async def test_cancelled_task_wakes_and_the_bell_can_be_used_again(*, rings: bool) -> None:
    bell, heard = Doorbell(asyncio.get_running_loop()), list[str]()
    task = asyncio.create_task(asleep(bell, heard))
    await asyncio.sleep(0)
    task.cancel()
    if rings:
        bell.ring()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert heard == []
    again = asyncio.create_task(asleep(bell, heard))
    await asyncio.sleep(0)
    bell.ring()
    assert await again == "done"


async def test_ring_and_then_cancel_ends_the_task_once() -> None:
    bell, heard = Doorbell(asyncio.get_running_loop()), list[str]()
    task = asyncio.create_task(asleep(bell, heard))
    await asyncio.sleep(0)
    bell.ring()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert heard == []


async def test_task_keeps_its_context() -> None:
    import contextvars

    who = contextvars.ContextVar("who", default="nobody")
    bell = Doorbell(asyncio.get_running_loop())

    async def look() -> str:
        who.set("the task")
        await bell
        return who.get()

    task = asyncio.create_task(look())
    await asyncio.sleep(0)
    asyncio.get_running_loop().call_soon(bell.ring)
    assert await task == "the task"
    assert who.get() == "nobody"


# What a caller sleeps on, whose outcome the receive task sets.


async def receive(bell: Doorbell, deliver: Callable[[], object]) -> None:
    while True:
        await bell
        deliver()


@pytest.fixture
async def bell() -> Doorbell:
    return Doorbell(asyncio.get_running_loop())


async def ask(outcome: DirectFuture[str], heard: list[str]) -> str:
    found = await outcome
    heard.append(found)
    return found


async def delivered(bell: Doorbell, do: Callable[[], object], heard: list[str]) -> list[str]:
    """Have the receive task do something in a delivery; return what was heard right behind it."""
    receiving = asyncio.create_task(receive(bell, do))
    await asyncio.sleep(0)
    seen: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()

    def come() -> None:
        bell.deliver()
        seen.set_result(list(heard))

    asyncio.get_running_loop().call_soon(come)
    found = await seen
    receiving.cancel()
    return found


async def test_outcome_of_a_delivery_wakes_its_caller_at_once(bell: Doorbell) -> None:
    heard = list[str]()
    outcome: DirectFuture[str] = bell.make_future()
    caller = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)
    assert await delivered(bell, lambda: outcome.set_result("here"), heard) == ["here"]
    assert await caller == "here"


async def test_outcome_that_is_given_wakes_its_caller_at_once(bell: Doorbell) -> None:
    heard, said = list[str](), asyncio.get_running_loop().create_future()
    outcome: DirectFuture[str] = bell.make_future()
    asking = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)

    def give() -> None:
        bell.set_future(outcome, "it")
        said.set_result([*heard])

    asyncio.get_running_loop().call_soon(give)
    assert await said == ["it"]
    await asking


async def test_outcome_that_a_task_gives_wakes_its_caller_by_the_loop(bell: Doorbell) -> None:
    heard = list[str]()
    outcome: DirectFuture[str] = bell.make_future()
    asking = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)
    bell.set_future(outcome, "it")
    assert heard == []
    assert await asking == "it"


async def test_error_of_a_delivery_reaches_its_caller(bell: Doorbell) -> None:
    heard = list[str]()
    outcome: DirectFuture[str] = bell.make_future()
    caller = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)
    await delivered(bell, lambda: outcome.set_exception(ZeroDivisionError()), heard)
    with pytest.raises(ZeroDivisionError):
        await caller
    with pytest.raises(asyncio.InvalidStateError):
        outcome.set_result("too late")


async def test_outcome_that_comes_otherwise_wakes_by_the_loop(bell: Doorbell) -> None:
    heard = list[str]()
    outcome: DirectFuture[str] = bell.make_future()
    caller = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)
    outcome.set_result("here")
    assert heard == []
    assert await caller == "here"
    assert await ask(outcome, heard) == "here"  # one that is there is not waited for


@pytest.mark.parametrize("first", ["cancel", "result"])
async def test_cancelled_caller_of_an_outcome_is_cancelled_once(first: str, bell: Doorbell) -> None:
    heard = list[str]()
    outcome: DirectFuture[str] = bell.make_future()
    caller = asyncio.create_task(ask(outcome, heard))
    await asyncio.sleep(0)

    def both() -> None:
        if first == "result":
            outcome.set_result("here")
        caller.cancel()
        if first == "cancel":
            assert outcome.cancelled()

    await delivered(bell, both, heard)
    with pytest.raises(asyncio.CancelledError):
        await caller
    assert heard == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_caller_that_ends_the_program_behind_its_result_ends_it(
    error: type[BaseException], loop: str
) -> None:
    left: list[asyncio.Task[None]] = []

    async def main() -> None:
        async with by_hand(reconnect=None) as (_, camera):

            async def leave() -> None:
                await camera.trigger()
                raise error

            left.append(asyncio.create_task(leave()))
            await asyncio.sleep(5)  # the loop ends in it

    factory = pytest.importorskip("uvloop").new_event_loop if loop == "uvloop" else None
    with asyncio.Runner(loop_factory=factory) as runner, pytest.raises(error):
        runner.run(main())
    assert isinstance(left[0].exception(), error)
