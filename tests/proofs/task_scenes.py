"""Scenes of the task sweep: a short life of each public object that has tasks."""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Literal

import aiohttp
import numpy as np

import smartcam
from smartcam import Backoff, frames
from smartcam.calibration import CameraModel, Transform
from smartcam.calibration.formats import CameraChain
from smartcam.depth import StereoDepth
from smartcam.emulator import EmulatedCamera, ManualClock, faults
from smartcam.exceptions import SmartCamError
from smartcam.fleet import Fleet
from smartcam.frames import FrameSource
from smartcam.recording import FleetRecorder
from smartcam.ros1 import RosbridgeNode
from smartcam.ros2 import CameraNode, CameraNodeOptions
from smartcam.web import EmulatorSite, OperationsSite
from tests.fleet import kinds as fleet_kinds
from tests.fleet.fleetkit import FLEET, NAME
from tests.fleet.framekit import FramePlant
from tests.frames.drivers import ScriptedDriver
from tests.frames.gige.camera import camera as gige_camera
from tests.frames.rtsp.client import Client as RtspClient
from tests.processes import free_port
from tests.recording import folderkit
from tests.ros1.bridge import Bridge
from tests.ros2 import nodekit

Scene = Callable[[Any], Awaitable[None]]

SOON = Backoff(initial=0.01, maximum=0.05, jitter=0)
APPLICATIONS = [
    {"id": number, "layout": "n: int32", "generator": "sequence", "processing_time": 0.001}
    for number in (1, 2)
]


def client(dialect: str, transport: Literal["tcp", "udp"]) -> Scene:
    """Return a client's life: commands, a temporary application, a stream, a loss."""

    async def scene(program: Any) -> None:
        box = EmulatedCamera(
            APPLICATIONS, dialect=dialect, transport=transport, builtins=False, running=True
        )
        async with program.entered(box) as made:
            if made is None:
                return
            camera = smartcam.connect(box.url, application=1, restore=True, reconnect=SOON)
            opening = asyncio.ensure_future(program.call(camera.open()))
            results = camera.results()
            await opening
            await program.call(camera.trigger())
            await program.call(camera.trigger(2))
            await program.call(camera.get_clock())
            never = camera.wait_status(lambda _: False, timeout=0.5)
            waiting = asyncio.ensure_future(program.call(never, fails=True))
            if transport == "tcp":
                box.inject(faults.Reset())  # with the next message
                await program.call(camera.trigger(2), fails=True)
                await program.call(camera.wait_connected(5))
            await waiting
            await program.call(camera.trigger())
            await program.call(camera.close())
            await _read_to_the_end(program, results)

    return scene


async def fleet_camera(program: Any) -> None:
    """A camera of a fleet over the bus inside the process, and its agent."""
    async with EmulatedCamera(APPLICATIONS, builtins=False, running=True) as box:
        camera = fleet_kinds.connect("in_process", box.url, application=1, reconnect=SOON)
        results, events = camera.results(), camera.events()
        await program.call(camera.open())
        await program.call(camera.trigger())
        await program.call(camera.trigger(2))
        await program.call(camera.get_clock())
        box.inject(faults.Reset())
        await program.call(camera.trigger(), fails=True)
        await program.call(camera.wait_connected(5))
        await program.call(camera.trigger())
        await program.call(camera.close())
        await _read_to_the_end(program, results)
        await _read_to_the_end(program, events)


async def fleet(program: Any) -> None:
    """A program of a whole fleet, its agent, and frames."""
    async with FramePlant(zenoh=False) as plant:
        whole = Fleet(plant.bus.new_connection(), None, FLEET, None, 5.0, {"reconnect": SOON})
        results = whole.results()
        async with program.entered(whole) as made, plant.streaming():
            if made is not None:
                camera = whole[NAME]
                await program.call(camera.wait_connected(5))
                await program.call(camera.trigger(1))
                await program.call(whole.trigger("**"))
                async with program.entered(camera.frames()) as reader:
                    if reader is not None:
                        await program.call(anext(reader))
                        await program.call(reader.newest())
        await _read_to_the_end(program, results)


