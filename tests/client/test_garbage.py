"""A client that nobody has any more and that was not closed says so, and gives the camera back."""

from __future__ import annotations

import asyncio
import gc
import warnings
import weakref
from typing import Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from tests.client.clientkit import gone
from tests.handmade import until
from tests.insides import inside

COUNTING: list[dict[str, Any]] = [
    {"id": 1, "layout": "n: int32", "generator": "sequence"},
    {"id": 2, "layout": "n: int32", "generator": "sequence", "rate": 100.0},  # runs by itself
]


def names_of_tasks() -> set[str]:
    return {task.get_name() for task in asyncio.all_tasks()}


def drop(kept: list[Any]) -> None:
    """Have nobody refer to what is in a list."""
    kept.clear()
    gc.collect()


async def test_client_that_nobody_has_gives_its_session_back() -> None:
    before = names_of_tasks()
    async with EmulatedCamera(COUNTING, builtins=False) as emulator:
        kept = [await smartcam.connect(emulator.url)]
        await kept[0].trigger(1)
        assert emulator.has_session
        with pytest.warns(ResourceWarning, match="SmartCamera .* was not closed"):
            drop(kept)
        await until(lambda: not emulator.links)
        assert str(emulator.log[-1].message) == "Disconnect()"
        await until(lambda: names_of_tasks() == before)
        async with smartcam.connect(emulator.url) as other:
            await other.trigger(1)


async def test_client_that_nobody_has_ends_between_two_sessions() -> None:
    before = names_of_tasks()
    async with EmulatedCamera(COUNTING, builtins=False) as emulator:
        later = smartcam.Backoff(initial=60, maximum=60, jitter=0)
        kept = [await smartcam.connect(emulator.url, reconnect=later)]
        emulator.inject({"kind": "close"})
        for _ in range(2):
            assert isinstance(await gone(kept[0].trigger(1)), smartcam.ConnectionLostError)
        await asyncio.sleep(0)  # asyncio itself has what a task was woken by until it waits again
        with pytest.warns(ResourceWarning):
            drop(kept)
        await until(lambda: names_of_tasks() == before)


async def test_stream_alone_keeps_its_client() -> None:
    async with EmulatedCamera(COUNTING, builtins=False) as emulator:
        kept = [await smartcam.connect(emulator.url, application=2)]
        streams = [kept[0].results()]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            drop(kept)
        for _ in range(5):
            assert (await anext(streams[0])).application == 2
        with pytest.warns(ResourceWarning):
            drop(streams)
        await until(lambda: not emulator.links)


async def test_client_that_was_closed_or_never_opened_says_nothing() -> None:
    async with EmulatedCamera(COUNTING, builtins=False) as emulator:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            async with smartcam.connect(emulator.url) as camera:
                await camera.trigger(1)
            del camera
            smartcam.connect(emulator.url)
            gc.collect()


async def test_client_that_was_closed_goes_without_the_collector() -> None:
    async with EmulatedCamera(COUNTING, builtins=False) as emulator:
        async with smartcam.connect(emulator.url) as camera:
            await camera.trigger(1)
        supervisor = inside(camera)._supervisor
        parts = [
            weakref.ref(one)
            for one in (camera, supervisor, supervisor._dispatch, inside(camera)._requests)
        ]
        gc.disable()
        try:
            del camera, supervisor
            await asyncio.sleep(0)  # asyncio itself has what a task was woken by
            assert [one() for one in parts] == [None] * len(parts)
        finally:
            gc.enable()


def test_client_of_a_loop_that_is_closed_says_nothing_more() -> None:
    async def main() -> None:
        async with EmulatedCamera(COUNTING, builtins=False) as emulator:
            kept.append(await smartcam.connect(emulator.url))

    kept: list[smartcam.Camera] = []
    asyncio.run(main())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept.clear()  # its task was ended with the loop, and its link with that
        gc.collect()
