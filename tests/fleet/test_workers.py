"""The tasks of an agent that carry out triggers."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest

from tests.fleet.inside import Workers, workers


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
        pool.take().do(partial(work, name))
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
    first = pool.take()
    first.do(partial(wait, never))
    await turns()
    first.task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await first.task
    second = pool.take()
    assert second is not first
    second.do(partial(asyncio.sleep, 0))
    await turns()
    assert pool.take() is second
    second.task.cancel()
    await asyncio.gather(second.task, return_exceptions=True)


async def wait(event: asyncio.Event) -> None:
    await event.wait()


async def test_no_more_workers_are_kept_than_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "MAX_IDLE_WORKERS", 2)
    pool, go = Workers(), asyncio.Event()
    begun = [pool.take() for _ in range(5)]
    for one in begun:
        one.do(partial(wait, go))
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
    one = pool.take()
    one.do(partial(wait, go))
    await turns()
    assert pool.close() == []
    go.set()
    await asyncio.wait_for(one.task, 1.0)
