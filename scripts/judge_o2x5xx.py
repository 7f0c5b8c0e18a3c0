"""Run the PCIC tests of o2x5xx-python, which is on no registry, against the emulated ifm sensor.

Get it first, with what it imports (``pip install matplotlib Pillow``)::

    git clone https://github.com/ifm/o2x5xx-python
    python -m scripts.judge_o2x5xx o2x5xx-python

Its tests ask a device by XML-RPC for two parameters, which are told them here; what is judged is
PCIC. Two of its tests wait for an address that does not answer, and are left out.
"""

from __future__ import annotations

import asyncio
import importlib
import io
import sys
import threading
import unittest
from typing import TYPE_CHECKING, Any

from smartcam.makes import EmulatedIfm

if TYPE_CHECKING:
    from typing import Self

    from smartcam.emulator import TicketedCamera

PARAMETERS = {"PinLayout": "0", "PcicProtocolVersion": "3"}
LEFT_OUT = "wrong_ip"


class Parameters:
    """Parameters of a device, in place of its XML-RPC."""

    def __init__(self, *_: object) -> None:
        """Take an address."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def getParameter(self, value: str) -> str:  # noqa: N802 - its name
        """Return a parameter."""
        return PARAMETERS[value]


def device() -> TicketedCamera:
    """Return a sensor with the applications that the tests expect."""
    image = importlib.import_module("PIL.Image")
    file = io.BytesIO()
    image.effect_noise((128, 96), 40).save(file, "JPEG")
    own: dict[int, dict[str, Any]] = {
        4: {"images": 5},
        6: {"trigger": "continuous", "processing_time": 0.1},
    }
    given = [{"id": one, **own.get(one, {})} for one in range(1, 7)]
    return EmulatedIfm(applications=given, defaults={"jpeg": file.getvalue()})


async def serve(camera: TicketedCamera, ready: threading.Event, end: threading.Event) -> None:
    """Have the sensor answer until the tests are over."""
    async with camera:
        ready.set()
        while not end.is_set():  # noqa: ASYNC110 - it is set in another thread
            await asyncio.sleep(0.05)


def main(folder: str) -> int:
    """Run the tests that stand in a folder; return how many failed."""
    sys.path.insert(0, folder)
    camera, ready, end = device(), threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: asyncio.run(serve(camera, ready, end)))
    thread.start()
    try:
        ready.wait(10)
        config = importlib.import_module("tests.config")
        config.deviceAddress, config.pcicTcpPort = "127.0.0.1", camera.port  # type: ignore[attr-defined]
        config.importDeviceConfigUnittests = False  # type: ignore[attr-defined]
        tests = importlib.import_module("tests.test_pcic")
        tests.O2x5xxRPCDevice = Parameters  # type: ignore[attr-defined]
        found: Any = unittest.defaultTestLoader.loadTestsFromModule(tests)
        each = (one for group in found for one in group)
        suite = unittest.TestSuite(one for one in each if LEFT_OUT not in one.id())
        result = unittest.TextTestRunner(verbosity=2).run(suite)
        return len(result.failures) + len(result.errors)
    finally:
        end.set()
        thread.join()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
