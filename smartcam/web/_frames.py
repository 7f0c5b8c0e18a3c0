"""The site of pictures: the newest frame of up to a few sources, to whoever looks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web

from smartcam.exceptions import FrameSourceError, LocalProtocolError
from smartcam.web._errors import RefusedError, shown
from smartcam.web._jpeg import require_encoder
from smartcam.web._pictures import FILES, SitePictures
from smartcam.web._routes import CallRequest, Calls
from smartcam.web._site import API, Site

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import FrameSource
    from smartcam.web._pictures import Viewer


class FramesSite(Site):
    """A page and HTTP calls that show the newest frames of some sources.

    ::

        async with (
            smartcam.frames.open("synthetic://") as source,
            FramesSite([source]) as site,
        ):
            site.url    # http://127.0.0.1:PORT/

    Args:
        sources: they are opened and closed by who made them; one that is not open is awaited.
        quality: of the JPEGs that are made, 1 to 100. What a camera sends as JPEG stays as it is.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        token: what every call must carry in ``Authorization: Bearer``, as
            :class:`~smartcam.web.LiveSite` has it. A browser's WebSocket, which can carry none,
            names it among its protocols: ``bearer.TOKEN``.

    Attributes:
        sources: as given.
        failures: why a source is not open, by its place in ``sources``; for whoever opens them to
            say.

    Raises:
        ConfigurationError: the token cannot be used, or the quality is none.
        MissingExtraError: the extra ``frames`` is not installed.
    """

    def __init__(
        self,
        sources: Sequence[FrameSource],
        *,
        quality: int = 80,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "frames", host=host, port=port, token=token, files=FILES)
        self.pictures: SitePictures = SitePictures(sources, quality)
        require_encoder()
        self.sources: tuple[FrameSource, ...] = self.pictures.sources
        self.failures: dict[int, str] = self.pictures.failures
        self.viewers: set[Viewer] = self.pictures.viewers

    async def start(self) -> None:
        """Open the port."""
        self.pictures.start()
        await super().start()

    async def stop(self) -> None:
        """Close the port; nobody looks any longer."""
        self.pictures.end_viewers()
        try:
            await super().stop()
        finally:
            await self.pictures.stop()


# ---------------------------------------------------------------------- what calls do

CALLS: Calls[FramesSite] = Calls()
"""All calls."""


def _place(site: FramesSite, call: CallRequest) -> int:
    given = call.path["place"]
    if not given.isdecimal() or len(given) > 3 or int(given) >= len(site.sources):
        raise RefusedError(404, f"source {shown(given)}", f"0 to {len(site.sources) - 1}")
    return int(given)


@CALLS.add("GET", API)
def _calls(_site: FramesSite, _call: CallRequest) -> object:
    """These calls."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/sources")
def _sources(site: FramesSite, _call: CallRequest) -> object:
    """The sources, how each is and what was counted."""
    return {"sources": [site.pictures.state(place) for place in range(len(site.sources))]}


@CALLS.add("GET", f"{API}/sources/{{place}}/picture")
async def _picture(site: FramesSite, call: CallRequest) -> web.Response:
    """The newest frame, as a JPEG; the device streams for it."""
    place = _place(site, call)
    try:
        frame = await site.sources[place].newest()
        data = await site.pictures.press(place).jpeg(frame)
    except LocalProtocolError as exc:
        failure = site.pictures.state(place)["failure"]
        raise RefusedError(409, failure, "a source that is there") from exc
    except FrameSourceError as exc:
        raise RefusedError(409, str(exc), "a source that gives frames") from exc
    headers = {"Frame-Sequence": str(frame.sequence), "Frame-Age": f"{frame.age:.4f}"}
    return web.Response(body=data, content_type="image/jpeg", headers=headers)


@CALLS.add(
    "GET",
    f"{API}/sources/{{place}}/pictures",
    about="A WebSocket: the newest frame after each `next` that one says, as a JPEG behind JSON.",
)
async def _pictures(site: FramesSite, call: CallRequest) -> web.StreamResponse:
    return await site.pictures.view(_place(site, call), call.request)
