"""Run a session with a camera: set up, play, keep alive, end (RFC 2326)."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import unquote, urljoin, urlsplit

from smartcam.exceptions import FrameFormatError, FrameSourceError, FrameTimeoutError
from smartcam.frames._streaming.rtp.packets import ReceiverReport, RtpPacket
from smartcam.frames._streaming.rtp.sockets import Endpoint, SocketPair
from smartcam.frames._streaming.rtsp_client.authorization import Credentials
from smartcam.frames._streaming.rtsp_client.channels import (
    InterleavedChannels,
    parse_pair,
    transport_options,
)
from smartcam.frames._streaming.rtsp_client.description import VideoTrack, parse_description, url_of
from smartcam.frames._streaming.rtsp_client.link import RtspLink
from smartcam.frames._video.redirects import (
    MAX_REDIRECTS,
    REDIRECTS,
    checked_redirect,
    failure_reason,
)

if TYPE_CHECKING:
    import ssl

    from smartcam.frames._streaming.rtp.receiver import PacketChannels
    from smartcam.frames._streaming.rtsp_client.answers import ServerAnswer


PORTS: Final = {"rtsp": 554, "rtsps": 322}

CLOSE_TIMEOUT: Final = 0.5
"""Seconds for the answer to TEARDOWN before the connection is closed."""

SESSION_TIMEOUT: Final = 60.0
"""Session timeout, seconds, unless the server announces another one."""

MIN_SESSION_TIMEOUT: Final = 1.0
"""Least session timeout, seconds, which replaces a shorter one of the server."""

SESSION_NOT_FOUND: Final = 454
INVALID_STATE: Final = 455
UNSUPPORTED_TRANSPORT: Final = 461
INVALID_RANGE: Final = 457


class OtherCodecError(FrameFormatError):
    """Error for a stream whose codec this client does not support, but FFmpeg may."""


class ConversationPlan(NamedTuple):
    """Options of a session.

    Attributes:
        name: name of the source, for errors.
        url: URL with user and password.
        timeout: seconds until the stream plays, and for each answer after that.
        transports: ``tcp`` and ``udp``, in the order of the attempts.
        follows_elsewhere: whether redirects to other hosts or ports are followed.
        tls: TLS context that checks the server's certificate; None: the default.
    """

    name: str
    url: str
    timeout: float
    transports: tuple[str, ...]
    follows_elsewhere: bool = False
    tls: ssl.SSLContext | None = None

    def source_error(self, text: str) -> FrameSourceError:
        """Return an error with the source's name."""
        return FrameSourceError(f"{self.name}: {text}", source=self.name)


