"""Define the live page's site: a camera's results, and calls that command the camera if allowed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aiohttp import web
from pydantic import Field

from smartcam.exceptions import SmartCamError
from smartcam.web._errors import RefusedError
from smartcam.web._live_camera import state_of
from smartcam.web._live_frames import LiveFrames
from smartcam.web._live_view import LiveView
from smartcam.web._pictures import FILES
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API, Site
from smartcam.web._streams import PERIOD, StreamEvent
from smartcam.web._units import PageUnits

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    from smartcam.camera import Camera
    from smartcam.web._live_camera import ShowsCamera

MAX_NEWS = 20
"""Largest number of results in one event. With ten events a second the page gets up to 200 results
a second; of further results it gets only the number."""

CHECKS_PER_CLOCK_REPORT = round(1.0 / PERIOD)
"""Number of checks for changes between two reports of the clock and of the counts, so that a report
is sent once a second."""


class LiveSite(Site):
    """A page and HTTP calls that show a camera's results.

    ::

        async with smartcam.connect(url) as camera, LiveSite(camera) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        camera: camera that the caller opens and closes. A page made before the camera is opened
            shows all results.
        control: whether the page may trigger, start, stop and switch. Without it, the page's
            readers cannot affect the camera, except that its picture is fetched, if it has one.
        units: names of units that the page shows at first instead of SI, such as
            ``("mm", "deg")``. None: it begins with SI, and its switch offers these two.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry in ``Authorization: Bearer``: at least 16 letters,
            digits, ``-`` and ``_``. None: no token on a loopback address; else one is made.

    Attributes:
        view: view of the camera that the page shows.
        frames: frames of the camera, if it has any.
        control: whether the page may command the camera.

    Raises:
        ConfigurationError: the token cannot be used, or a unit is unknown.
    """

    def __init__(
        self,
        camera: Camera[Any],
        *,
        control: bool = False,
        units: Sequence[str] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "live", host=host, port=port, token=token, files=FILES)
        self.control: bool = control
        self.units: PageUnits = PageUnits(units)
        self.view: LiveView = LiveView(camera, lambda: bool(len(self.streams)))
        self.frames: LiveFrames = LiveFrames(lambda: self.view.camera)

    async def start(self) -> None:
        """Open the port, and follow the camera."""
        await super().start()
        self.view.start()
        self.frames.start()

    async def stop(self) -> None:
        """Close the port, and stop following the camera."""
        await self.frames.stop()
        await self.view.stop()
        await super().stop()

    def state(self) -> dict[str, Any]:
        """Return the state of the camera and the rights of the page, as values for JSON."""
        return state_of(self)


class LiveReader:
    """Remembers what one reader has received about a camera, and finds later changes."""

    def __init__(self, site: ShowsCamera, since: int | None = None) -> None:
        self._site = site
        self._view = site.view
        oldest = self._view.entries[0].serial if self._view.entries else self._view.serial
        self._serial = oldest if since is None else since
        self._last_values: dict[str, Any] = {}
        self._check_count = 0
        self._sent_history_version = -1

    def find_events(self) -> Iterator[StreamEvent]:
        """Yield the changes since the last call; the first call yields everything."""
        view = self._view
        yield from self._event_if_changed("camera", self._site.state())
        yield from self._result_events()
        picture = 0 if view.picture is None else view.picture.serial
        yield from self._event_if_changed("picture", {"serial": picture})
        if self._check_count % CHECKS_PER_CLOCK_REPORT == 0:
            yield from self._event_if_changed("counts", view.counts())
            points = list(view.series) if self._check_count == 0 else list(view.series)[-1:]
            yield StreamEvent("clock", {"series": points})
            if self._sent_history_version != view.history.version:
                self._sent_history_version = view.history.version
                yield StreamEvent("history", view.history.as_json())
        self._check_count += 1

    def _result_events(self) -> Iterator[StreamEvent]:
        view = self._view
        if self._serial > view.serial:  # the reader's serial comes from an earlier process
            self._serial = 0
        new = [entry for entry in view.entries if entry.serial >= self._serial]
        missed = (new[0].serial if new else view.serial) - self._serial
        shown = new[-MAX_NEWS:]
        missed += len(new) - len(shown)
        if shown or missed:
            self._serial = view.serial
            entries = [result.as_json() for result in shown]
            yield StreamEvent("results", {"results": entries, "missed": missed}, self._serial)

    def _event_if_changed(self, kind: str, value: Any) -> Iterator[StreamEvent]:
        if self._last_values.get(kind) != value:
            self._last_values[kind] = value
            yield StreamEvent(kind, value)


# ---------------------------------------------------------------------- arguments of calls


class _TriggerBody(CallBody):
    application: int | None = Field(default=None, ge=0, le=0xFFFFFFFF)
    timeout: float = Field(default=5.0, gt=0.0, le=60.0)


class _SwitchBody(CallBody):
    application: int = Field(ge=0, le=0xFFFFFFFF)


# ---------------------------------------------------------------------- calls

CALLS: Calls[ShowsCamera] = Calls()
"""All calls."""


async def _run_command(site: ShowsCamera, command: Callable[[], Awaitable[Any]]) -> Any:
    """Run a command to the camera if the page may command it; turn its error into a refusal."""
    if not site.control:
        raise RefusedError(403, "a command to the camera", "a page started with --control")
    try:
        return await command()
    except SmartCamError as exc:
        raise RefusedError(
            409, f"{type(exc).__name__}: {exc}", "a camera that can do it now"
        ) from exc


@CALLS.add("GET", API)
def _calls(_site: ShowsCamera, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/camera")
def _camera(site: ShowsCamera, _call: CallRequest) -> object:
    """Return the camera's state, and its counts."""
    return {**site.state(), "counts": site.view.counts()}


