"""How an agent encodes frames: the one place that knows the codecs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.exceptions import UnsupportedError

if TYPE_CHECKING:
    from smartcam.fleet._frame_wire import Encoding
    from smartcam.frames import Frame


async def encoded(frame: Frame, encoding: Encoding) -> Frame:
    """Return a frame encoded; one that its camera has encoded so already is left as it is.

    Raises:
        UnsupportedError: there is no codec.
    """
    raise UnsupportedError(f"{frame.source}: no codec for {encoding.name} yet")
