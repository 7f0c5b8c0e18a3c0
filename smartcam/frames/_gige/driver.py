"""GigE Vision cameras as a source of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.frames._driver import FoundSource, FrameDriver
from smartcam.frames._gige._aravis import AravisDriver
from smartcam.frames._gige._discovery import find, networks
from smartcam.frames._gige._own import OwnDriver
from smartcam.frames._gige._places import found, wanted

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._driver import FrameSink, StreamFormat


class GigEDriver(FrameDriver):
    """A camera that speaks GigE Vision: ``gige://192.168.0.10?format=Mono8&fps=25``.

    The camera is ours from opening to closing; a heartbeat keeps it so, a register that is read
    three times in the camera's own timeout, also while nobody reads frames.

    A frame's ``captured`` is when its first packet was read, and ``moment`` says so: ``ARRIVAL``.
    Its ``duration`` is the exposure time and one frame time for the readout, as far as the camera
    tells them. ``device_time`` is the camera's own clock.

    The URL's parameters are carried out in their order:

    - ``format``: one of the camera's, by its name there, in PFNC or in V4L2.
    - ``size``: ``WIDTHxHEIGHT``.
    - ``fps``: frames a second, by ``AcquisitionFrameRate``.
    - ``feature.NAME``: the value of any feature, as GenICam names both.

    and, at any place:

    - ``serial``: the camera's serial number, instead of an address: it is looked for. Without
      either it is the only camera there is.
    - ``packet_size``: bytes of the stream's IP packets, 576 to 16384; ``auto``, as it is: the
      largest that comes through in a test, or the camera's own where it sends no test packets.
    - ``resend=off``: packets that are missing are not asked for.
    - ``through=aravis``: by the library aravis, where it is installed, instead of what smartcam
      has itself.
    """

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        what = wanted(address)
        kind = AravisDriver if what.said.get("through") == "aravis" else OwnDriver
        self.inside: OwnDriver | AravisDriver = kind(address, what)
        """What does the work."""

    @classmethod
    async def discover(cls) -> list[FoundSource]:
        """Return the cameras that answer on this machine's networks, within half a second."""
        return [found(one) for one in await find(networks())]

    @property
    def name(self) -> str:
        """What somebody called the camera, or its model and serial number; closed: the URL."""
        return self.inside.name

    async def open(self) -> StreamFormat:
        """Take control of the camera and set it."""
        return await self.inside.open()

    async def start(self, sink: FrameSink) -> None:
        """Have it stream."""
        await self.inside.start(sink)

    async def stop(self) -> None:
        """Have it stream no longer."""
        await self.inside.stop()

    async def close(self) -> None:
        """Give it back."""
        await self.inside.close()
