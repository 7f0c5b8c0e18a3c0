"""Pictures from ``read_image()`` as frames."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from smartcam.frames import Frame, Moment, find_format
from smartcam.frames._inside import read_bitmap

if TYPE_CHECKING:
    from smartcam.models import Result


def frame_of_image(camera: str, image: bytes, result: Result[Any] | None) -> Frame:
    """Return the frame of a bitmap that was captured between its result's trigger and now.

    Raises:
        FrameFormatError: the file is no bitmap.
    """
    pixels = read_bitmap(image)
    height, width = pixels.shape[:2]
    now, utc = time.monotonic(), time.time()
    triggered = None if result is None else result.triggered_at
    return Frame(
        data=pixels.data.toreadonly().cast("B"),
        format=find_format("Mono8" if pixels.ndim == 2 else "RGB8"),
        width=width,
        height=height,
        stride=pixels.nbytes // height,
        captured=now,
        utc=utc,
        moment=Moment.ARRIVAL,
        duration=math.inf if triggered is None else max(0.0, utc - triggered.timestamp()),
        sequence=0 if result is None else result.number,
        source=camera,
    )