async def frame_source(program: Any) -> None:
    """A source of frames, read by two, that lingers."""
    source = frames.open("synthetic://?size=256x16&fps=50", linger=0.1)
    async with program.entered(source) as made:
        if made is None:
            return
        async with source.reader() as one, source.reader() as other:
            await program.call(anext(one))
            await program.call(other.newest())
            await program.call(anext(one))
        await asyncio.sleep(0.5)
        async with source.reader() as again:
            await program.call(anext(again))


async def source_closed_at_once(program: Any) -> None:
    """A source that is closed in the same turn in which it was opened gives its device back."""
    driver = ScriptedDriver()
    async with program.entered(FrameSource(driver)):
        pass
    assert driver.calls[-1] == "close", driver.calls


async def group(program: Any) -> None:
    """Two sources read together."""
    one, other = (frames.open("synthetic://?size=256x16&fps=50") for _ in range(2))
    async with program.entered(frames.FrameGroup({"a": one, "b": other}, within=1.0)) as made:
        if made is not None:
            await program.call(anext(made))
            await program.call(anext(made))


async def rtp(program: Any) -> None:
    """A sender and a receiver."""
    port = free_port()
    drawn = frames.open("synthetic://?size=256x64&fps=50")
    async with program.entered(drawn) as source:
        if source is None:
            return
        async with program.entered(frames.RtpSender(source, f"127.0.0.1:{port}", keyint=5)):
            received = frames.open(f"rtp://127.0.0.1:{port}", timeout=2.0)
            async with program.entered(received) as made:
                if made is not None:
                    async with made.reader() as reader:
                        await program.call(anext(reader))
                        await program.call(anext(reader))


async def rtsp(program: Any) -> None:
    """A server, and who describes and plays a stream of it."""
    drawn = frames.open("synthetic://?size=256x64&fps=50")
    async with program.entered(drawn) as source:
        if source is None:
            return
        server = frames.RtspServer({"left": source}, port=0)
        async with program.entered(server) as made:
            if made is not None:
                async with asyncio.timeout(50), await RtspClient.connect(server) as viewer:
                    await program.call(viewer.ask("OPTIONS"), fails=True)
                    await program.call(viewer.ask("DESCRIBE"), fails=True)


async def rtsp_played(program: Any) -> None:
    """Play a stream of a server over its own connection."""
    drawn = frames.open("synthetic://?size=256x64&fps=50")
    async with program.entered(drawn) as source:
        if source is None:
            return
        async with program.entered(frames.RtspServer({"left": source}, port=0)) as made:
            if made is not None:
                async with asyncio.timeout(50), await RtspClient.connect(made) as viewer:
                    await program.call(viewer.play(), fails=True)
                    await program.call(viewer.packet(), fails=True)
                    await program.call(viewer.ask("TEARDOWN"), fails=True)


async def gige(program: Any) -> None:
    """A GigE Vision camera whose frames are read."""
    async with gige_camera() as there:
        opened = frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576", timeout=2.0)
        async with program.entered(opened) as source:
            if source is None:
                return
            async with source.reader() as reader:
                await program.call(anext(reader), fails=True)
                await program.call(anext(reader), fails=True)


async def depth(program: Any) -> None:
    """Two readers of frames as a camera that sees depth."""
    focal = np.array([[210.0, 0, 120], [0, 210, 80], [0, 0, 1]])
    lens = CameraModel(size=(256, 160), matrix=focal, distortion=np.zeros(5))
    apart = Transform("right", "left", np.eye(3), np.array([-0.12, 0, 0]))
    chain = CameraChain(cameras=(lens, lens), transforms=(apart,), names=("left", "right"))
    one, other = (frames.open("synthetic://?size=256x160&fps=50") for _ in range(2))
    async with program.entered(one) as left, program.entered(other) as right:
        if left is None or right is None:
            return
        pair = StereoDepth(left.reader(), right.reader(), chain, within=1.0)
        async with program.entered(pair) as made:
            if made is not None:
                await program.call(anext(made), fails=True)


