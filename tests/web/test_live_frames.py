"""Frames of a fleet's camera on its live page, if it has some and while there are viewers."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any, NamedTuple

import aiohttp
import pytest

from smartcam.exceptions import FrameSourceError
from smartcam.web import LiveSite
from tests.fleet.fleetkit import Plant, until
from tests.fleet.framekit import FramePlant
from tests.frames.drivers import frame
from tests.web.sitekit import TOKEN, Caller

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.fleet import FleetCamera

PROTOCOL = "smartcam.frames"


simplejpeg = pytest.importorskip("simplejpeg", reason="needs the extra frames")


class World(NamedTuple):
    """A camera of a plant, its page, and who calls that."""

    camera: FleetCamera[Any]
    site: LiveSite
    caller: Caller

    @contextlib.asynccontextmanager
    async def looking(self, **options: Any) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
        """Connect as the page does; the first message was received."""
        url = self.caller.url("/api/frames")
        options = {"protocols": [PROTOCOL], **options}
        async with asyncio.timeout(60), self.caller.session.ws_connect(url, **options) as socket:
            yield socket

    async def seen(self, there: bool = True) -> None:
        """Wait until the page knows whether there are frames."""
        await until(lambda: self.site.state()["frames"] is there)


@contextlib.asynccontextmanager
async def shown(plant: Plant, *, token: str | None = None) -> AsyncIterator[World]:
    """Show the camera of a plant."""
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    async with contextlib.AsyncExitStack() as stack:
        camera = await stack.enter_async_context(plant.camera())
        site = await stack.enter_async_context(LiveSite(camera, token=token))
        session = await stack.enter_async_context(aiohttp.ClientSession(headers=headers))
        yield World(camera, site, Caller(site, session, ""))


async def next_picture(socket: aiohttp.ClientWebSocketResponse) -> tuple[dict[str, Any], Any]:
    """Return the description of the next picture, and its pixels."""
    while True:
        message = await socket.receive()
        if message.type is aiohttp.WSMsgType.BINARY:
            break
        assert message.type is aiohttp.WSMsgType.TEXT, message
    end = 4 + int.from_bytes(message.data[:4], "little")
    pixels = simplejpeg.decode_jpeg(message.data[end:], colorspace="GRAY")[..., 0]
    return json.loads(message.data[4:end])["frame"], pixels


async def test_frames_are_shown_while_somebody_looks() -> None:
    async with FramePlant() as plant, shown(plant) as world:
        await world.seen()
        await until(lambda: "open" in plant.driver.calls)
        assert (await world.caller.get("/api/camera"))["frames"] is True
        async with world.looking() as socket:
            await plant.driver.streams()
            for number in (70, 140):
                plant.driver.give(frame(number))
                about, pixels = await next_picture(socket)
                assert (about["sequence"], pixels.shape) == (number, (2, 4))
                assert abs(int(pixels.mean()) - number) <= 2
                await socket.send_str("next")
        await plant.driver.rests()
        assert plant.driver.calls == ["open", "start", "stop"]


async def test_two_who_look_are_one_stream_of_the_agent() -> None:
    async with FramePlant() as plant, shown(plant) as world:
        await world.seen()
        async with world.looking() as one, world.looking() as other:
            await plant.driver.streams()
            await until(lambda: len(world.site.frames.pictures.viewers) == 2)  # type: ignore[union-attr]
            plant.driver.give(frame(9))
            for socket in (one, other):
                assert (await next_picture(socket))[0]["sequence"] == 9
            assert len(plant.shared._streams) == 1


async def test_camera_without_frames_is_not_asked_for_any() -> None:
    async with Plant() as plant, shown(plant) as world:
        answer = await world.caller.call("GET", "/api/frames")
        assert answer.status == 404
        assert "a camera without frames" in answer.value["error"]
        await asyncio.sleep(5)  # of the loop's own time
        assert world.site.state()["frames"] is False
        assert "frame_client" not in vars(world.camera)  # which would ask


async def test_device_that_is_not_there_says_why_and_comes() -> None:
    async with FramePlant() as plant:
        plant.driver.fails["open"] = FrameSourceError("scripted: no such device")
        async with shown(plant) as world:
            await world.seen()
            async with world.looking() as socket:
                while (
                    "no such device" not in (told := json.loads(await socket.receive_str()))["text"]
                ):
                    assert told["state"] == "not_open"
                del plant.driver.fails["open"]
                while json.loads(await socket.receive_str())["state"] != "no_frame_yet":
                    pass
                await plant.driver.streams()
                plant.driver.give(frame(5))
                assert (await next_picture(socket))[0]["sequence"] == 5


async def test_agent_that_goes_and_comes_is_reported() -> None:
    async with FramePlant() as plant, shown(plant) as world:
        await world.seen()
        async with world.looking() as socket:
            await plant.driver.streams()
            plant.driver.give(frame(1))
            await next_picture(socket)
            await socket.send_str("next")
            await plant.stop_agent()
            while json.loads(await socket.receive_str()).get("state") != "lost":
                pass
            await plant.start_agent()
            await plant.driver.streams()
            plant.driver.give(frame(2))
            assert (await next_picture(socket))[0]["sequence"] == 2


async def test_camera_in_place_of_another_is_looked_at_anew() -> None:
    async with FramePlant() as plant, shown(plant) as world, plant.camera() as other:
        await world.seen()
        async with world.looking() as socket:
            await plant.driver.streams()
            await world.camera.close()
            await world.site.view.follow(other, "it was made again")
            while (message := await socket.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
            assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 1001)
        await world.seen()
        async with world.looking() as socket:
            await plant.driver.streams()
            plant.driver.give(frame(3))
            assert (await next_picture(socket))[0]["sequence"] == 3


async def test_page_that_ends_leaves_nobody_looking() -> None:
    async with FramePlant() as plant, shown(plant) as world:
        await world.seen()
        async with world.looking() as socket:
            await plant.driver.streams()
            await world.site.stop()
            while (message := await socket.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
            assert message.type in {aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED}
            await plant.driver.rests()
            await world.site.stop()
        await world.camera.trigger()  # it is the camera's no more than before


async def test_frames_want_the_token() -> None:
    async with FramePlant() as plant, shown(plant, token=TOKEN) as world:
        await world.seen()
        url = world.caller.url("/api/frames")
        async with aiohttp.ClientSession() as stranger:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
                await stranger.ws_connect(url, protocols=[PROTOCOL])
        assert "start" not in plant.driver.calls
