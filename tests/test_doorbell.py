"""What the receive task sleeps on."""

from __future__ import annotations

import asyncio

import pytest

from smartcam._client.doorbell import Doorbell


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
