"""Fetch a picture from each camera of a fleet whose last result failed, also without viewers."""

from __future__ import annotations

import asyncio
import collections
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import SmartCamError

if TYPE_CHECKING:
    from smartcam.web._fleet_rows import FleetRow
    from smartcam.web._fleet_view import FleetView

CHECK_PERIOD: Final = 0.2
"""Seconds between two checks of the failing rows."""

CAMERA_PERIOD: Final = 10.0
"""Least number of seconds between two pictures of one camera."""

NEWER_RESULT_DELAY: Final = 0.2
"""Seconds to wait after fetching a picture: a newer result that arrives meanwhile may belong to the
picture."""

MAX_BYTES: Final = 1 << 28
"""Largest number of bytes that the pictures of all cameras may have together."""

MAX_PICTURES: Final = 10_000
"""Largest number of pictures of all cameras that are kept."""


class FailurePictures:
    """Asks failing cameras for their pictures, one after the other.

    A picture is kept only if no newer result has arrived with it: otherwise it might show another
    part.

    Args:
        view: view of the fleet, which has the failing rows.
    """

    def __init__(self, view: FleetView) -> None:
        self._view = view
        self._attached: collections.deque[tuple[FleetRow, int, int]] = collections.deque()
        self._bytes = 0

    async def run(self) -> None:
        """Fetch pictures until the task is cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(CHECK_PERIOD)
            for row in list(self._view.failing):
                if loop.time() - row.picture_at < CAMERA_PERIOD:
                    continue
                self._view.failing.pop(row, None)
                if row.failure_serial and row.history.wants_picture:
                    row.picture_at = loop.time()
                    await self._fetch(row, row.failure_serial)

    async def _fetch(self, row: FleetRow, serial: int) -> None:
        camera = row.camera
        try:
            if camera is None or not camera.connected or not camera.capabilities.read_image:
                return
            data = await camera.read_image()
        except SmartCamError:
            return  # not reported here: the live page shows the camera's error
        await asyncio.sleep(NEWER_RESULT_DELAY)
        if row.failure_serial != serial:
            return
        row.history.attach_picture(serial, data)
        self._attached.append((row, serial, len(data)))
        self._bytes += len(data)
        while self._bytes > MAX_BYTES or len(self._attached) > MAX_PICTURES:
            oldest_row, oldest_serial, size = self._attached.popleft()
            oldest_row.history.drop_picture(oldest_serial)
            self._bytes -= size
