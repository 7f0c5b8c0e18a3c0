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
from smartcam.frames._streaming.rtsp_client.channels import InterleavedChannels, options_of, pair_of
from smartcam.frames._streaming.rtsp_client.description import VideoTrack, described, url_of
from smartcam.frames._streaming.rtsp_client.link import RtspLink
from smartcam.frames._video.redirects import MAX_REDIRECTS, REDIRECTS, followed, why

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

GONE_SESSION: Final = 454
NOT_IN_THIS_STATE: Final = 455
UNSUPPORTED_TRANSPORT: Final = 461
INVALID_RANGE: Final = 457


class OtherEncodingError(FrameFormatError):
    """Error for a stream with an unsupported codec."""


class ConversationPlan(NamedTuple):
    """Options of a session.

    Attributes:
        name: name of the source, for errors.
        url: URL with user and password.
        timeout: seconds until the stream plays, and for each answer after that.
        transports: ``tcp`` and ``udp``, in the order of the attempts.
        elsewhere: whether redirects to other hosts or ports are followed.
        tls: TLS context that checks the server's certificate; None: the default.
    """

    name: str
    url: str
    timeout: float
    transports: tuple[str, ...]
    elsewhere: bool = False
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
        self._timeout = SESSION_TIMEOUT
        self._parameters = False  # whether the server supports GET_PARAMETER
        self._doing = "the connection"
        self._sockets: SocketPair | None = None
        self._source = ""  # other host that sends the packets, from the server's answer
        self._alive: asyncio.Task[None] | None = None

    @property
    def link(self) -> RtspLink:
        """The connection."""
        if self._link is None:
            raise self._plan.source_error("not connected")
        return self._link

    @property
    def senders(self) -> tuple[str, ...]:
        """Allowed senders of packets: the server, and the source that it announces.

        A recorder may announce the camera as the sender. The address that a camera behind a router
        announces is not usable.
        """
        peer = str(self.link.peer[0]).partition("%")[0]
        return (peer, self._source) if self._source else (peer,)

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
            raise plan.source_error(f"cannot be read: {why(exc)}") from None

    async def parameter(self, method: str, body: bytes) -> ServerAnswer:
        """Read or set a parameter, within the session if it plays.

        Raises:
            FrameSourceError: there is no such server, or it does not answer.
        """
        plan = self._plan
        try:
            async with asyncio.timeout(plan.timeout):
                if self._link is not None:
                    return await self._parameter(method, body, self._aggregate)
                answer = await self._introduced(method, body)
                if answer.status in (GONE_SESSION, NOT_IN_THIS_STATE):
                    self.link.abort()
                    await self._describe()
                    await self._choose_transport()
                    answer = await self._parameter(method, body, self._aggregate)
                return answer
        except FrameSourceError:
            raise
        except TimeoutError:
            text = f"expected an answer to {method}, got none within {plan.timeout:g} s"
            raise FrameTimeoutError(f"{plan.name}: {text}", source=plan.name) from None
        except OSError as exc:
            raise plan.source_error(f"cannot be asked: {why(exc)}") from None

    async def _introduced(self, method: str, body: bytes) -> ServerAnswer:
        """Connect, and send a request without a session."""
        for _ in range(MAX_REDIRECTS):
            await self._connect()
            answer = await self._parameter(method, body, self._plain())
            location = answer.header("location")
            if answer.status not in REDIRECTS or not location:
                return answer
            self._redirected(location)
        raise self._plan.source_error(f"more than {MAX_REDIRECTS} redirects")

    async def _parameter(self, method: str, body: bytes, url: str) -> ServerAnswer:
        kind = {"Content-Type": "text/parameters", "Content-Length": str(len(body))}
        return await self.link.ask(method, url, kind | self._headers(), body)

    async def play(self) -> None:
        """Start playing, and keep the session alive until :meth:`close`.

        Raises:
            FrameSourceError: the camera refuses or does not answer.
        """
        try:
            async with asyncio.timeout(self._plan.timeout):
                await self._begin_to_play()
        except TimeoutError:
            raise self._silence_error() from None
        keeping = self._keep_alive()
        self._alive = asyncio.create_task(keeping, name=f"session of {self._plan.name}")

    async def close(self) -> None:
        """End the session and the connection. Idempotent."""
        alive, self._alive = self._alive, None
        link, self._link = self._link, None
        if alive is not None:
            alive.cancel()
            await asyncio.wait([alive])
        sockets, self._sockets = self._sockets, None
        if sockets is not None:
            sockets.close()
        if link is None:
            return
        try:
            if self._session and not link.ended:
                link.on_packet = link.on_read = link.on_end = _ignore
                with contextlib.suppress(FrameSourceError, TimeoutError):
                    async with asyncio.timeout(CLOSE_TIMEOUT):
                        await link.ask("TEARDOWN", self._aggregate, self._headers())
        finally:
            link.abort()

    def _silence_error(self) -> FrameSourceError:
        return self._plan.source_error(
            f"expected an answer to {self._doing}, got none within {self._plan.timeout:g} s"
        )

    # until it is set up

    async def _describe(self) -> None:
        for _ in range(MAX_REDIRECTS):
            await self._connect()
            answer = await self._ask("OPTIONS", self._plain())
            if answer.status not in REDIRECTS:
                self._parameters = "GET_PARAMETER" in answer.header("public").upper()
                accept = {"Accept": "application/sdp"}
                answer = await self._ask("DESCRIBE", self._plain(), accept)
            location = answer.header("location")
            if answer.status not in REDIRECTS or not location:
                self._take_description(answer)
                return
            self._redirected(location)
        raise self._plan.source_error(f"more than {MAX_REDIRECTS} redirects")

    async def _connect(self) -> None:
        parts = urlsplit(self._url)
        where = (parts.hostname or "", parts.port or PORTS[parts.scheme])
        shown = Credentials(unquote(parts.username or ""), unquote(parts.password or ""))
        self._doing = "the connection"
        tls = self._plan.tls if parts.scheme == "rtsps" else None
        self._link = await RtspLink.connect(self._plan.name, where, shown, tls)

    def _plain(self) -> str:
        """Return the URL without user and password."""
        parts = urlsplit(self._url)
        return parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment="").geturl()

    def _redirected(self, location: str) -> None:
        link = self.link
        if self._plan.elsewhere:
            self._url = self._elsewhere(location)
        else:
            self._url = followed(self._url, location, str(link.peer[0]), self._plan.name)
        link.abort()

    def _elsewhere(self, location: str) -> str:
        """Return the URL of a redirect; another host gets no password."""
        try:
            to = urlsplit(urljoin(self._url, location))
            if to.scheme not in PORTS or not to.hostname or to.port == 0:
                raise ValueError(location)
        except ValueError:
            text = f"expected a redirect to rtsp://HOST, got {location[:80]!r}"
            raise self._plan.source_error(text) from None
        before = urlsplit(self._url)
        if to.hostname == before.hostname and "@" not in to.netloc and before.username:
            user = before.netloc.rpartition("@")[0]
            to = to._replace(netloc=f"{user}@{to.netloc}")
        return to.geturl()

    def _take_description(self, answer: ServerAnswer) -> None:
        self._expect_ok("DESCRIBE", answer)
        description = described(answer.body)
        track = description.chosen()
        if track is None:
            raise self._none_of(description.tracks, description.others, answer)
        base = answer.header("content-base") or answer.header("content-location")
        if not re.match(r"(?i)rtsps?://", base):
            base = self._plain()
        self.track, self._base = track, base
        self._aggregate = url_of(description.control, base)

    def _none_of(
        self, tracks: tuple[VideoTrack, ...], others: tuple[str, ...], answer: ServerAnswer
    ) -> FrameFormatError:
        offered = [
            f"{'encrypted ' * track.secure}{track.encoding or track.payload_type}"
            for track in tracks
        ]
        shown = ", ".join((*offered, *others)) or f"{len(answer.body)} bytes without a stream"
        kind = FrameFormatError
        if any(track.encoding and not track.secure for track in tracks):
            kind = OtherEncodingError
        text = f"{self._plan.name}: expected video in H264, H265 or JPEG, got {shown[:200]}"
        return kind(text, source=self._plan.name)

    async def _choose_transport(self) -> None:
        first, *others = self._plan.transports
        answer = await self._set_up(first)
        for transport in others:
            if answer.status == UNSUPPORTED_TRANSPORT:
                answer = await self._set_up(transport)
        self._expect_ok("SETUP", answer)

    async def _set_up(self, transport: str) -> ServerAnswer:
        return await (self._by_channels() if transport == "tcp" else self._by_ports())

    async def _by_channels(self) -> ServerAnswer:
        transport = "RTP/AVP/TCP;unicast;interleaved=0-1"
        answer = await self._set_up_track(transport)
        if answer.status == 200:
            given = options_of(answer.header("transport") or transport)
            self._check_transport(given, "RTP/AVP/TCP")
            channels = pair_of(given.get("interleaved", ""), 255) or (0, 1)
            self.channels = InterleavedChannels(self.link, channels, self.track.payload_type)
        return answer

    async def _by_ports(self) -> ServerAnswer:
        link = self.link
        pair = self._open_ports(link)
        port = pair.rtp.getsockname()[1]
        answer = await self._set_up_track(f"RTP/AVP;unicast;client_port={port}-{port + 1}")
        if answer.status == 200:
            given = options_of(answer.header("transport"))
            self._check_transport(given, "RTP/AVP")
            self.channels = pair
            self._source = _address(given.get("source", ""))
            ports = pair_of(given.get("server_port", ""), 65535)
            if ports is not None:
                _open_firewall(pair, str(link.peer[0]), ports)
        return answer

    def _open_ports(self, link: RtspLink) -> SocketPair:
        host = str(link.address[0])
        family = link.family
        if self._sockets is None:
            self._sockets = SocketPair.waiting(Endpoint(family, host, 0))
        return self._sockets

    def _check_transport(self, given: dict[str, str], transport: str) -> None:
        actual = given[""].removesuffix("/UDP") or transport
        if actual != transport or "multicast" in given:
            shown = f"{actual}{';multicast' * ('multicast' in given)}"
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
        self._take_session(answer)
        return answer

    def _take_session(self, answer: ServerAnswer) -> None:
        session, _, options = answer.header("session").partition(";")
        self._session = session.strip() or self._session
        match = re.search(r"(?i)timeout\s*=\s*([0-9]{1,6})", options)
        if match is not None and int(match[1]):
            self._timeout = max(MIN_SESSION_TIMEOUT, float(match[1]))

    # while it plays

    async def _begin_to_play(self) -> None:
        begin = {"Range": "npt=0.000-"}
        answer = await self._ask("PLAY", self._aggregate, begin | self._headers())
        if answer.status == INVALID_RANGE:
            answer = await self._ask("PLAY", self._aggregate, self._headers())
        track = url_of(self.track.control, self._base)
        if answer.status in (404, 459) and track != self._aggregate:
            answer = await self._ask("PLAY", track, begin | self._headers())
        self._expect_ok("PLAY", answer)

    async def _keep_alive(self) -> None:
        """Send a request twice per session timeout."""
        while True:
            await asyncio.sleep(self._timeout / 2)
            method = "GET_PARAMETER" if self._parameters else "OPTIONS"
            try:
                async with asyncio.timeout(min(self._plan.timeout, self._timeout)):
                    answer = await self.link.ask(method, self._aggregate, self._headers())
            except TimeoutError:
                continue  # some cameras do not answer while they play
            except FrameSourceError as error:
                self.link.fail(str(error).removeprefix(f"{self._plan.name}: "))
                return
            if answer.status == GONE_SESSION:
                self.link.fail(f"{method}: 454 Session Not Found")
                return
            self._parameters &= answer.status == 200

    # both

    def _headers(self) -> dict[str, str]:
        return {"Session": self._session} if self._session else {}

    async def _ask(
        self, method: str, url: str, headers: dict[str, str] | None = None
    ) -> ServerAnswer:
        self._doing = method
        return await self.link.ask(method, url, headers)

    def _expect_ok(self, method: str, answer: ServerAnswer) -> None:
        if answer.status != 200:
            raise self._plan.source_error(f"{method}: {answer.status} {answer.reason}".rstrip())


def _address(text: str) -> str:
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
