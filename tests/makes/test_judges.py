"""Test the emulated sensor with ifm's own client, ifm3dpy (PyPI): its schema, triggers and frames.

The client asks by XML-RPC for the type of a device before it uses PCIC; a fixture answers that one
request. The client has a process of its own, since it blocks Python while it waits.

The client has a race (``frame_grabber_impl.hpp`` of 1.6.16): its thread fulfils a promise first,
and replaces it afterwards. In between, ``wait_for_frame()`` returns the previous frame again. If
the answer arrives before ``sw_trigger()`` returns, that returns the future of the next trigger,
which nobody fulfils. Therefore the answer here waits until the client has its future, and the
client asks for the next frame only after the callback for the last one, which its thread calls
after it has replaced both promises.
"""

from __future__ import annotations

import asyncio
import itertools
import platform
import sys
import threading
from collections.abc import Iterator
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from smartcam.emulator import ManualClock
from smartcam.emulator.faults import Delay
from smartcam.makes import EmulatedIfm
from smartcam.protocols import messages as m
from tests.makes.inside import ImageChunk

CONFIDENCE = 300
"""Type of the chunk of a confidence image."""

LEVELS = bytes(range(8))
COUNT = 3
TIME = 0.01
"""Seconds of an evaluation, and of the delay of an answer to a trigger, by the sensor's clock."""

CLIENT = """
import queue
import sys
from ifm3dpy import buffer_id
from ifm3dpy.device import O3D
from ifm3dpy.framegrabber import FrameGrabber

grabber = FrameGrabber(O3D("127.0.0.1", int(sys.argv[1])), int(sys.argv[2]))
renewed = queue.Queue()
grabber.on_new_frame(lambda frame: renewed.put(frame.frame_count()))
assert grabber.start([buffer_id.CONFIDENCE_IMAGE]).wait_for(10_000)[0]
for _ in range(int(sys.argv[3])):
    frame, taken = grabber.wait_for_frame(), grabber.sw_trigger()
    print("triggered", flush=True)
    assert taken.wait_for(10_000)[0]
    came, found = frame.wait_for(10_000)
    assert came
    image = found.get_buffer(buffer_id.CONFIDENCE_IMAGE)
    print(image.shape[:2], image.tobytes().hex(), found.frame_count(), flush=True)
    assert renewed.get(timeout=10) == found.frame_count()
assert grabber.stop().wait_for(10_000)[0]
"""


class _Anywhere(SimpleXMLRPCRequestHandler):
    """Answer requests for every path, and log nothing."""

    def is_rpc_path_valid(self) -> bool:
        return True

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def parameters() -> Iterator[int]:
    """Serve the request for a device's type; yield the port."""
    server = SimpleXMLRPCServer(("127.0.0.1", 0), _Anywhere)
    server.register_function(lambda name: {"DeviceType": "1:2"}[name], "getParameter")
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.real_time
@pytest.mark.long
@pytest.mark.skipif(
    sys.version_info >= (3, 14) or (sys.platform, platform.machine()) != ("linux", "x86_64"),
    reason="no wheels of ifm3dpy for this system",
)
@pytest.mark.asyncio
async def test_ifms_own_client_gets_each_frame_that_it_triggers(parameters: int) -> None:
    pytest.importorskip("ifm3dpy")
    parts = [
        {"confidence_image": ImageChunk(CONFIDENCE, 4, 2, number, 1.5, LEVELS).encoded}
        for number in range(1, COUNT + 1)
    ]
    clock = ManualClock()
    async with EmulatedIfm(
        applications=[{"id": 1, "parts": parts, "processing_time": TIME}],
        clock=clock,
        faults=[Delay(on=m.TriggerAnswer, times=None, seconds=TIME)],
    ) as emulator:
        client = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", CLIENT, str(parameters), str(emulator.port), str(COUNT)),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        lines: list[str] = []
        try:
            async with asyncio.timeout(60):
                assert client.stdout is not None
                async for said in client.stdout:
                    lines.append(said.decode().strip())
                    if lines[-1] == "triggered":
                        asked = lines.count("triggered")
                        await emulator.wait_received(m.Trigger, count=asked, timeout=10)
                        clock.advance(TIME)
                await client.wait()
        finally:
            if client.returncode is None:
                client.kill()
                await client.wait()
    expected = [("triggered", f"(2, 4) {LEVELS.hex()} {number}") for number in range(1, COUNT + 1)]
    assert lines == [*itertools.chain.from_iterable(expected)]
    assert client.returncode == 0
    assert len(emulator.fired) == COUNT
