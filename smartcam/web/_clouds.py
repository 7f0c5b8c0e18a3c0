"""The site that shows the newest cloud to its viewers.

Each viewer has a WebSocket, with one cloud on the way at a time: when the page reports that it has
shown the last cloud, the newest one is sent. A cloud is sent as it lies in memory, in parts, so
that the event loop runs meanwhile. A large cloud is thinned for the page, with a note.
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
"""Largest number of points of a cloud that are sent to a page; a cloud of more is thinned."""

MAX_VIEWERS: Final = 8
"""Largest number of pages open at a time; each may have a cloud of 15 MB on the way."""

PROTOCOL: Final = "smartcam.cloud"
"""Subprotocol of the WebSockets that send clouds."""

PART_BYTES: Final = 1 << 16
"""Bytes of a message that are written at a time."""

SHOW_TIMEOUT: Final = 60.0
"""Seconds within which a page must have received and shown a cloud."""

Up: TypeAlias = Literal["x", "y", "z", "-x", "-y", "-z"]


class _Packed(NamedTuple):
    """A cloud in the form in which it is sent."""

    about: dict[str, Any]
    body: bytes  # float32 x, y, z of all points, then uint8 red, green, blue of all, if there are


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
        up: Up = "z",
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "cloud", host=host, port=port, token=token)
        if up not in get_args(Up):
            raise ConfigurationError(f"up: expected one of {', '.join(get_args(Up))}, got {up!r}")
        self.viewers: set[CloudViewer] = set()
        self._up = up
        self._cloud: Cloud = Cloud(np.empty((0, 3)))
        self._number = 0  # number of the cloud; 0: none yet
        self._newer = asyncio.Event()
        self._packing: tuple[int, asyncio.Future[_Packed]] | None = None
        if cloud is not None:
            self.show(cloud)

    def show(self, cloud: Cloud) -> None:
        """Show a cloud in place of the last one, from the event loop's thread.

        A viewer gets it as soon as it has shown the last one; a cloud that is replaced before that
        is skipped. It is thinned and packed in a thread.

        Raises:
            ConfigurationError: the value is no cloud.
        """
        if not isinstance(cloud, Cloud):
            raise ConfigurationError(f"show: expected a Cloud, got {type(cloud).__name__}")
        self._cloud = cloud
        self._number += 1
        self._newer.set()
        self._newer = asyncio.Event()

    async def stop(self) -> None:
        """Close the port, and end the viewers."""
        for viewer in self.viewers:
            viewer.end()
        try:
            await super().stop()
        finally:
            self._packing = None

    async def newer(self, number: int) -> tuple[int, _Packed]:
        """Return the newest cloud after a number, packed once for all viewers, and its number.

        Cancellation: safe; other callers that wait for the cloud get it.
        """
        while self._number <= number:
            await self._newer.wait()
        if self._packing is None or self._packing[0] != self._number:
            loop = asyncio.get_running_loop()
            made = loop.run_in_executor(self._threads, packed, self._cloud)
            made.add_done_callback(_mark_handled)
            self._packing = (self._number, made)
        packed_number, job = self._packing
        return packed_number, await asyncio.shield(job)

    def state(self) -> dict[str, Any]:
        """Return the state of the cloud and the number of viewers, as values for JSON."""
        return {
            "number": self._number,
            "points": len(self._cloud),
            "colours": self._cloud.colours is not None,
            "up": self._up,
            "viewers": len(self.viewers),
        }


def _mark_handled(made: asyncio.Future[_Packed]) -> None:
    if not made.cancelled():
        made.exception()  # the callers may be gone


def packed(cloud: Cloud) -> _Packed:
    """Return a cloud in its form for sending, thinned if it is large; call it in a thread.

    If that fails, the reason is sent instead.
    """
    try:
        return _packed(cloud)
    except (MemoryError, ConfigurationError) as exc:
        return _Packed({"failure": str(exc) or type(exc).__name__, "bytes": 0}, b"")


def _packed(cloud: Cloud) -> _Packed:
    thin, size = thinned(cloud, MAX_CLOUD_POINTS)
    columns = [thin.points.astype("<f4", copy=False).tobytes()]
    if thin.colours is not None:
        columns.append(thin.colours.tobytes())
    body = b"".join(columns)
    low, high = (
        (thin.points.min(axis=0).tolist(), thin.points.max(axis=0).tolist())
        if len(thin)
        else ([0.0] * 3, [0.0] * 3)
    )
    about = {
        "points": len(thin),
        "of": len(cloud),
        "voxel": size,
        "colours": thin.colours is not None,
        "low": low,
        "high": high,
        "bytes": len(body),
    }
    return _Packed(about, body)


def thinned(cloud: Cloud, most: int) -> tuple[Cloud, float | None]:
    """Return a cloud of at most ``most`` points, and the voxels' size in metres if thinned."""
    if len(cloud) <= most:
        return cloud, None
    reach = float(np.ptp(cloud.points.astype(np.float64), axis=0).max())
    # not below the precision of float32 at this distance from the origin
    size = max(reach / 1024, 1e-6 * float(np.abs(cloud.points).max()), 1e-9)
    while len(thin := voxel_grid(cloud, size)) > most:
        size *= max(1.05, (len(thin) / most) ** 0.5)  # a surface has about 1 / size**2 voxels
    return thin, size


class CloudViewer(PageSocket):
    """The WebSocket of a page that shows the cloud."""

    def __init__(self, site: CloudSite, request: web.Request) -> None:
        # the heartbeat frees the place of a page that vanished
        super().__init__(request, PROTOCOL, "cloud", heartbeat=SHOW_TIMEOUT)
        self._site = site

    async def serve(self) -> web.WebSocketResponse:
        """Show clouds until the page goes."""
        self._site.viewers.add(self)
        try:
            return await super().serve()
        finally:
            self._site.viewers.discard(self)

    async def _show(self) -> None:
        """Send the newest cloud, and wait until the page shows it; TimeoutError: too late."""
        number = 0
        while True:
            number, cloud = await self._site.newer(number)
            self._shown.clear()
            async with asyncio.timeout(SHOW_TIMEOUT):
                await self._socket.send_str(json.dumps({"number": number, **cloud.about}))
                for start in range(0, len(cloud.body), PART_BYTES):
                    await self._socket.send_bytes(cloud.body[start : start + PART_BYTES])
                    await asyncio.sleep(0)
                await self._shown.wait()


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
    about="A WebSocket: the newest cloud after each `next`. JSON with the number of "
    "bytes; then these in parts: x, y, z as float32, red, green, blue as uint8.",
)
async def _clouds(site: CloudSite, call: CallRequest) -> web.StreamResponse:
    check_websocket(call.request, PROTOCOL, len(site.viewers), MAX_VIEWERS)
    return await CloudViewer(site, call.request).serve()
