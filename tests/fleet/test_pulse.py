"""An agent that was stopped carries no waiting message out too late; its tasks for triggers."""

from __future__ import annotations

import asyncio
import json
import signal
from functools import partial
from typing import Any

import pytest

from smartcam.fleet._agent import pulse as _pulse
from smartcam.fleet._agent import workers
from smartcam.fleet._agent.pulse import Pulse
from smartcam.fleet._agent.workers import Workers
from smartcam.fleet._inside import Keys
from tests.fleet.fleetkit import FLEET, NAME, PATIENCE, NumberedCamera, until
from tests.fleet.partner import partner
from tests.fleet.plainkit import NAME as PLAIN_NAME
from tests.fleet.plainkit import plant, zenoh_session
from tests.processes import free_place

STOPPED = 3.0


def hold_up(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the clock go on without a look at it, as it does for a process that is stopped."""
    loop = asyncio.get_running_loop()
    time = loop.time
    monkeypatch.setattr(loop, "time", lambda: time() + seconds)


async def test_what_comes_behind_a_stop_may_have_waited_as_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pulse = Pulse()
    pulse.open()
    try:
        await asyncio.sleep(10.0)
        assert pulse.max_wait() == 0.0
        hold_up(STOPPED, monkeypatch)
        first = pulse.max_wait()
        assert STOPPED <= first <= STOPPED + _pulse.BEAT_INTERVAL
        await asyncio.sleep(_pulse.BACKLOG_TIME / 2)  # it comes out of the system's buffers yet
        assert pulse.max_wait() == pytest.approx(first + _pulse.BACKLOG_TIME / 2, abs=0.01)
        await asyncio.sleep(_pulse.BACKLOG_TIME)
        assert pulse.max_wait() == 0.0
    finally:
        pulse.close()
        pulse.close()


async def test_second_stop_counts_from_the_first_while_that_is_not_settled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pulse = Pulse()
    pulse.open()
    try:
        hold_up(STOPPED, monkeypatch)
        pulse.max_wait()
        await asyncio.sleep(_pulse.BACKLOG_TIME / 2)
        hold_up(STOPPED, monkeypatch)
        assert pulse.max_wait() >= 2 * STOPPED + _pulse.BACKLOG_TIME / 2
    finally:
        pulse.close()


async def test_command_that_waited_longer_than_its_timeout_is_not_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with plant() as place:
        pulse = place.server._agent._json_services._pulse  # type: ignore[union-attr]
        monkeypatch.setattr(pulse, "max_wait", lambda: STOPPED)
        for answer in (
            await place.client.call("trigger", timeout=0.5),
            await place.client.call("stop", timeout=STOPPED),
        ):
            assert answer["kind"].endswith("TimeoutError")
            assert "hung for 3.0 s" in answer["error"]
            assert "was not done" in answer["error"]
        late = await place.client.thesis("TriggerLocalization", timeout=0.5)
        assert "was not done" in late["error"]
        assert (await place.client.ask("cameras/**"))[0][1]["next_result"] == 1
        # there is time left
        assert (await place.client.call("trigger", timeout=PATIENCE))["error"] == ""
        assert place.server.shared_cameras[PLAIN_NAME].results.next_number == 2


@pytest.mark.real_time
@pytest.mark.long
async def test_command_behind_a_stopped_agent_is_not_done_when_it_goes_on() -> None:
    pytest.importorskip("zenoh")
    place = free_place()
    key = Keys(FLEET).service(NAME, "trigger")
    async with NumberedCamera() as box, partner("agent", place, box.url) as agent:
        session = await asyncio.to_thread(zenoh_session, int(place.rpartition(":")[2]))

        def ask(timeout: float) -> list[dict[str, Any]]:
            payload = json.dumps({"timeout": timeout})
            replies = session.get(key, payload=payload, timeout=PATIENCE)
            return [json.loads(one.ok.payload.to_bytes()) for one in replies]

        try:
            await until(lambda: box.sessions)
            assert (await asyncio.to_thread(ask, PATIENCE))[0]["error"] == ""
            runs = box.runs
            agent.signal(signal.SIGSTOP)
            waiting = [asyncio.create_task(asyncio.to_thread(ask, 0.5)) for _ in range(5)]
            patient = asyncio.create_task(asyncio.to_thread(ask, PATIENCE))
            await asyncio.sleep(STOPPED)
            agent.signal(signal.SIGCONT)
            for (answer,) in await asyncio.gather(*waiting):
                assert answer["kind"] == "TriggerTimeoutError"
                assert "process hung" in answer["error"]
            ((answer,),) = await asyncio.gather(patient)
            assert answer["error"] == ""
            assert box.runs == runs + 1
            await asyncio.sleep(_pulse.BACKLOG_TIME + _pulse.STOPPED_AFTER)
            assert (await asyncio.to_thread(ask, 5.0))[0]["error"] == ""
        finally:
            await asyncio.to_thread(session.close)


# ---------------------------------------------------------------------- workers


async def turns(count: int = 3) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def in_the_loop(call: partial[None]) -> asyncio.Future[None]:
    """Call something as the bus does: in the event loop, and in no task."""
    loop = asyncio.get_running_loop()
    called = loop.create_future()

    def run() -> None:
        call()
        called.set_result(None)

    loop.call_soon(run)
    return called


async def test_worker_that_waits_begins_its_work_at_once() -> None:
    pool, said = Workers(), list[str]()

    async def work(name: str) -> None:
        said.append(f"{name} begins")
        await asyncio.sleep(0)
        said.append(f"{name} ends")

    def begin(name: str) -> None:
        pool.get_worker().start_work(partial(work, name))
        said.append(f"{name} was given")

    await in_the_loop(partial(begin, "first"))
    await turns()
    assert said == ["first was given", "first begins", "first ends"]  # by the loop's next turn
    await in_the_loop(partial(begin, "second"))
    await turns()
    assert said[3:] == ["second begins", "second was given", "second ends"]
    tasks = pool.close()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert len(tasks) == 1  # one did both


async def test_worker_that_is_cancelled_at_its_work_does_no_more() -> None:
    pool = Workers()
    never = asyncio.Event()
    first = pool.get_worker()
    first.start_work(partial(wait, never))
    await turns()
    first.task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await first.task
    second = pool.get_worker()
    assert second is not first
    second.start_work(partial(asyncio.sleep, 0))
    await turns()
    assert pool.get_worker() is second
    second.task.cancel()
    await asyncio.gather(second.task, return_exceptions=True)


async def test_worker_that_is_cancelled_as_its_work_ends_gets_no_other_work() -> None:
    pool, done = Workers(), list[str]()
    first = pool.get_worker()

    async def cancel_itself() -> None:
        first.task.cancel()  # as a program's cancellation does that comes while the reply is sent

    async def work() -> None:
        done.append("second")

    first.start_work(cancel_itself)
    await turns(1)
    pool.get_worker().start_work(work)  # the first one waits, and has not noticed yet
    await turns()
    assert done == ["second"]
    await asyncio.gather(first.task, return_exceptions=True)
    third = pool.get_worker()
    third.task.cancel()
    await asyncio.gather(third.task, return_exceptions=True)
    pool.get_worker().start_work(work)
    await turns()
    assert done == ["second", "second"]
    await asyncio.gather(*pool.close(), return_exceptions=True)


async def wait(event: asyncio.Event) -> None:
    await event.wait()


async def test_no_more_workers_are_kept_than_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "MAX_IDLE_WORKERS", 2)
    pool, go = Workers(), asyncio.Event()
    begun = [pool.get_worker() for _ in range(5)]
    for one in begun:
        one.start_work(partial(wait, go))
    await turns()
    go.set()
    await turns(6)
    assert sum(one.task.done() for one in begun) == 3
    idle = pool.close()
    await asyncio.gather(*idle, return_exceptions=True)
    assert len(idle) == 2
    assert all(one.task.done() for one in begun)


async def test_closed_workers_end_with_the_work_under_way() -> None:
    pool, go = Workers(), asyncio.Event()
    one = pool.get_worker()
    one.start_work(partial(wait, go))
    await turns()
    assert pool.close() == []
    go.set()
    await asyncio.wait_for(one.task, 1.0)
