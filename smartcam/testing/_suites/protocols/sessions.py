"""Check how a session is opened, closed, lost, and taken over by another client."""
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
from smartcam.testing._suites.protocols.cameras_under_test import COUNTER, OTHER
from smartcam.testing._suites.protocols.client_checks import (
    EVENT_TIMEOUT,
    SHORT_TIMEOUT,
    check_balance,
    make_client,
    open_session,
    trigger_and_read,
    wait_until,
    with_event_loop,
)
from smartcam.testing._suites.protocols.parameters import SuiteBase

if TYPE_CHECKING:
    from smartcam import Camera
    from smartcam.testing._suites.protocols.cameras_under_test import CameraKind

FAST_RECONNECT = Backoff(initial=0.01, factor=2, maximum=0.1, jitter=0.0)


class SessionChecks(SuiteBase):
    """Checks of a session: opening, closing, loss, and takeover by another client."""

    @with_event_loop
    async def test_connect_with_the_dialect_knows_the_camera(self, camera_kind: CameraKind) -> None:
        """Check that URL, application and status are known after ``connect()``."""
        async with open_session(camera_kind) as (live, camera):
            assert camera.connected
            assert camera.url == live.url
            assert camera.active_application == COUNTER
            assert Status.RUNNING in camera.status
            assert f"dialect={camera.capabilities.dialect}" in live.url or "dialect" not in live.url
            assert await camera.query_application() == COUNTER
            await camera.wait_ready()

    @with_event_loop
    async def test_connect_without_the_dialect_finds_it_out(self, camera_kind: CameraKind) -> None:
        """Check that the client finds out the dialect and adds it to its URL."""
        async with camera_kind.open() as live:
            camera = smartcam.connect(
                live.url_without_dialect, interpret_as=camera_kind.numbers, reconnect=None
            )
            events = camera.events()
            async with camera:
                assert camera.url == live.url
                assert await trigger_and_read(camera) == 0
                async with asyncio.timeout(EVENT_TIMEOUT):
                    event = await anext(events)
                    while not isinstance(event, Connected):
                        event = await anext(events)
                assert event.url == live.url

    @with_event_loop
    async def test_connect_with_an_application_has_it_running(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the client switches to the application that was named."""
        async with open_session(camera_kind, application=OTHER) as (_, camera):
            assert camera.active_application == OTHER
            result = await camera.trigger()
            assert result.application == OTHER

    @with_event_loop
    async def test_close_ends_the_session_and_leaves_the_camera_as_it_is(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that closing ends the session, and that the camera keeps running; close twice."""
        async with camera_kind.open() as live:
            assert not live.has_session
            camera = await make_client(camera_kind, live)
            if camera.capabilities.switch and OTHER in camera_kind.applications:
                await camera.switch_application(OTHER)
            last_application = camera.active_application
            assert live.has_session
            await camera.close()
            await wait_until(lambda: not live.has_session)
            await camera.close()
            with pytest.raises(ConnectionClosedError):
                await camera.trigger()
            async with make_client(camera_kind, live) as second:
                assert second.active_application == last_application
                assert Status.RUNNING in second.status

    @with_event_loop
    async def test_lost_camera_is_reported_and_comes_back(self, camera_kind: CameraKind) -> None:
        """Check for Disconnected, then Reconnected, and that triggers work again."""
        async with open_session(camera_kind, reconnect=FAST_RECONNECT, liveness_timeout=0.4) as (
            live,
            camera,
        ):
            events = camera.events()
            await trigger_and_read(camera)
            await live.restart()
            await wait_until(lambda: not camera.connected)
            async with asyncio.timeout(EVENT_TIMEOUT):
                kinds = [type(await anext(events))]
                while kinds[-1] is not Reconnected:
                    kinds.append(type(await anext(events)))
            assert Disconnected in kinds
            await camera.wait_connected(EVENT_TIMEOUT)
            assert (await camera.trigger()).application == COUNTER
            assert camera.statistics().reconnects == 1
            check_balance(camera.statistics())

    @with_event_loop
    async def test_killed_camera_ends_what_waits_for_it(self, camera_kind: CameraKind) -> None:
        """Check that every wait and stream ends with a ConnectionLostError."""
        async with open_session(camera_kind, liveness_timeout=0.4) as (live, camera):
            waiting = asyncio.create_task(
                camera.wait_status(lambda _: False, timeout=EVENT_TIMEOUT)
            )
            results = camera.results()
            await trigger_and_read(camera)
            try:
                await live.kill()
            except pytest.skip.Exception:
                waiting.cancel()
                raise
            with pytest.raises(ConnectionLostError):
                await waiting
            with pytest.raises(ConnectionLostError):
                await camera.trigger(timeout=EVENT_TIMEOUT)
            assert not camera.connected
            async with asyncio.timeout(EVENT_TIMEOUT):
                assert (await anext(results)).value.n == 0
                with pytest.raises(ConnectionLostError):
                    await anext(results)
            check_balance(camera.statistics())

    @with_event_loop
    async def test_second_client_takes_the_camera_or_is_served_too(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the second client is served; an exclusive camera drops the first client."""
        async with (
            open_session(camera_kind) as (live, first),
            make_client(camera_kind, live) as second,
        ):
            assert await trigger_and_read(second) == 0
            if not camera_kind.exclusive:
                assert await trigger_and_read(first) == 1
            elif camera_kind.datagrams:
                with pytest.raises(TriggerTimeoutError):
                    await first.trigger(timeout=SHORT_TIMEOUT)
            else:
                with pytest.raises(ConnectionLostError):
                    await first.trigger(timeout=EVENT_TIMEOUT)
            await trigger_and_read(second)

    @with_event_loop
    async def test_two_that_want_the_camera_do_not_fight_for_it(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that one client gives up and the other keeps the camera, if it is exclusive."""
        async with (
            open_session(camera_kind, reconnect=FAST_RECONNECT) as (live, first),
            make_client(camera_kind, live, reconnect=FAST_RECONNECT) as second,
        ):
            if camera_kind.exclusive and not camera_kind.datagrams:
                await wait_until(lambda: was_displaced(first) or was_displaced(second))
                winner = second if was_displaced(first) else first
                await winner.wait_connected(EVENT_TIMEOUT)
                await trigger_and_read(winner)
                assert not was_displaced(winner)
            check_balance(first.statistics())
            check_balance(second.statistics())


def was_displaced(camera: Camera) -> bool:
    """Return True if a client has given up because another one has the camera."""
    try:
        camera.next_result().close()
    except ConnectionTakenError:
        return True
    except ConnectionLostError:
        pass
    return False
