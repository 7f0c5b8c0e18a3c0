"""Sources that VLC, FFmpeg and GStreamer can look at."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, Final

from smartcam._server import Server
from smartcam.exceptions import ConfigurationError, LocalProtocolError
from smartcam.frames._codecs import Codecs
from smartcam.frames._rtsp.addresses import NAME
from smartcam.frames._rtsp.authentication import Authentication
from smartcam.frames._rtsp.serving import RtspServing, listen
from smartcam.frames._rtsp.streams import RtspStream
from smartcam.frames._shared_stream import SharedH264

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._rtsp.streams import RtspStatistics
    from smartcam.frames._source import FrameSource


PORT: Final = 8554

RATE: Final = 30.0
"""Frames a second of a source that does not say."""

_ANY: Final = ("", "0.0.0.0", "::")  # noqa: S104 - compared, not bound


class RtspServer(Server):
    """Serves sources by RTSP, as H.264 over UDP or over the connection (RFC 2326, RFC 6184).

    ::

        async with RtspServer({"left": source}) as server:
            print(server.url("left"))

    A source is encoded once, however many look at it, and streams while somebody looks, and for two
    seconds after. A viewer that is too slow is sent whole frames only, skips those in between, and
    goes on with a key frame; one that takes nothing for 10 s is cut off, and so is one over UDP of
    which nothing was heard for 60 s. Datagrams go to the address that the connection comes from,
    and nowhere else. When a source ends, its viewers are told and their connections closed; who
    asks then is answered 503 with the reason, and the source is tried again.

    Whoever reaches the port may look, unless there is a password. Neither it nor the pictures are
    encrypted: with Digest the password itself does not go over the network.

    Args:
        sources: by name; who asks for one that is not open is answered 503. A name has 1 to 64
            letters, digits and ``. _ ~ -``, the first a letter or digit.
        host: to listen on.
        port: to listen on; 0: any.
        user: that may look; None: everybody may.
        password: of the user.
        basic: takes the password as it is, too, from clients that know no Digest.
        bitrate: bits a second that an encoder keeps to instead of a quality.
        crf: quality, 0 (best) to 51.
        fps: frames a second, for the bit rate; None: as each source says, else 30.
        keyint: frames in which every part of the picture is sent anew.
        max_connections: at a time.
        max_viewers: sessions at a time, of all connections.

    Raises:
        ConfigurationError: no sources, a name that is none, user without password, or a number out
            of its range.
    """

    def __init__(
        self,
        sources: Mapping[str, FrameSource],
        *,
        host: str = "127.0.0.1",
        port: int = PORT,
        user: str | None = None,
        password: str | None = None,
        basic: bool = False,
        bitrate: int | None = None,
        crf: float = 23.0,
        fps: float | None = None,
        keyint: int = 30,
        max_connections: int = 64,
        max_viewers: int = 32,
    ) -> None:
        for name in sources:
            if not NAME.fullmatch(name):
                raise ConfigurationError(
                    "RtspServer: a name: expected 1 to 64 letters, digits and . _ ~ -, the first a "
                    f"letter or digit, got {name!r}"
                )
        if not sources:
            raise ConfigurationError("RtspServer: expected a source, got none")
        for what, most in (("max_connections", max_connections), ("max_viewers", max_viewers)):
            if not 1 <= most <= 1000:
                raise ConfigurationError(f"RtspServer: {what}: expected 1 to 1000, got {most!r}")
        self.host: str = host
        self._authentication = Authentication(user, password, basic=basic)
        self._sources = dict(sources)
        self._port = port
        self._fps, self._keyint, self._crf, self._bitrate = fps, keyint, crf, bitrate
        self._max_connections, self._max_viewers = max_connections, max_viewers
        self._streams: dict[str, RtspStream] = {}
        self._serving: RtspServing | None = None

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port

    def url(self, name: str) -> str:
        """Return a stream's URL, without the password.

        It has this machine's name where the server listens on all addresses.

        Raises:
            ConfigurationError: there is no such stream.
        """
        if name not in self._sources:
            raise ConfigurationError(
                f"RtspServer: expected one of {', '.join(self._sources)}, got {name!r}"
            )
        host = socket.gethostname() if self.host in _ANY else self.host
        return f"rtsp://{f'[{host}]' if ':' in host else host}:{self._port}/{name}"

    def statistics(self) -> dict[str, RtspStatistics]:
        """Return what each stream did since the server was started, by its name."""
        return {name: stream.statistics() for name, stream in self._streams.items()}

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there, or a number is out of its range.
            MissingExtraError: the extra ``video`` is not installed.

        Cancellation: leaves it stopped.
        """
        if self._serving is not None:
            return
        codecs = Codecs(threads=min(4, len(self._sources)))
        streams = self._made(codecs)
        try:
            listener = await listen(self.host, self._port)
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"RTSP: cannot listen on {self.host} port {self._port}: {exc}"
            ) from exc
        await codecs.__aenter__()
        self._port = listener.getsockname()[1]
        self._streams = streams
        limits = (self._max_connections, self._max_viewers)
        self._serving = RtspServing(streams, codecs, self._authentication, *limits)
        self._serving.open(listener)

    async def stop(self) -> None:
        """Say goodbye to the viewers and close everything; does nothing if stopped.

        Cancellation: takes effect when all is closed, which a second or two take at most.
        """
        serving, self._serving = self._serving, None
        if serving is None:
            return
        closing = asyncio.ensure_future(serving.close())
        try:
            await asyncio.shield(closing)
        except asyncio.CancelledError:
            await asyncio.wait({closing})
            raise

    def _made(self, codecs: Codecs) -> dict[str, RtspStream]:
        """Return the streams; two names of a source share one encoder."""
        shared: dict[int, tuple[SharedH264, float]] = {}
        for source in self._sources.values():
            if id(source) in shared:
                continue
            rate = self._fps if self._fps is not None else _rate(source)
            encoder = codecs.h264_encoder(
                fps=rate, keyint=self._keyint, crf=self._crf, bitrate=self._bitrate
            )
            shared[id(source)] = SharedH264(source, encoder), rate
        return {name: RtspStream(name, *shared[id(one)]) for name, one in self._sources.items()}


def _rate(source: FrameSource) -> float:
    """Return the frames a second that a source says, or the usual where it is not open yet."""
    try:
        rates = source.format.rates
    except LocalProtocolError:
        rates = ()
    return min(max(rates[0], 0.01), 1000.0) if rates else RATE
