"""Serve sources by RTSP, for VLC, FFmpeg and GStreamer."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from smartcam._accepting import listening_socket
from smartcam._arguments import check_flag, check_integer, check_kind, check_number, check_text
from smartcam._finishing import finish
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError, LocalProtocolError
from smartcam.frames._codecs.h264 import H264Encoder
from smartcam.frames._codecs.threads import Codecs, StreamRunner
from smartcam.frames._source import FrameSource
from smartcam.frames._streaming.rtsp.addresses import STREAM_NAME
from smartcam.frames._streaming.rtsp.authentication import Authentication
from smartcam.frames._streaming.rtsp.serving import RtspServing
from smartcam.frames._streaming.rtsp.streams import RtspStream
from smartcam.frames._streaming.shared_stream import SharedH264

if TYPE_CHECKING:
    from smartcam.frames._streaming.rtsp.streams import RtspStatistics


PORT: Final = 8554

DEFAULT_FRAME_RATE: Final = 30.0
"""Frames per second of a source that reports none."""

_ALL_ADDRESSES: Final = ("", "0.0.0.0", "::")  # noqa: S104 - compared, not bound


class RtspServer(Server):
    """Serve sources by RTSP, as H.264 over UDP or over the connection (RFC 2326, RFC 6184).

    ::

        async with RtspServer({"left": source}) as server:
            print(server.url("left"))

    A source is encoded once for all viewers. It streams while it has viewers, and two seconds
    longer. A slow viewer misses whole frames, and continues with a key frame. A viewer that accepts
    no data for 10 s, or sends no report over UDP for 60 s, is disconnected. Datagrams go only to
    the connection's address. When a source ends, its viewers' connections are closed; a later
    request is answered 503 with the reason, and restarts the source.

    Without a password, every client that reaches the port may view. Pictures are not encrypted;
    with Digest the password itself is not sent.

    Args:
        sources: sources by name; a request for an unopened source is answered 503. A name has 1
            to 64 letters, digits and ``. _ ~ -``, the first a letter or digit.
        host: address to listen on.
        port: port to listen on; 0: any.
        user: name of the user; None: no password is needed.
        password: password of the user.
        basic: whether the bare password is accepted, from clients that do not know Digest.
        bitrate: bits per second of each source's stream, instead of a quality.
        crf: quality, 0 (best) to 51.
        fps: frames per second, for the bit rate; None: each source's, else 30.
        keyint: number of frames within which every part of the picture is refreshed.
        max_connections: largest number of connections at a time.
        max_viewers: largest number of sessions of all connections at a time.

    Raises:
        ConfigurationError: no sources, an invalid name, a user without a password, or a number out
            of range.
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
        caller = "RtspServer"
        check_kind(sources, Mapping, "sources", "a mapping from name to source", caller)
        for name, source in sources.items():
            check_kind(source, FrameSource, "sources", "sources of frames", caller)
            if not isinstance(name, str) or not STREAM_NAME.fullmatch(name):
                raise ConfigurationError(
                    "RtspServer: a name: expected 1 to 64 letters, digits and . _ ~ -, the first a "
                    f"letter or digit, got {name!r}"
                )
        if not sources:
            raise ConfigurationError("RtspServer: expected a source, got none")
        for word, value in (("user", user), ("password", password)):
            if value is not None:
                check_text(value, word, caller, least=1, most=200)
        self.host: str = check_text(host, "host", caller, least=1, most=300)
        self._authentication = Authentication(
            user, password, allows_basic=check_flag(basic, "basic", caller)
        )
        self._sources = dict(sources)
        self._port = check_integer(port, "port", 0, 0xFFFF, caller)
        self._fps = None if fps is None else check_number(fps, "fps", 0.01, 1000.0, caller)
        self._keyint = check_integer(keyint, "keyint", 2, 600, caller)
        self._crf = check_number(crf, "crf", 0, 51, caller)
        if bitrate is not None:
            bitrate = check_integer(bitrate, "bitrate", 10_000, 1_000_000_000, caller)
        self._bitrate = bitrate
        self._max_connections = check_integer(max_connections, "max_connections", 1, 1000, caller)
        self._max_viewers = check_integer(max_viewers, "max_viewers", 1, 1000, caller)
        self._streams: dict[str, RtspStream] = {}
        self._serving: RtspServing | None = None

    @property
    def port(self) -> int:
        """Port of the server; the given port until it is started."""
        return self._port

    def url(self, name: str) -> str:
        """Return a stream's URL, without the password.

        The URL has this machine's name if the server listens on all addresses.

        Raises:
            ConfigurationError: there is no such stream.
        """
        name = check_text(name, "name", "RtspServer", most=64)
        if name not in self._sources:
            raise ConfigurationError(
                f"RtspServer: expected one of {', '.join(self._sources)}, got {name!r}"
            )
        host = socket.gethostname() if self.host in _ALL_ADDRESSES else self.host
        return f"rtsp://{f'[{host}]' if ':' in host else host}:{self._port}/{name}"

    def statistics(self) -> dict[str, RtspStatistics]:
        """Return the counts of each stream since the server was started, by its name."""
        return {name: stream.statistics() for name, stream in self._streams.items()}

    async def start(self) -> None:
        """Open the port; does nothing if the server is started.

        Raises:
            ConfigurationError: the server cannot listen on the port, or a number is out of range.
            MissingExtraError: the extra ``video`` is not installed.

        Cancellation: the server stays stopped.
        """
        if self._serving is not None:
            return
        codecs = Codecs(threads=min(4, len(self._sources)))
        streams = self._new_streams(codecs)
        try:
            listener = await listening_socket(self.host, self._port)
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
        """Disconnect the viewers and close the port; does nothing if stopped.

        Cancellation: takes effect once everything is closed, within two seconds.
        """
        serving, self._serving = self._serving, None
        if serving is None:
            return
        await finish(serving.close)

    def _new_streams(self, codecs: Codecs) -> dict[str, RtspStream]:
        """Return a stream for each name; a source with two names has one encoder."""
        shared: dict[int, tuple[SharedH264, float]] = {}
        for source in self._sources.values():
            if id(source) in shared:
                continue
            rate = self._fps if self._fps is not None else _rate(source)
            options = {"keyint": self._keyint, "crf": self._crf, "bitrate": self._bitrate}
            encoder = H264Encoder(StreamRunner(codecs), fps=rate, **options)  # type: ignore[arg-type]
            shared[id(source)] = SharedH264(source, encoder), rate
        return {
            name: RtspStream(name, *shared[id(source)]) for name, source in self._sources.items()
        }


def _rate(source: FrameSource) -> float:
    """Return a source's frame rate, or the default if the source is not open."""
    try:
        rates = source.format.rates
    except LocalProtocolError:
        rates = ()
    return min(max(rates[0], 0.01), 1000.0) if rates else DEFAULT_FRAME_RATE
