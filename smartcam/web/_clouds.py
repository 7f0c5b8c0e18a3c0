"""Show the newest cloud of points to the viewers of a site.

Each viewer has a WebSocket, which transfers one cloud at a time: when the page reports that it has
shown the last cloud, the newest one is sent. The bytes of a cloud are sent in parts, so that the
event loop can do other work between them. The page gets fewer points of a large cloud, and says so.
"""

from __future__ import annotations

import asyncio
import json
import logging
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from smartcam.depth import Cloud, voxel_grid
from smartcam.exceptions import ConfigurationError
from smartcam.web._routes import CallRequest, Calls
from smartcam.web._site import API
from smartcam.web._sockets import PageSocket, check_websocket
from smartcam.web._threaded_site import ThreadedSite

if TYPE_CHECKING:
    from aiohttp import web

_log = logging.getLogger("smartcam.web")

MAX_CLOUD_POINTS: Final = 1_000_000
"""Largest number of points of a cloud that are sent to a page; a larger cloud is thinned."""

MAX_VIEWERS: Final = 8
"""Largest number of pages open at a time. A cloud of 15 MB may be in transfer to each."""

PROTOCOL: Final = "smartcam.cloud"
"""Subprotocol of the WebSockets that send clouds."""

PART_BYTES: Final = 1 << 16
"""Bytes of a message that are written at a time."""

SHOW_TIMEOUT: Final = 60.0
"""Seconds within which a page must have received and shown a cloud."""

UpAxis: TypeAlias = Literal["x", "y", "z", "-x", "-y", "-z"]


class _PackedCloud(NamedTuple):
    """A cloud in the form in which it is sent."""

    fields: dict[str, Any]
    body: (
        bytes  # float32 x, y, z of all points, then uint8 red, green, blue of all if it has colours
    )


class CloudSite(ThreadedSite):
    """A page that shows a cloud that the viewer can turn, and HTTP calls.

    ::

        async with CloudSite(cloud) as site:
            site.url            # http://127.0.0.1:PORT/
            site.show(newer)    # from now on

    Args:
        cloud: the cloud shown first; None: the page waits for one.
        up: the axis that points up when the page is opened; ``-y`` is up for a camera that stands
            level.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry, as for :class:`~smartcam.web.FramesSite`.

    Raises:
        ConfigurationError: the token cannot be used, ``cloud`` is no cloud, or ``up`` no axis.
    """

    def __init__(
        self,
        cloud: Cloud | None = None,
        *,
        up: UpAxis = "z",
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "cloud", host=host, port=port, token=token)
        if up not in get_args(UpAxis):
            raise ConfigurationError(
                f"up: expected one of {', '.join(get_args(UpAxis))}, got {up!r}"
            )
        self.viewers: set[CloudViewer] = set()
        self._up = up
        self._cloud: Cloud = Cloud(np.empty((0, 3)))
        self._number = 0  # number of the cloud; 0: none yet
        self._new_cloud = asyncio.Event()
        self._packing_job: tuple[int, asyncio.Future[_PackedCloud]] | None = None
        if cloud is not None:
            self.show(cloud)

    def show(self, cloud: Cloud) -> None:
        """Show a cloud instead of the last one; call it in the event loop's thread.

        A viewer gets the cloud as soon as its page has shown the last one. A cloud that is replaced
        before that is skipped. Clouds are thinned and packed in a thread.

        Raises:
            ConfigurationError: the value is no cloud.
        """
        if not isinstance(cloud, Cloud):
            raise ConfigurationError(f"show: expected a Cloud, got {type(cloud).__name__}")
        self._cloud = cloud
        self._number += 1
        self._new_cloud.set()
        self._new_cloud = asyncio.Event()

    async def stop(self) -> None:
        """Close the port, and end the viewers."""
        for viewer in self.viewers:
            viewer.end()
        try:
            await super().stop()
        finally:
            self._packing_job = None

    async def newer(self, number: int) -> tuple[int, _PackedCloud]:
        """Wait for a cloud with a higher number; return the number and the packed cloud.

        Cancellation: safe; other callers that wait for the cloud still get it.
        """
        while self._number <= number:
            await self._new_cloud.wait()
        if self._packing_job is None or self._packing_job[0] != self._number:
            loop = asyncio.get_running_loop()
            future = loop.run_in_executor(self._threads, pack_cloud, self._cloud)
            future.add_done_callback(_mark_retrieved)
            self._packing_job = (self._number, future)
        packed_number, future = self._packing_job
        return packed_number, await asyncio.shield(future)

    def state(self) -> dict[str, Any]:
        """Return the state of the cloud and the number of viewers, as values for JSON."""
        return {
            "number": self._number,
            "points": len(self._cloud),
            "colours": self._cloud.colours is not None,
            "up": self._up,
            "viewers": len(self.viewers),
        }


