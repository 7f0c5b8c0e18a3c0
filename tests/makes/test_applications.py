"""Test that a result counts only for its own application, whenever a client switches."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam.exceptions import InterpretationError, WrongApplicationError
from tests.handmade import until
from tests.makes.test_ifm import PATIENCE, Peer, scripted_device


@contextlib.asynccontextmanager
async def switching(**options: Any) -> AsyncIterator[tuple[list[int], Peer, smartcam.Camera[Any]]]:
    """Run a device that names the applications of a list in turn, then always the last."""
    applications = [1]

    class ApplicationAnswers(dict[str, bytes]):
        def __getitem__(self, line: str) -> bytes:
            if line != "A?":
                return super().__getitem__(line)
            active = applications.pop(0) if len(applications) > 1 else applications[0]
            return b"003\t%02d\t01\t02\t03" % active

    async with scripted_device(**options) as (peer, camera):
        peer.says = ApplicationAnswers(peer.says)
        yield applications, peer, camera


@pytest.mark.parametrize("named", [None, 1])
@pytest.mark.parametrize("listens", [False, True])
@pytest.mark.asyncio
async def test_ifm_trigger_never_returns_a_result_of_another_application(
    named: int | None, listens: bool
) -> None:
    async with (
        switching(application=named) as (active, peer, camera),
        contextlib.AsyncExitStack() as on,
    ):
        results = await on.enter_async_context(camera.results()) if listens else None
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        ticket, line = await peer.requests.get()
        assert line == "T?"
        active[:] = [2]
        peer.say(ticket, b"star;1;stop")
        with pytest.raises(WrongApplicationError, match="application 2 came"):
            await trigger
        account = camera.statistics()
        assert (account.triggered, account.received) == (0, 1)
        if results is not None:
            peer.say("0000", b"next")
            if named is None:
                async with asyncio.timeout(PATIENCE):
                    assert (await anext(results)).raw == b"next"


@pytest.mark.asyncio
async def test_ifm_result_of_the_application_that_is_active_all_the_time_is_returned() -> None:
    async with switching() as (active, peer, camera):
        active[:] = [2]
        assert await camera.query_application() == 2
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        ticket, _ = await peer.requests.get()
        peer.say(ticket, b"star;1;stop")
        result = await trigger
        assert (result.application, result.raw) == (2, b"star;1;stop")


@pytest.mark.asyncio
async def test_ifm_results_that_nobody_asked_for_are_of_the_application_that_is_active() -> None:
    async with switching() as (active, peer, camera), camera.results() as results:
        active[:] = [2, 2, 3]
        assert await camera.query_application() == 2
        peer.say("0000", b"a")
        async with asyncio.timeout(PATIENCE):
            first = await anext(results)
            assert (first.application, first.raw) == (2, b"a")
            peer.say("0000", b"b")  # and somebody switches to 3 before the question is answered
            with pytest.raises(InterpretationError, match="may be of any of 2, 3"):
                await anext(results)
            peer.say("0000", b"c")
            last = await anext(results)
        assert (last.application, last.raw) == (3, b"c")
        account = camera.statistics()
        assert (account.streamed, account.uninterpretable, account.received) == (2, 1, 3)


@pytest.mark.asyncio
async def test_mapping_reads_no_result_of_ifm_with_another_applications_layout() -> None:
    layouts = {1: "raw", 2: "strings50"}
    async with switching(interpret_as=layouts) as (active, peer, camera):
        active[:] = [2]
        trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
        ticket, _ = await peer.requests.get()
        active[:] = [1]
        peer.say(ticket, b"star;1;stop")
        with pytest.raises(InterpretationError, match="may be of any of 1, 2"):
            await trigger


@pytest.mark.asyncio
async def test_device_that_never_says_its_application_costs_the_link_and_no_wait() -> None:
    async with scripted_device(request_timeout=0.3, reconnect=None) as (peer, camera):
        del peer.says["A?"]
        peer.says["T?"] = b"star;1;stop"
        trigger = asyncio.create_task(camera.trigger(timeout=0.3))
        with pytest.raises(smartcam.SmartCamError):
            await trigger
        with pytest.raises(smartcam.SmartCamError):
            await camera.query_application()
        await until(lambda: not camera.connected)
        assert camera.statistics().triggered == 0


@pytest.mark.asyncio
async def test_iv3_trigger_never_returns_a_result_of_another_program() -> None:
    program = 1

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            nonlocal program
            while line := (await reader.readuntil(b"\r"))[:-1]:
                program += line == b"T2"
                writer.write(b"PR,%03d\r" % program if line == b"PR" else b"RT,00001,OK\r")
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, smartcam.connect(f"iv3://127.0.0.1:{port}") as camera:
        assert camera.active_application == 1
        with pytest.raises(WrongApplicationError, match="application 2 came"):
            await camera.trigger(timeout=PATIENCE)
        assert camera.statistics().triggered == 0
