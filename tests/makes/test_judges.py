"""ifm's own client ifm3dpy (PyPI) against the emulated sensor: its schema, triggers and frames.

It asks by XML-RPC what a device is before it speaks PCIC; that one question is answered here. It
runs in a process of its own, since it waits without letting Python go on.
"""

from __future__ import annotations

import asyncio
import platform
import sys
import threading
from collections.abc import Iterator
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from smartcam.makes import EmulatedIfm, ImageChunk

CONFIDENCE = 300
"""Type of the chunk of a confidence image."""

LEVELS = bytes(range(8))
COUNT = 3

CLIENT = """
import sys
from ifm3dpy import buffer_id
from ifm3dpy.device import O3D
from ifm3dpy.framegrabber import FrameGrabber

grabber = FrameGrabber(O3D("127.0.0.1", int(sys.argv[1])), int(sys.argv[2]))
assert grabber.start([buffer_id.CONFIDENCE_IMAGE]).wait_for(10_000)[0]
for _ in range(int(sys.argv[3])):
    frame = grabber.wait_for_frame()
    assert grabber.sw_trigger().wait_for(10_000)[0]
    came, found = frame.wait_for(10_000)
    assert came
    image = found.get_buffer(buffer_id.CONFIDENCE_IMAGE)
    print(image.shape[:2], image.tobytes().hex(), found.frame_count())
assert grabber.stop().wait_for(10_000)
"""


class _Anywhere(SimpleXMLRPCRequestHandler):
    """Answers at every address, and logs nothing."""

    def is_rpc_path_valid(self) -> bool:
        return True

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def parameters() -> Iterator[int]:
    """Answer the question for a device's type; give the port."""
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
    async with EmulatedIfm(applications=[{"id": 1, "parts": parts}]) as emulator:
        client = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", CLIENT, str(parameters), str(emulator.port), str(COUNT)),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            async with asyncio.timeout(60):
                said, _ = await client.communicate()
        finally:
            if client.returncode is None:
                client.kill()
                await client.wait()
    lines = said.decode().splitlines()
    assert lines == [f"(2, 4) {LEVELS.hex()} {number}" for number in range(1, COUNT + 1)]
    assert client.returncode == 0