@CALLS.add("GET", f"{API}/results")
def _results(site: ShowsCamera, _call: CallRequest) -> object:
    """The last results, the oldest first."""
    return {"results": [entry.as_json() for entry in site.view.entries]}


@CALLS.add("GET", f"{API}/history")
def _history(site: ShowsCamera, _call: CallRequest) -> object:
    """Outcomes in bars of five minutes, the last failures, and the first one since a pass."""
    return site.view.history.as_json()


@CALLS.add("GET", f"{API}/failures/{{serial}}")
def _failure(site: ShowsCamera, call: CallRequest) -> web.Response:
    """The picture of a failure, as the camera sent it."""
    serial = call.path["serial"]
    is_valid = serial.isdecimal() and len(serial) < 12
    picture = site.view.history.picture(int(serial)) if is_valid else None
    if picture is None:
        raise RefusedError(404, "no picture of this failure", "a recent failure with a picture")
    return _image(picture)


@CALLS.add("GET", f"{API}/picture")
def _picture(site: ShowsCamera, _call: CallRequest) -> web.Response:
    """The last picture that was fetched, as the camera sends it."""
    picture = site.view.picture
    if picture is None:
        raise RefusedError(404, "no picture", site.view.picture_error or "one that was fetched")
    return _image(picture.data)


_UNKNOWN = "application/octet-stream"
_IMAGE_TYPES = ((b"BM", "image/bmp"), (b"\x89PNG", "image/png"), (b"\xff\xd8", "image/jpeg"))
"""First bytes of the picture files that cameras send, and their types."""


def _image(data: bytes) -> web.Response:
    image_type = next((name for mark, name in _IMAGE_TYPES if data.startswith(mark)), _UNKNOWN)
    return web.Response(body=data, content_type=image_type)


@CALLS.add("POST", f"{API}/picture")
def _want_picture(site: ShowsCamera, _call: CallRequest) -> object:
    """Ask the camera for its picture anew, once a second at most; an event reports it."""
    site.view.request_picture()
    return site.view.state()


@CALLS.add(
    "GET",
    f"{API}/frames",
    about="A WebSocket: a frame of the camera after each `next`, as [here](frames.md#calls).",
)
async def _frames(site: ShowsCamera, call: CallRequest) -> web.StreamResponse:
    pictures = site.frames.pictures
    if pictures is None:
        raise RefusedError(404, "a camera without frames", "one with frames: in the fleet's file")
    return await pictures.serve_viewer(0, call.request)


@CALLS.add(
    "GET",
    f"{API}/events",
    about="What happens, as server-sent events: camera, results, picture, counts, clock, history.",
)
def _events(site: ShowsCamera, call: CallRequest) -> object:
    last = call.request.headers.get("Last-Event-ID", "")
    since = int(last) if last.isdecimal() and len(last) < 20 else None
    return site.streams.serve(call.request, LiveReader(site, since).find_events)


@CALLS.add("POST", f"{API}/trigger", body=_TriggerBody, optional=True, sample='{"timeout": 5.0}')
async def _trigger(site: ShowsCamera, call: CallRequest) -> object:
    """Trigger; answers after the result, which an event reports."""
    body: _TriggerBody = call.body
    camera = site.view.camera
    result = await _run_command(
        site, lambda: camera.trigger(body.application, timeout=body.timeout)
    )
    return {"number": result.number, "latency": result.latency}


@CALLS.add("POST", f"{API}/switch", body=_SwitchBody, sample='{"application": 7}')
async def _switch(site: ShowsCamera, call: CallRequest) -> object:
    """Load another application."""
    await _run_command(site, lambda: site.view.camera.switch_application(call.body.application))
    return site.view.state()


@CALLS.add("POST", f"{API}/take_back")
async def _take_back(site: ShowsCamera, _call: CallRequest) -> object:
    """Make a fleet's agent take the camera back from another client."""
    camera = site.view.camera
    take_back = getattr(camera, "take_back", None)
    if take_back is None:
        raise RefusedError(409, "a camera of no fleet", "one of a fleet: its agent takes it back")
    await _run_command(site, take_back)
    return site.view.state()


@CALLS.add("POST", f"{API}/start")
async def _start(site: ShowsCamera, _call: CallRequest) -> object:
    """Enter run mode."""
    await _run_command(site, site.view.camera.start)
    return site.view.state()


@CALLS.add("POST", f"{API}/stop")
async def _stop(site: ShowsCamera, _call: CallRequest) -> object:
    """Leave run mode."""
    await _run_command(site, site.view.camera.stop)
    return site.view.state()
