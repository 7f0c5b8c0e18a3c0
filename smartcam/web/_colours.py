"""Serve the site on which a range of colours is picked in a camera's picture.

Next to the picture, the page shows the mask: which pixels are in the range. A page asks for the
next picture when it has shown the last one, so a slow page skips pictures. The last pictures of
each page are kept: a click on a pixel is about such a picture, not about the newest one, and the
mask of another range is shown without a new picture.
"""

from __future__ import annotations

import contextlib
import json
from collections import OrderedDict, deque
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, TypeVar

import numpy as np
from aiohttp import web
from pydantic import Field

from smartcam._extras import load
from smartcam.depth import ColourRange, find_regions
from smartcam.depth._inside import hsv
from smartcam.exceptions import ConfigurationError, FrameSourceError, LocalProtocolError
from smartcam.web._errors import RefusedError, short_repr
from smartcam.web._jpeg import jpeg, require_encoder
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API
from smartcam.web._threaded_site import ThreadedSite

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.frames import Frame, FrameSource

MAX_WAITING_REQUESTS: Final = 16
"""Largest number of requests that may wait for a frame at a time: two from each of 8 viewers."""

MAX_VIEWERS_KEPT: Final = 8
"""Largest number of viewers whose pictures are kept."""

PICTURES_PER_VIEWER: Final = 2
"""Number of pictures kept for each viewer: the shown one, and the one in transfer."""

THREADS: Final = 2
"""Number of threads that make pictures and masks."""

MIN_REGION_SHARE: Final = 2e-3
"""Least share of the picture that a region must fill to be reported."""

MAX_REGIONS: Final = 8
"""Largest number of regions that are reported, the largest first."""

T = TypeVar("T")


class ColourSite(ThreadedSite):
    """A page that picks a range of colours in a camera's live picture.

    ::

        async with (
            smartcam.frames.open("v4l2:///dev/video0?format=YUYV", linger=2.0) as source,
            ColourSite(source) as site,
        ):
            site.url    # http://127.0.0.1:PORT/

    Args:
        source: source that the caller opens and closes. It streams for each picture that is asked
            for; ``linger`` keeps it streaming in between.
        colours: range of colours that the page begins with.
        quality: quality of the JPEGs that are made, 1 to 100. JPEGs of the camera stay as they
            are.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry in ``Authorization: Bearer``, as for
            :class:`~smartcam.web.LiveSite`.

    Attributes:
        source: the given source.
        colours: the given colours.

    Raises:
        ConfigurationError: the token cannot be used, or the quality is not valid.
        MissingExtraError: the extra ``depth`` is not installed.
    """

    thread_count: ClassVar[int] = THREADS

    def __init__(
        self,
        source: FrameSource,
        *,
        colours: ColourRange | None = None,
        quality: int = 90,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "colours", host=host, port=port, token=token)
        if not 1 <= quality <= 100:
            raise ConfigurationError(f"quality: expected 1 to 100, got {quality!r}")
        require_encoder()
        load("cv2")
        self.source: FrameSource = source
        self.colours: ColourRange = ColourRange() if colours is None else colours
        self._quality = quality
        self._waiting_count = 0
        self._pictures: OrderedDict[str, deque[Frame]] = OrderedDict()

    async def stop(self) -> None:
        """Close the port, and drop all pictures."""
        try:
            await super().stop()
        finally:
            self._pictures.clear()

    async def next_frame(self, viewer: str) -> Frame:
        """Return the next frame of the source, and keep it for a viewer.

        Raises:
            RefusedError: there is no frame, or too many requests wait for one.
        """
        name = self.source.name
        try:
            with self._count_waiting():
                async with self.source.reader() as reader:
                    frame = await anext(reader)
        except LocalProtocolError as exc:
            raise RefusedError(409, f"{name} is not open", "a source that is there") from exc
        except (FrameSourceError, ConfigurationError) as exc:
            raise RefusedError(409, str(exc), "a source that gives frames") from exc
        except StopAsyncIteration:
            raise RefusedError(410, f"{name} has ended", "one that goes on") from None
        frames = self._pictures.setdefault(viewer, deque(maxlen=PICTURES_PER_VIEWER))
        frames.append(frame)
        self._pictures.move_to_end(viewer)
        while len(self._pictures) > MAX_VIEWERS_KEPT:
            self._pictures.popitem(last=False)
        return frame

    def kept_frame(self, viewer: str, sequence: int | None = None) -> Frame:
        """Return the last frame that a viewer got, or its frame with a sequence number.

        Raises:
            RefusedError: the frame is no longer kept.
        """
        for frame in reversed(self._pictures.get(viewer, ())):
            if sequence in {None, frame.sequence}:
                return frame
        which = "a picture" if sequence is None else f"picture {sequence}"
        raise RefusedError(409, f"{which} that is not kept any longer", "the one that is shown")

    async def work(self, what: Callable[..., T], *args: object) -> T:
        """Return the result of a function that reads a frame; the function runs in a thread.

        Raises:
            RefusedError: the frame's bytes are wrong, or the site is stopped.

        Cancellation: safe; a function that has begun runs to its end.
        """
        try:
            return await self.in_thread(what, *args)
        except FrameSourceError as exc:
            raise RefusedError(409, str(exc), "a frame that can be read") from exc

    def segmented(self, frame: Frame, colours: ColourRange) -> bytes:
        """Return a frame and its mask as the page reads them; call it in a thread: it is slow.

        Returns:
            The length of the JSON as four bytes (little-endian), the JSON, a JPEG of the frame, and
            a PNG of the mask. ``jpeg`` in the JSON is the length of the JPEG.

        Raises:
            FrameFormatError: the frame's bytes are wrong.
        """
        jpeg_data = jpeg(frame, self._quality)
        mask = colours.mask_hsv(hsv(frame))
        _, png = load("cv2").imencode(".png", mask.view(np.uint8) * 255)
        regions = find_regions(
            mask, area=(MIN_REGION_SHARE * mask.size, np.inf), max_regions=MAX_REGIONS
        )
        values = {
            "sequence": frame.sequence,
            "width": frame.width,
            "height": frame.height,
            "format": frame.format.name,
            "age": frame.age,
            "range": asdict(colours),
            "share": float(mask.mean()),
            "regions": [
                {
                    "area": region.area,
                    "sides": region.sides,
                    "ratio": region.ratio,
                    "fullness": region.fullness,
                    "orientation": region.orientation,
                    "centre": region.centre,
                    "corners": region.corners.tolist(),
                }
                for region in regions
            ],
            "jpeg": len(jpeg_data),
        }
        head = json.dumps(values).encode()
        return b"".join((len(head).to_bytes(4, "little"), head, jpeg_data, png.tobytes()))

    @contextlib.contextmanager
    def _count_waiting(self) -> Iterator[None]:
        """Count a request that waits for a frame in the block; refuse it if there are too many."""
        if self._waiting_count >= MAX_WAITING_REQUESTS:
            raise RefusedError(
                503,
                f"waiting request {MAX_WAITING_REQUESTS + 1}",
                f"{MAX_WAITING_REQUESTS} at most",
            )
        self._waiting_count += 1
        try:
            yield
        finally:
            self._waiting_count -= 1


