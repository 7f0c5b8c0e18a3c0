"""Checks of a session: made, left, lost, taken."""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import smartcam
from smartcam import (
    Backoff,
    Connected,
    ConnectionClosedError,
    ConnectionLostError,
    ConnectionTakenError,
    Disconnected,
    Reconnected,
    Status,
    TriggerTimeoutError,
)
from smartcam.testing.suites.protocols.cameras_under_test import COUNTER, OTHER
from smartcam.testing.suites.protocols.client_checks import (
    SHORT,
    SOON,
    balance,
    client,
    in_a_loop,
    number,
    until,
    visiting,
)
from smartcam.testing.suites.protocols.parameters import Parameters

if TYPE_CHECKING:
    from smartcam import SmartCamera
    from smartcam.testing.suites.protocols.cameras_under_test import World

__all__ = ["SessionChecks"]

FAST = Backoff(initial=0.01, factor=2, maximum=0.1, jitter=0.0)


class SessionChecks(Parameters):
    """A session: made, left, lost, taken."""

    @in_a_loop
    async def test_connect_pinned_knows_the_camera(self, world: World) -> None:
        """URL, application and status are known when ``connect()`` is through."""
        async with visiting(world) as (site, camera):
            assert camera.connected
            assert camera.url == site.url
            assert camera.active_application == COUNTER
            assert Status.RUNNING in camera.status
            assert f"dialect={camera.capabilities.dialect}" in site.url or "dialect" not in site.url
            assert await camera.query_application() == COUNTER
            await camera.wait_ready()

    @in_a_loop
    async def test_connect_unpinned_finds_out_and_pins_it(self, world: World) -> None:
        """The dialect is found out, and then stands in the URL."""
        async with world.open() as site:
            camera = smartcam.connect(site.unpinned, interpret_as=world.numbers, reconnect=None)
            events = camera.events()
            async with camera:
                assert camera.url == site.url
                assert await number(camera) == 0
                async with asyncio.timeout(SOON):
                    event = await anext(events)
                    while not isinstance(event, Connected):
                        event = await anext(events)
                assert event.url == site.url

    @in_a_loop
    async def test_connect_with_an_application_has_it_running(self, world: World) -> None:
        """The one that was named is switched to."""
        async with visiting(world, application=OTHER) as (_, camera):
            assert camera.active_application == OTHER
            result = await camera.trigger()
            assert result.application == OTHER

    @in_a_loop
    async def test_close_ends_the_session_and_leaves_the_camera_as_it_is(
        self, world: World
    ) -> None:
        """The camera is told, and goes on running; closing twice is harmless."""
        async with world.open() as site:
            assert not site.has_session
            camera = await client(world, site)
            if camera.capabilities.switch:
                await camera.switch_application(OTHER)
            left_with = camera.active_application
            assert site.has_session
            await camera.close()
            await until(lambda: not site.has_session)
            await camera.close()
            with pytest.raises(ConnectionClosedError):
                await camera.trigger()
            async with client(world, site) as following:
                assert following.active_application == left_with
                assert Status.RUNNING in following.status

    @in_a_loop
    async def test_lost_camera_is_told_and_comes_back(self, world: World) -> None:
        """Disconnected, Reconnected, and triggers work again."""
        async with visiting(world, reconnect=FAST, liveness_timeout=0.4) as (site, camera):
            events = camera.events()
            await number(camera)
            await site.restart()
            await until(lambda: not camera.connected)
            async with asyncio.timeout(SOON):
                kinds = [type(await anext(events))]
                while kinds[-1] is not Reconnected:
                    kinds.append(type(await anext(events)))
            assert Disconnected in kinds
            await camera.wait_connected(SOON)
            assert (await camera.trigger()).application == COUNTER
            assert camera.statistics().reconnects == 1
            balance(camera.statistics())

    @in_a_loop
    async def test_killed_camera_ends_what_waits_for_it(self, world: World) -> None:
        """Every wait and stream ends with a ConnectionLostError."""
        async with visiting(world, liveness_timeout=0.4) as (site, camera):
            waiting = asyncio.create_task(camera.wait_status(lambda _: False, timeout=SOON))
            results = camera.results()
            await number(camera)
            try:
                await site.kill()
            except pytest.skip.Exception:
                waiting.cancel()
                raise
            with pytest.raises(ConnectionLostError):
                await waiting
            with pytest.raises(ConnectionLostError):
                await camera.trigger(timeout=SOON)
            assert not camera.connected
            async with asyncio.timeout(SOON):
                assert (await anext(results)).value.n == 0
                with pytest.raises(ConnectionLostError):
                    await anext(results)
            balance(camera.statistics())

    @in_a_loop
    async def test_newcomer_takes_the_camera_or_stands_beside(self, world: World) -> None:
        """As the world says."""
        async with visiting(world) as (site, first), client(world, site) as second:
            assert await number(second) == 0
            if not world.exclusive:
                assert await number(first) == 1
            elif world.datagrams:
                with pytest.raises(TriggerTimeoutError):
                    await first.trigger(timeout=SHORT)
            else:
                with pytest.raises(ConnectionLostError):
                    await first.trigger(timeout=SOON)
            await number(second)

    @in_a_loop
    async def test_two_that_want_the_camera_do_not_fight_for_it(self, world: World) -> None:
        """One gives up, the other keeps it."""
        async with (
            visiting(world, reconnect=FAST) as (site, first),
            client(world, site, reconnect=FAST) as second,
        ):
            if world.exclusive and not world.datagrams:
                await until(lambda: is_taken(first) or is_taken(second))
                left = second if is_taken(first) else first
                await left.wait_connected(SOON)
                await number(left)
                assert not is_taken(left)
            balance(first.statistics())
            balance(second.statistics())


def is_taken(camera: SmartCamera) -> bool:
    """Whether a client has given up because another one has the camera."""
    try:
        camera.next_result().close()
    except ConnectionTakenError:
        return True
    except ConnectionLostError:
        pass
    return False