async def rosbridge(program: Any) -> None:
    """A node behind a rosbridge: topics, a service, a lost link."""
    async with Bridge() as bridge:
        made_node = RosbridgeNode("cam3", bridge=bridge.url, backoff=SOON)
        async with program.entered(made_node) as node:
            if node is None:
                return
            await program.call(node.wait_connected(20), fails=True)
            with contextlib.suppress(SmartCamError):
                publisher = node.publisher("~/status", "std_msgs/msg/String")
                publisher.publish(data="one")
                node.serve("~/ask", "std_srvs/srv/Trigger", _yes)
            for link in list(bridge.links):
                await link.close()
            await program.call(node.wait_connected(20), fails=True)


async def _yes(_request: Any) -> Any:
    return {"success": True, "message": "yes"}


async def agent(program: Any) -> None:
    """An agent that is recorded and asked how it is, and its reload."""
    with tempfile.TemporaryDirectory() as folder:
        async with EmulatedCamera(APPLICATIONS, builtins=False, running=True) as box:
            made_agent = folderkit.server(Path(folder), box.url)
            recorder = FleetRecorder(made_agent, folderkit.section())
            site = OperationsSite(made_agent, listen="127.0.0.1:0")
            async with (
                program.entered(recorder),
                program.entered(site) as asked,
                program.entered(made_agent) as made,
            ):
                if made is None or asked is None:
                    return
                await program.call(made.wait_first_attempts(), fails=True)
                async with asyncio.timeout(50), aiohttp.ClientSession() as session:
                    for path in ("/healthz", "/metrics"):
                        url = f"http://127.0.0.1:{asked.port}{path}"
                        await program.call(_answer(session, url), fails=True)


async def web(program: Any) -> None:
    """The page of an emulated camera, and who looks at it."""
    async with EmulatedCamera(clock=ManualClock()) as box:
        site = EmulatorSite({"camera": box})
        async with program.entered(site) as made, aiohttp.ClientSession() as session:
            if made is not None:
                async with asyncio.timeout(50):
                    await program.call(_answer(session, f"{site.origin}/api/cameras"))
                    await program.call(_answer(session, site.origin + "/"))


async def _answer(session: aiohttp.ClientSession, url: str) -> bytes:
    async with session.get(url) as response:
        return await response.read()


async def ros2(program: Any) -> None:
    """A camera as a node of ROS 2, without a wire."""
    async with nodekit.box() as box:
        camera = smartcam.connect(
            box.url, name=nodekit.NAME, reconnect=SOON, interpret_as="n: int32"
        )
        async with program.entered(camera) as made:
            if made is None:
                return
            node = nodekit.NotedNode()
            async with program.entered(
                CameraNode(camera, node, options=CameraNodeOptions())
            ) as seen:
                if seen is not None:
                    await program.call(camera.trigger(nodekit.COUNTER))
                    box.inject(faults.Reset())
                    await program.call(camera.trigger(), fails=True)
                    await program.call(camera.wait_connected(5))
                    await asyncio.sleep(3)


async def find(program: Any) -> None:
    """A search for cameras."""
    async with EmulatedCamera() as box:
        found = smartcam.find("127.0.0.1/32", ports=[box.port], may_disturb=True)
        await program.call(found)


async def _read_to_the_end(program: Any, stream: Any) -> None:
    """Read a stream that was closed."""
    ends = False
    while not ends:
        ends = await program.call(anext(stream, None), fails=True) is None


SCENES: dict[str, Scene] = {
    "client": client("handbook", "tcp"),
    "client over udp": client("handbook", "udp"),
    "client of bid": client("bid", "tcp"),
    "fleet camera": fleet_camera,
    "fleet": fleet,
    "frame source": frame_source,
    "source closed at once": source_closed_at_once,
    "group": group,
    "rtp": rtp,
    "rtsp": rtsp,
    "rtsp played": rtsp_played,
    "gige": gige,
    "depth": depth,
    "rosbridge": rosbridge,
    "agent": agent,
    "web": web,
    "ros2": ros2,
    "find": find,
}
