"""Define the site of a fleet: a table of all its cameras, and a live page for each."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import ConfigurationError
from smartcam.web._errors import RefusedError
from smartcam.web._failure_pictures import FailurePictures
from smartcam.web._fleet_outlets import OutletsView, StoredQuery
from smartcam.web._fleet_socket import PROTOCOL, FleetSocket, RowsInSight
from smartcam.web._fleet_view import FleetView
from smartcam.web._live import CALLS as LIVE_CALLS
from smartcam.web._live_camera import WatchedCamera
from smartcam.web._pictures import FILES
from smartcam.web._routes import CallRequest, Calls
from smartcam.web._shapes import OUTLINES
from smartcam.web._site import API, Site
from smartcam.web._sockets import check_websocket
from smartcam.web._units import PageUnits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from aiohttp import web

    from smartcam.fleet import Fleet
    from smartcam.web._live_camera import ShowsCamera
    from smartcam.web._routes import Action

MAX_VIEWERS: Final = 32
"""Largest number of open pages with the table."""

MAX_CAMERAS: Final = 16
"""Largest number of cameras whose own page is open, or was shortly before."""

LINGER: Final = 30.0
"""Seconds for which the site still follows a camera after the last viewer of its page has left."""

VIEWER_CHECK_PERIOD: Final = 1.0
"""Seconds between two checks for viewers."""


class FleetSite(Site):
    """A page and HTTP calls that show the cameras of a fleet, and a page for each camera.

    ::

        async with smartcam.fleet.open("fleet://plant-server") as fleet, FleetSite(fleet) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        fleet: an open fleet, which the caller closes.
        control: whether the pages may trigger, start, stop and switch cameras.
        units: names of units that the pages show at first instead of SI, such as
            ``("mm", "deg")``. None: the pages begin with SI, and their switch offers these two.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry, as for :class:`~smartcam.web.FramesSite`.

    Attributes:
        view: view of the fleet that the table shows.
        control: whether the pages may command cameras.
        viewers: sockets of the pages that show the table.
        outlets: the agents' reports on their outlets.

    Raises:
        ConfigurationError: the token cannot be used, or a unit is unknown.
    """

    def __init__(
        self,
        fleet: Fleet,
        *,
        control: bool = False,
        units: Sequence[str] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(
            CALLS,
            "fleet",
            host=host,
            port=port,
            token=token,
            files=(
                *FILES,
                "fleet_chart.js",
                "fleet_outlets.js",
                "fleet_row.js",
                "live.css",
                "live.js",
            ),
            pages={"/camera/{name:.+}": "live"},
        )
        self.fleet: Fleet = fleet
        self.control: bool = control
        self.units: PageUnits = PageUnits(units)
        self.view: FleetView = FleetView(fleet, self.units.shown)
        self.viewers: set[FleetSocket] = set()
        self.outlets: OutletsView = OutletsView(fleet)
        self._watched: dict[str, WatchedCamera] = {}
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Follow the fleet, and open the port.

        Raises:
            ConfigurationError: the site cannot listen there.

        Cancellation: leaves the site stopped.
        """
        try:
            await self.view.start()
            if not self._tasks:
                jobs = (self._update_live_cameras(), FailurePictures(self.view).run())
                self._tasks = [asyncio.create_task(job, name="smartcam.web.fleet") for job in jobs]
            await super().start()
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Close the port, and stop following the fleet."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for viewer in self.viewers:
            viewer.end()
        try:
            for name in list(self._watched):
                await self._watched.pop(name).stop()
            await super().stop()
        finally:
            await self.view.stop()

    def about(self) -> dict[str, Any]:
        """Return the first message to a page, as values for JSON."""
        return {
            "fleet": self.fleet.url,
            "control": self.control,
            "outlines": OUTLINES,
            "units": self.units.as_json(),
        }

    # ------------------------------------------------------------------ one camera

    def watched_camera(self, name: str) -> WatchedCamera:
        """Return the camera with this name; begin to follow it for its own page if needed.

        Raises:
            RefusedError: 404, no camera has this name; 503, there are :data:`MAX_CAMERAS` already.
        """
        watched = self._watched.get(name)
        if watched is None:
            watched = self._follow_camera(name)
        watched.used_at = asyncio.get_running_loop().time()
        return watched

    def _follow_camera(self, name: str) -> WatchedCamera:
        try:
            camera = self.fleet[name]
        except ConfigurationError as exc:
            raise RefusedError(404, str(exc)[:300], "a camera of the fleet") from exc
        if len(self._watched) >= MAX_CAMERAS:
            label = f"camera {MAX_CAMERAS + 1} on a page of its own"
            raise RefusedError(503, label, f"{MAX_CAMERAS} at one time")
        row = self.view.rows.get(name)
        watched = WatchedCamera(camera, control=self.control, units=self.units, row=row)
        self._watched[name] = watched
        watched.start()
        if row is not None and row.last is not None:
            watched.view.add_result(row.last)
        return watched

    async def _update_live_cameras(self) -> None:
        """Stop following cameras without viewers; replace objects of cameras that have ended."""
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(VIEWER_CHECK_PERIOD)
            for name, watched in list(self._watched.items()):
                if not watched.is_watched and loop.time() - watched.used_at > LINGER:
                    del self._watched[name]
                    await watched.stop()
                    continue
                camera = watched.view.camera
                if (current := self.fleet[name]) is not camera:
                    await watched.view.follow(current, watched.view.loss)