# ---------------------------------------------------------------------- calls

CALLS: Calls[ColourSite] = Calls()
"""All calls."""

_Viewer = Annotated[str, Field(min_length=1, max_length=64)]


class RangeBody(CallBody):
    """A range of colours, with the fields of :class:`ColourRange`."""

    hue: list[int]
    saturation: list[int]
    value: list[int]

    def colours(self) -> ColourRange:
        """Return the range.

        Raises:
            RefusedError: a value is not valid.
        """
        try:
            return ColourRange(**self.model_dump())
        except ConfigurationError as exc:
            raise RefusedError(422, str(exc), "a range of colours") from exc


class LookBody(CallBody):
    """The body of a request for a picture."""

    viewer: _Viewer
    range: RangeBody
    again: bool = False


class AroundBody(CallBody):
    """The body of a request for the colours around a pixel of a picture."""

    viewer: _Viewer
    sequence: int
    x: int
    y: int


@CALLS.add("GET", API)
def _calls(_site: ColourSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/source")
def _source(site: ColourSite, _call: CallRequest) -> object:
    """The source's name, and the range to begin with."""
    return {"name": site.source.name, "range": asdict(site.colours)}


@CALLS.add(
    "POST",
    f"{API}/look",
    body=LookBody,
    sample='{"viewer": "me", "range": {"hue": [0, 179], "saturation": [0, 255], "value": [0, 60]}}',
    about="The next frame as a JPEG and the mask of a range as a PNG, after JSON with the regions;"
    ' `"again": true`: the frame that this viewer got last. The device streams until it has come.',
)
async def _look(site: ColourSite, call: CallRequest) -> web.Response:
    body: LookBody = call.body
    colours = body.range.colours()
    frame = site.kept_frame(body.viewer) if body.again else await site.next_frame(body.viewer)
    data = await site.work(site.segmented, frame, colours)
    return web.Response(body=data, content_type="application/octet-stream")


@CALLS.add(
    "POST",
    f"{API}/around",
    body=AroundBody,
    sample='{"viewer": "me", "sequence": 1, "x": 320, "y": 240}',
    about="The range of the colours around a pixel of a frame that this viewer got just before.",
)
async def _around(site: ColourSite, call: CallRequest) -> object:
    body: AroundBody = call.body
    frame = site.kept_frame(body.viewer, body.sequence)
    if not (0 <= body.x < frame.width and 0 <= body.y < frame.height):
        size = f"{frame.width}x{frame.height}"
        raise RefusedError(422, f"pixel {short_repr((body.x, body.y))}", f"one within {size}")
    colours = await site.work(ColourRange.around, frame, body.x, body.y)
    return {"range": asdict(colours)}
