"""Show the newest frames of a few sources to the viewers of a site."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import TYPE_CHECKING, Annotated

from aiohttp import web
from pydantic import Field

from smartcam._arguments import check_flag
from smartcam.exceptions import (
    FrameFeatureError,
    FrameSourceError,
    LocalProtocolError,
    TriggerError,
    UnsupportedError,
)
from smartcam.web._errors import RefusedError, short_repr
from smartcam.web._jpeg import require_encoder
from smartcam.web._pictures import FILES, SitePictures
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API, Site

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.frames import Frame, FrameSource
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
        sources: sources that the caller opens and closes; the page waits for a source to open.
        quality: quality of the JPEGs that are made, 1 to 100. A JPEG from a camera stays as it is.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        changes: whether everyone who can open the page may set features of the devices, execute
            their commands and trigger them.
        token: token that every call must carry in ``Authorization: Bearer``, as for
            :class:`~smartcam.web.LiveSite`. A browser cannot set this header for a WebSocket: it
            offers the subprotocol ``bearer.TOKEN`` instead.

    Attributes:
        sources: the given sources.
        changes: whether viewers may change the devices.
        failures: reason why a source is not open, by its index in ``sources``; set by the program
            that opens the sources.

    Raises:
        ConfigurationError: the token cannot be used, or the quality is not valid.
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
        changes: bool = False,
    ) -> None:
        files = (*FILES, "features.js")
        super().__init__(CALLS, "frames", host=host, port=port, token=token, files=files)
        self.changes: bool = check_flag(changes, "changes", "FramesSite")
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
        """Close the port, and end the viewers."""
        self.pictures.end_viewers()
        try:
            await super().stop()
        finally:
            await self.pictures.stop()


# ---------------------------------------------------------------------- calls

CALLS: Calls[FramesSite] = Calls()
"""All calls."""


def _source_index(site: FramesSite, call: CallRequest) -> int:
    text = call.path["index"]
    if not text.isdecimal() or len(text) > 3 or int(text) >= len(site.sources):
        raise RefusedError(404, f"source {short_repr(text)}", f"0 to {len(site.sources) - 1}")
    return int(text)


class _NameBody(CallBody):
    """The name of a feature."""

    name: Annotated[str, Field(min_length=1, max_length=200)]


class _FeatureBody(_NameBody):
    """A feature, and its new value."""

    value: bool | int | Annotated[float, Field(allow_inf_nan=False)] | str


def _changeable_source_index(site: FramesSite, call: CallRequest) -> int:
    """Return the index of a source that viewers may change."""
    if not site.changes:
        raise RefusedError(
            403, "a change of a device", "a site that was started with --changes, or changes=True"
        )
    return _source_index(site, call)


@contextlib.contextmanager
def _refuse_on_error(site: FramesSite, index: int) -> Iterator[None]:
    """Refuse the call if the block raises an error of the device."""
    try:
        yield
    except LocalProtocolError as exc:
        failure = site.pictures.state(index)["failure"]
        raise RefusedError(409, failure, "a source that is there") from exc
    except (FrameFeatureError, UnsupportedError) as exc:
        raise RefusedError(422, str(exc), "what the device has") from exc
    except (FrameSourceError, TriggerError) as exc:
        raise RefusedError(409, str(exc), "a source that gives frames") from exc


async def _jpeg_answer(site: FramesSite, index: int, frame: Frame) -> web.Response:
    data = await site.pictures.jpeg_maker(index).jpeg(frame)
    headers = {"Frame-Sequence": str(frame.sequence), "Frame-Age": f"{frame.age:.4f}"}
    return web.Response(body=data, content_type="image/jpeg", headers=headers)


@CALLS.add("GET", API)
def _calls(_site: FramesSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/sources")
def _sources(site: FramesSite, _call: CallRequest) -> object:
    """The sources, with their states and counts."""
    return {"sources": [site.pictures.state(index) for index in range(len(site.sources))]}


@CALLS.add("GET", f"{API}/sources/{{index}}/features")
async def _features(site: FramesSite, call: CallRequest) -> object:
    """The features of a source's device, with value and range; and whether they may be set here."""
    index = _source_index(site, call)
    with _refuse_on_error(site, index):
        described = await site.sources[index].features.describe()
    features = [
        {**dataclasses.asdict(feature), "range": feature.range} for feature in described.values()
    ]
    for feature in features:
        if isinstance(feature["value"], float) and not math.isfinite(feature["value"]):
            feature["value"] = None
    return {"settable": site.changes, "features": features}


@CALLS.add(
    "POST",
    f"{API}/sources/{{index}}/feature",
    body=_FeatureBody,
    sample='{"name": "Gain", "value": 6.0}',
)
async def _set_feature(site: FramesSite, call: CallRequest) -> object:
    """Set a feature, if changes are allowed; answers the device's new value."""
    index = _changeable_source_index(site, call)
    with _refuse_on_error(site, index):
        return {"value": await site.sources[index].features[call.body.name].set(call.body.value)}


@CALLS.add(
    "POST", f"{API}/sources/{{index}}/command", body=_NameBody, sample='{"name": "UserSetLoad"}'
)
async def _command(site: FramesSite, call: CallRequest) -> object:
    """Execute a command, if changes are allowed; answers when the device has done it."""
    index = _changeable_source_index(site, call)
    with _refuse_on_error(site, index):
        await site.sources[index].features[call.body.name].execute()
    return {}


@CALLS.add("POST", f"{API}/sources/{{index}}/trigger")
async def _trigger(site: FramesSite, call: CallRequest) -> web.Response:
    """Trigger the device, if changes are allowed; answers the triggered picture as a JPEG."""
    index = _changeable_source_index(site, call)
    with _refuse_on_error(site, index):
        return await _jpeg_answer(site, index, await site.sources[index].trigger())


@CALLS.add("GET", f"{API}/sources/{{index}}/picture")
async def _picture(site: FramesSite, call: CallRequest) -> web.Response:
    """The newest frame, as a JPEG; the device streams until it has come."""
    index = _source_index(site, call)
    with _refuse_on_error(site, index):
        return await _jpeg_answer(site, index, await site.sources[index].newest())


@CALLS.add(
    "GET",
    f"{API}/sources/{{index}}/pictures",
    about="A WebSocket: after each message `next`, JSON and the newest frame as a JPEG.",
)
async def _pictures(site: FramesSite, call: CallRequest) -> web.StreamResponse:
    return await site.pictures.serve_viewer(_source_index(site, call), call.request)