# ---------------------------------------------------------------------- calls

CALLS: Calls[FleetSite] = Calls()
"""All calls."""


@CALLS.add("GET", API)
def _calls(_site: FleetSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/fleet")
def _fleet(site: FleetSite, _call: CallRequest) -> object:
    """The fleet: how many cameras are in each state, and the outcomes of the last ten minutes."""
    about = {"fleet": site.fleet.url, "control": site.control, "agents": sorted(site.view.agents)}
    return {**about, "totals": site.view.totals(), "bars": list(site.view.series)}


@CALLS.add(
    "GET",
    f"{API}/cameras",
    query=RowsInSight,
    about="Some rows of the table: the query may have `first`, `count`, `search`, `filter`, "
    "`sort`, `descending`.",
)
async def _cameras(site: FleetSite, call: CallRequest) -> object:
    rows_in_sight: RowsInSight = call.query
    names = (await site.view.get_order(rows_in_sight.query)).names
    cameras: list[dict[str, Any]] = []
    for name in names[rows_in_sight.first : rows_in_sight.first + rows_in_sight.count]:
        row = site.view.rows.get(name)
        if row is not None:  # the camera was not forgotten meanwhile
            cameras.append(row.fields())
            await asyncio.sleep(0)
    return {"found": len(names), "cameras": cameras}


@CALLS.add(
    "GET",
    f"{API}/table",
    about="A WebSocket: send the query for some rows as JSON, as in `/api/cameras`; after each "
    "`next` it sends the changes of these rows, at most five times a second.",
)
async def _table(site: FleetSite, call: CallRequest) -> web.StreamResponse:
    check_websocket(call.request, PROTOCOL, len(site.viewers), MAX_VIEWERS)
    viewer = FleetSocket(site.view, site.about(), call.request)
    site.viewers.add(viewer)
    try:
        return await viewer.serve()
    finally:
        site.viewers.discard(viewer)


@CALLS.add("GET", f"{API}/outlets")
async def _outlets(site: FleetSite, _call: CallRequest) -> object:
    """The counts of all agents' outlets: results = delivered + spooled + dropped."""
    return {"outlets": [counts._asdict() for counts in await site.outlets.counts()]}


@CALLS.add(
    "GET",
    f"{API}/stored",
    query=StoredQuery,
    about="The contents of agents' stores of results: the query may have `hours`, `failed` "
    "(errors, gaps, failures), `camera` (a pattern), `limit`.",
)
async def _stored(site: FleetSite, call: CallRequest) -> object:
    return {"stores": [answer._asdict() for answer in await site.outlets.stored(call.query)]}


def _act_on_camera(handler: Action[ShowsCamera]) -> Action[FleetSite]:
    """Return a handler that acts on the camera whose name is in the path."""

    def handle(site: FleetSite, call: CallRequest) -> object:
        return handler(site.watched_camera(call.path["camera"]), call)

    return handle


def _add_live_calls() -> None:
    """Add the calls of the live page, with the camera's name in the path."""
    for row in LIVE_CALLS:
        if row.path == API:
            continue
        tail = row.path.removeprefix(API).removeprefix("/camera")
        CALLS.add_row(row, f"{API}/cameras/{{camera}}{tail}", _act_on_camera(row.handler))


_add_live_calls()
