"""Resources are closed even if their tasks are cancelled before their first step."""

from __future__ import annotations

import asyncio
import functools

import pytest

from smartcam._finishing import close_all, finish


async def test_all_are_closed_when_every_task_is_cancelled_at_once() -> None:
    closed: list[int] = []

    async def close(number: int) -> None:
        closed.append(number)

    closing = asyncio.create_task(close_all([functools.partial(close, n) for n in range(3)]))
    before = asyncio.all_tasks()
    while asyncio.all_tasks() == before:  # noqa: ASYNC110 - until they are there, and have not run
        await asyncio.sleep(0)
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    assert sorted(closed) == [0, 1, 2]


async def test_an_error_of_one_leaves_none_open_when_every_task_is_cancelled_at_once() -> None:
    closed: list[int] = []

    async def close(number: int) -> None:
        closed.append(number)
        raise OSError(number)

    closing = asyncio.create_task(close_all([functools.partial(close, n) for n in range(3)]))
    before = asyncio.all_tasks()
    while asyncio.all_tasks() == before:  # noqa: ASYNC110 - until they are there, and have not run
        await asyncio.sleep(0)
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    with pytest.raises(OSError, match="0"):
        await closing
    assert sorted(closed) == [0, 1, 2]


async def test_one_is_closed_when_every_task_is_cancelled_at_once() -> None:
    closed: list[int] = []

    async def close() -> None:
        closed.append(1)

    closing = asyncio.create_task(finish(close))
    before = asyncio.all_tasks()
    while asyncio.all_tasks() == before:  # noqa: ASYNC110 - until it is there, and has not run
        await asyncio.sleep(0)
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await closing
    assert closed == [1]