class RtspConversation:
    """One session with a server.

    Attributes:
        track: the requested stream, after the setup.
        channels: channels of the packets.
    """

    track: VideoTrack
    channels: PacketChannels

    def __init__(self, plan: ConversationPlan) -> None:
        self._plan, self._url = plan, plan.url
        self._link: RtspLink | None = None
        self._base = self._aggregate = ""
        self._session = ""
        self._session_timeout = SESSION_TIMEOUT
        self._has_get_parameter = False  # whether the server supports GET_PARAMETER
        self._current_step = "the connection"
        self._sockets: SocketPair | None = None
        self._announced_sender = ""  # other host that sends the packets; "": the server
        self._keep_alive_task: asyncio.Task[None] | None = None

    @property
    def link(self) -> RtspLink:
        """The connection."""
        if self._link is None:
            raise self._plan.source_error("not connected")
        return self._link

    @property
    def senders(self) -> tuple[str, ...]:
        """Allowed senders of packets: the server, and the source that it announces.

        A recorder may announce the camera as the sender. The server stays allowed, since a camera
        behind a router announces an address that cannot be reached.
        """
        peer = str(self.link.peer[0]).partition("%")[0]
        return (peer, self._announced_sender) if self._announced_sender else (peer,)

    async def set_up(self) -> None:
        """Set up the stream and the channels of its packets.

        Raises:
            FrameSourceError: there is no such server or stream, or it refuses or does not answer.

        Cancellation: :meth:`close` cleans up.
        """
        plan = self._plan
        try:
            async with asyncio.timeout(plan.timeout):
                await self._describe()
                await self._choose_transport()
        except FrameSourceError:
            raise
        except TimeoutError:
            raise self._silence_error() from None
        except OSError as exc:
            raise plan.source_error(f"cannot be read: {failure_reason(exc)}") from None

    async def send_parameter(self, method: str, body: bytes) -> ServerAnswer:
        """Send a request that reads or sets a parameter, within the session if it plays.

        Raises:
            FrameSourceError: there is no such server, or it does not answer.
        """
        plan = self._plan
        try:
            async with asyncio.timeout(plan.timeout):
                if self._link is not None:
                    return await self._send_parameter(method, body, self._aggregate)
                answer = await self._ask_without_session(method, body)
                if answer.status in (SESSION_NOT_FOUND, INVALID_STATE):
                    self.link.abort()
                    await self._describe()
                    await self._choose_transport()
                    answer = await self._send_parameter(method, body, self._aggregate)
                return answer
        except FrameSourceError:
            raise
        except TimeoutError:
            text = f"expected an answer to {method}, got none within {plan.timeout:g} s"
            raise FrameTimeoutError(f"{plan.name}: {text}", source=plan.name) from None
        except OSError as exc:
            raise plan.source_error(f"cannot be asked: {failure_reason(exc)}") from None

    async def _ask_without_session(self, method: str, body: bytes) -> ServerAnswer:
        """Connect, and send a parameter's request without a session."""
        for _ in range(MAX_REDIRECTS):
            await self._connect()
            answer = await self._send_parameter(method, body, self._url_without_user())
            location = answer.header("location")
            if answer.status not in REDIRECTS or not location:
                return answer
            self._follow_redirect(location)
        raise self._plan.source_error(f"more than {MAX_REDIRECTS} redirects")

    async def _send_parameter(self, method: str, body: bytes, url: str) -> ServerAnswer:
        content = {"Content-Type": "text/parameters", "Content-Length": str(len(body))}
        return await self.link.ask(method, url, content | self._headers(), body)

    async def play(self) -> None:
        """Start playing, and keep the session alive until :meth:`close`.

        Raises:
            FrameSourceError: the camera refuses or does not answer.
        """
        try:
            async with asyncio.timeout(self._plan.timeout):
                await self._start_playing()
        except TimeoutError:
            raise self._silence_error() from None
        name = f"session of {self._plan.name}"
        self._keep_alive_task = asyncio.create_task(self._keep_alive(), name=name)

    async def close(self) -> None:
        """End the session and the connection. Idempotent."""
        keep_alive_task, self._keep_alive_task = self._keep_alive_task, None
        link, self._link = self._link, None
        if keep_alive_task is not None:
            keep_alive_task.cancel()
            await asyncio.wait([keep_alive_task])
        sockets, self._sockets = self._sockets, None
        if sockets is not None:
            sockets.close()
        if link is None:
            return
        try:
            if self._session and not link.end_reason:
                link.on_packet = link.on_batch_read = link.on_end = _ignore
                with contextlib.suppress(FrameSourceError, TimeoutError):
                    async with asyncio.timeout(CLOSE_TIMEOUT):
                        await link.ask("TEARDOWN", self._aggregate, self._headers())
        finally:
            link.abort()

    def _silence_error(self) -> FrameSourceError:
        return self._plan.source_error(
            f"expected an answer to {self._current_step}, got none within {self._plan.timeout:g} s"
        )

    # until it is set up

    async def _describe(self) -> None:
        for _ in range(MAX_REDIRECTS):
            await self._connect()
            answer = await self._ask("OPTIONS", self._url_without_user())
            if answer.status not in REDIRECTS:
                self._has_get_parameter = "GET_PARAMETER" in answer.header("public").upper()
                accept = {"Accept": "application/sdp"}
                answer = await self._ask("DESCRIBE", self._url_without_user(), accept)
            location = answer.header("location")
            if answer.status not in REDIRECTS or not location:
                self._read_description(answer)
                return
            self._follow_redirect(location)
        raise self._plan.source_error(f"more than {MAX_REDIRECTS} redirects")

    async def _connect(self) -> None:
        parts = urlsplit(self._url)
        host_and_port = (parts.hostname or "", parts.port or PORTS[parts.scheme])
        credentials = Credentials(unquote(parts.username or ""), unquote(parts.password or ""))
        self._current_step = "the connection"
        tls = self._plan.tls if parts.scheme == "rtsps" else None
        self._link = await RtspLink.connect(self._plan.name, host_and_port, credentials, tls)

    def _url_without_user(self) -> str:
        """Return the URL without user and password."""
        parts = urlsplit(self._url)
        return parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment="").geturl()

    def _follow_redirect(self, location: str) -> None:
        link = self.link
        if self._plan.follows_elsewhere:
            self._url = self._redirect_elsewhere(location)
        else:
            self._url = checked_redirect(self._url, location, str(link.peer[0]), self._plan.name)
        link.abort()

    def _redirect_elsewhere(self, location: str) -> str:
        """Return the URL of a redirect; the password is sent to the same host only."""
        try:
            target = urlsplit(urljoin(self._url, location))
            if target.scheme not in PORTS or not target.hostname or target.port == 0:
                raise ValueError(location)
        except ValueError:
            text = f"expected a redirect to rtsp://HOST, got {location[:80]!r}"
            raise self._plan.source_error(text) from None
        current = urlsplit(self._url)
        is_same_host = target.hostname == current.hostname
        if is_same_host and "@" not in target.netloc and current.username:
            user = current.netloc.rpartition("@")[0]
            target = target._replace(netloc=f"{user}@{target.netloc}")
        return target.geturl()

    def _read_description(self, answer: ServerAnswer) -> None:
        self._expect_ok("DESCRIBE", answer)
        description = parse_description(answer.body)
        track = description.first_supported_track()
        if track is None:
            raise self._no_video_error(description.tracks, description.others, answer)
        base = answer.header("content-base") or answer.header("content-location")
        if not re.match(r"(?i)rtsps?://", base):
            base = self._url_without_user()
        self.track, self._base = track, base
        self._aggregate = url_of(description.control, base)

    def _no_video_error(
        self, tracks: tuple[VideoTrack, ...], others: tuple[str, ...], answer: ServerAnswer
    ) -> FrameFormatError:
        offered = [
            f"{'encrypted ' * track.is_encrypted}{track.codec_name or track.payload_type}"
            for track in tracks
        ]
        shown = ", ".join((*offered, *others)) or f"{len(answer.body)} bytes without a stream"
        error_class = FrameFormatError
        if any(track.codec_name and not track.is_encrypted for track in tracks):
            error_class = OtherCodecError
        text = f"{self._plan.name}: expected video in H264, H265 or JPEG, got {shown[:200]}"
        return error_class(text, source=self._plan.name)

    async def _choose_transport(self) -> None:
        first, *others = self._plan.transports
        answer = await self._request_transport(first)
        for transport in others:
            if answer.status == UNSUPPORTED_TRANSPORT:
                answer = await self._request_transport(transport)
        self._expect_ok("SETUP", answer)

    async def _request_transport(self, transport: str) -> ServerAnswer:
        return await (self._set_up_channels() if transport == "tcp" else self._set_up_ports())

    async def _set_up_channels(self) -> ServerAnswer:
        transport = "RTP/AVP/TCP;unicast;interleaved=0-1"
        answer = await self._set_up_track(transport)
        if answer.status == 200:
            options = transport_options(answer.header("transport") or transport)
            self._check_transport(options, "RTP/AVP/TCP")
            channels = parse_pair(options.get("interleaved", ""), 255) or (0, 1)
            self.channels = InterleavedChannels(self.link, channels, self.track.payload_type)
        return answer

    async def _set_up_ports(self) -> ServerAnswer:
        link = self.link
        pair = self._open_ports(link)
        port = pair.rtp.getsockname()[1]
        answer = await self._set_up_track(f"RTP/AVP;unicast;client_port={port}-{port + 1}")
        if answer.status == 200:
            options = transport_options(answer.header("transport"))
            self._check_transport(options, "RTP/AVP")
            self.channels = pair
            self._announced_sender = _unicast_address(options.get("source", ""))
            ports = parse_pair(options.get("server_port", ""), 65535)
            if ports is not None:
                _open_firewall(pair, str(link.peer[0]), ports)
        return answer

    def _open_ports(self, link: RtspLink) -> SocketPair:
        host = str(link.address[0])
        family = link.family
        if self._sockets is None:
            self._sockets = SocketPair.open_even_port(Endpoint(family, host, 0))
        return self._sockets

    def _check_transport(self, options: dict[str, str], transport: str) -> None:
        actual = options[""].removesuffix("/UDP") or transport
        if actual != transport or "multicast" in options:
            shown = f"{actual}{';multicast' * ('multicast' in options)}"
            raise self._plan.source_error(
                f"SETUP: expected {transport};unicast, as it was asked for, got {shown[:80]!r}"
            )

    async def _set_up_track(self, transport: str) -> ServerAnswer:
        url = url_of(self.track.control, self._base)
        answer = await self._ask("SETUP", url, {"Transport": transport} | self._headers())
        if answer.status == 404 and "?" in self._base and self.track.control not in ("", "*"):
            path, _, query = self._base.partition("?")
            url = f"{url_of(self.track.control, path)}?{query}"
            answer = await self._ask("SETUP", url, {"Transport": transport} | self._headers())
        self._read_session(answer)
        return answer

    def _read_session(self, answer: ServerAnswer) -> None:
        session, _, options = answer.header("session").partition(";")
        self._session = session.strip() or self._session
        match = re.search(r"(?i)timeout\s*=\s*([0-9]{1,6})", options)
        if match is not None and int(match[1]):
            self._session_timeout = max(MIN_SESSION_TIMEOUT, float(match[1]))

    # while it plays

    async def _start_playing(self) -> None:
        from_start = {"Range": "npt=0.000-"}
        answer = await self._ask("PLAY", self._aggregate, from_start | self._headers())
        if answer.status == INVALID_RANGE:
            answer = await self._ask("PLAY", self._aggregate, self._headers())
        track = url_of(self.track.control, self._base)
        if answer.status in (404, 459) and track != self._aggregate:
            answer = await self._ask("PLAY", track, from_start | self._headers())
        self._expect_ok("PLAY", answer)

    async def _keep_alive(self) -> None:
        """Send a request twice per session timeout."""
        while True:
            await asyncio.sleep(self._session_timeout / 2)
            method = "GET_PARAMETER" if self._has_get_parameter else "OPTIONS"
            try:
                async with asyncio.timeout(min(self._plan.timeout, self._session_timeout)):
                    answer = await self.link.ask(method, self._aggregate, self._headers())
            except TimeoutError:
                continue  # some cameras do not answer while they play
            except FrameSourceError as error:
                self.link.fail(str(error).removeprefix(f"{self._plan.name}: "))
                return
            if answer.status == SESSION_NOT_FOUND:
                self.link.fail(f"{method}: 454 Session Not Found")
                return
            self._has_get_parameter &= answer.status == 200

    # before and while it plays

    def _headers(self) -> dict[str, str]:
        return {"Session": self._session} if self._session else {}

    async def _ask(
        self, method: str, url: str, headers: dict[str, str] | None = None
    ) -> ServerAnswer:
        self._current_step = method
        return await self.link.ask(method, url, headers)

    def _expect_ok(self, method: str, answer: ServerAnswer) -> None:
        if answer.status != 200:
            raise self._plan.source_error(f"{method}: {answer.status} {answer.reason}".rstrip())


def _unicast_address(text: str) -> str:
    """Return the text if it is the unicast address of a host, else ""."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return ""
    return "" if address.is_multicast or address.is_unspecified else str(address)


def _open_firewall(pair: SocketPair, host: str, ports: tuple[int, int]) -> None:
    """Send datagrams to the sender of the packets, so that firewalls let the packets in."""
    with contextlib.suppress(OSError):
        pair.rtp.sendto(RtpPacket(False, 0, 0, 0, 0, b"").pack(), (host, ports[0]))
        pair.rtcp.sendto(ReceiverReport(0).pack(), (host, ports[1]))


def _ignore(*_: object) -> None:
    pass