def _mark_retrieved(future: asyncio.Future[_PackedCloud]) -> None:
    if not future.cancelled():
        future.exception()  # asyncio would log an error that no caller retrieves


def pack_cloud(cloud: Cloud) -> _PackedCloud:
    """Return a cloud in the form in which it is sent, thinned if it is large; call it in a thread.

    If packing fails, the returned message has the reason for the page, and no points.
    """
    try:
        return _pack_points(cloud)
    except (MemoryError, ConfigurationError) as exc:
        return _PackedCloud({"failure": str(exc) or type(exc).__name__, "bytes": 0}, b"")


def _pack_points(cloud: Cloud) -> _PackedCloud:
    thin, size = thin_cloud(cloud, MAX_CLOUD_POINTS)
    columns = [thin.points.astype("<f4", copy=False).tobytes()]
    if thin.colours is not None:
        columns.append(thin.colours.tobytes())
    body = b"".join(columns)
    low, high = (
        (thin.points.min(axis=0).tolist(), thin.points.max(axis=0).tolist())
        if len(thin)
        else ([0.0] * 3, [0.0] * 3)
    )
    fields = {
        "points": len(thin),
        "of": len(cloud),
        "voxel": size,
        "colours": thin.colours is not None,
        "low": low,
        "high": high,
        "bytes": len(body),
    }
    return _PackedCloud(fields, body)


def thin_cloud(cloud: Cloud, max_points: int) -> tuple[Cloud, float | None]:
    """Return a cloud of ``max_points`` at most, and the voxels' size in metres if thinned."""
    if len(cloud) <= max_points:
        return cloud, None
    extent = float(np.ptp(cloud.points.astype(np.float64), axis=0).max())
    # a voxel must not be smaller than float32's resolution at the farthest point
    size = max(extent / 1024, 1e-6 * float(np.abs(cloud.points).max()), 1e-9)
    while len(thin := voxel_grid(cloud, size)) > max_points:
        size *= max(1.05, (len(thin) / max_points) ** 0.5)  # a surface has about 1 / size**2 voxels
    return thin, size


class CloudViewer(PageSocket):
    """The WebSocket that sends clouds to a page."""

    def __init__(self, site: CloudSite, request: web.Request) -> None:
        # the heartbeat ends the connection of a page that vanished
        super().__init__(request, PROTOCOL, "cloud", heartbeat=SHOW_TIMEOUT)
        self._site = site

    async def serve(self) -> web.WebSocketResponse:
        """Send clouds until the page is closed."""
        self._site.viewers.add(self)
        try:
            return await super().serve()
        finally:
            self._site.viewers.discard(self)

    async def _send_messages(self) -> None:
        """Send each new cloud when the page has shown the last one.

        Raises:
            TimeoutError: the page did not show a cloud within :data:`SHOW_TIMEOUT`.
        """
        number = 0
        while True:
            number, cloud = await self._site.newer(number)
            self._was_shown.clear()
            async with asyncio.timeout(SHOW_TIMEOUT):
                await self._socket.send_str(json.dumps({"number": number, **cloud.fields}))
                for start in range(0, len(cloud.body), PART_BYTES):
                    await self._socket.send_bytes(cloud.body[start : start + PART_BYTES])
                    await asyncio.sleep(0)
                await self._was_shown.wait()


# ---------------------------------------------------------------------- calls

CALLS: Calls[CloudSite] = Calls()
"""All calls."""


@CALLS.add("GET", API)
def _calls(_site: CloudSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/cloud")
def _cloud(site: CloudSite, _call: CallRequest) -> object:
    """Return the newest cloud's number and points, and which axis is up."""
    return site.state()


@CALLS.add(
    "GET",
    f"{API}/clouds",
    about="A WebSocket: after each message `next`, the newest cloud. JSON with the number of "
    "bytes; then the bytes in parts: x, y, z as float32, red, green, blue as uint8.",
)
async def _clouds(site: CloudSite, call: CallRequest) -> web.StreamResponse:
    check_websocket(call.request, PROTOCOL, len(site.viewers), MAX_VIEWERS)
    return await CloudViewer(site, call.request).serve()
