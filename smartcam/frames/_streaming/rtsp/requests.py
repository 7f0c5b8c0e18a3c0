"""Answer the requests to the server (RFC 2326, section 10)."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import FrameSourceError
from smartcam.frames._streaming.rtp.h264 import parameter_sets
from smartcam.frames._streaming.rtsp.addresses import TRACK, requested_transport, target_of
from smartcam.frames._streaming.rtsp.delivery import (
    ChannelDelivery,
    DatagramDelivery,
    open_port_pair,
)
from smartcam.frames._streaming.rtsp.messages import RtspError
from smartcam.frames._streaming.rtsp.packing import PAYLOAD_TYPE
from smartcam.frames._streaming.rtsp.sdp import describe
from smartcam.frames._streaming.rtsp.session import SESSION_TIMEOUT, RtspSession

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames._streaming.rtsp.addresses import RequestedTransport, RtspTarget
    from smartcam.frames._streaming.rtsp.connection import RtspConnection
    from smartcam.frames._streaming.rtsp.delivery import PacketDelivery
    from smartcam.frames._streaming.rtsp.messages import RtspRequest


MAX_SESSIONS: Final = 8
"""Largest number of sessions of one connection."""

FIRST_FRAME_TIMEOUT: Final = 5.0
"""Seconds to wait for a first key frame, which the description needs; FFmpeg waits longer."""

UNSUPPORTED_METHODS: Final = ("ANNOUNCE", "RECORD", "REDIRECT")
"""RTSP methods that this server does not support."""


class RtspAnswer(NamedTuple):
    """The answer to a successful request."""

    headers: tuple[tuple[str, str], ...] = ()
    body: bytes = b""


async def execute_request(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    """Execute a request, and return its answer.

    Raises:
        RtspError: the request must be answered with this error.
    """
    method = request.method
    if method not in METHODS:
        allowed = ((("Allow", PUBLIC),)) if method in UNSUPPORTED_METHODS else (("Public", PUBLIC),)
        status = 405 if method in UNSUPPORTED_METHODS else 501
        raise RtspError(status, f"expected one of {PUBLIC}, got {method}", allowed)
    if "require" in request.headers:
        option = request.headers["require"]
        raise RtspError(
            551, f"no option is supported, got {option[:80]!r}", (("Unsupported", option),)
        )
    if method == "OPTIONS":  # OPTIONS needs no password
        return await _options(connection, request)
    connection.password_check.check(request)
    for session in connection.sessions.values():
        session.keep_alive()
    with connection.mark_serving():
        return await METHODS[method](connection, request)


async def _options(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    if request.url != "*":
        target_of(request.url)
    return RtspAnswer((("Public", PUBLIC),))


async def _describe(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    accepted = request.headers.get("accept", "application/sdp").lower()
    if "application/sdp" not in accepted and "*/*" not in accepted:
        raise RtspError(406, f"Accept: expected application/sdp, got {accepted[:80]!r}")
    target = target_of(request.url)
    stream = connection.owner.stream(target.name)
    try:
        key_frame = await stream.shared_h264.first_key_frame(FIRST_FRAME_TIMEOUT)
        sets = parameter_sets(bytes(key_frame.data))
    except FrameSourceError as exc:
        raise RtspError(503, str(exc)) from exc
    if sets is None:
        raise RtspError(503, f"{target.name}: a key frame without parameter sets")
    rate, host = stream.rate, str(connection.address[0])
    body = describe(stream.name, host, connection.owner.sdp_session, sets, PAYLOAD_TYPE, rate)
    return RtspAnswer(
        (("Content-Type", "application/sdp"), ("Content-Base", f"{target.base}/")), body
    )


async def _setup(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    target = target_of(request.url)
    stream = connection.owner.stream(target.name)
    if "session" in request.headers:
        session = _session_of(connection, request)
        if session.is_playing or session.stream is stream:
            raise RtspError(455, f"{stream.name}: the session is set up already")
        raise RtspError(459, "each stream needs a separate session")
    requested = requested_transport(request.headers.get("transport", ""), str(connection.peer[0]))
    if len(connection.sessions) >= MAX_SESSIONS:
        raise RtspError(453, f"{MAX_SESSIONS} sessions are open on this connection")
    session = RtspSession(stream, connection.on_session_end)
    connection.owner.add_viewer(session, str(connection.peer[0]))
    try:
        delivery = await _open_delivery(connection, requested, session)
    except BaseException:
        connection.owner.remove_viewer(session, str(connection.peer[0]))
        raise
    session.start(delivery)
    connection.sessions[session.id] = session
    transport = f'{delivery.transport};ssrc={session.ssrc:08X};mode="PLAY"'
    return RtspAnswer((_session_header(session), ("Transport", transport)))


async def _open_delivery(
    connection: RtspConnection, requested: RequestedTransport, session: RtspSession
) -> PacketDelivery:
    if requested.is_tcp:
        return ChannelDelivery(connection.transport, *_channels(connection, requested))
    address = connection.address
    family = socket.AF_INET6 if ":" in str(address[0]) else socket.AF_INET
    try:
        sockets = open_port_pair(str(address[0]), family)
    except OSError as exc:
        raise RtspError(503, f"no ports: {exc}") from exc
    ports = (requested.rtp or 0, requested.rtcp or 0)
    delivery = DatagramDelivery(sockets, connection.peer, ports, session.take_rtcp)
    await delivery.open()
    return delivery


def _channels(connection: RtspConnection, requested: RequestedTransport) -> tuple[int, int]:
    taken = set(connection.used_channels())
    if requested.rtp is None or requested.rtcp is None:
        pairs = ((channel, channel + 1) for channel in range(0, 256, 2))
        return next(pair for pair in pairs if not taken.intersection(pair))
    if {requested.rtp, requested.rtcp} & taken:
        raise RtspError(461, f"Transport: channels {requested.rtp}-{requested.rtcp} are in use")
    return requested.rtp, requested.rtcp


async def _play(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    target, session = _target_and_session(connection, request)
    rtp_info = session.play()
    return RtspAnswer(
        (
            _session_header(session),
            ("Range", "npt=now-"),
            ("RTP-Info", f"url={target.base}/{TRACK};{rtp_info}"),
        )
    )


async def _pause(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    _, session = _target_and_session(connection, request)
    if not session.is_playing:
        raise RtspError(455, "the session does not play")
    session.pause()
    return RtspAnswer((_session_header(session),))


async def _teardown(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    _, session = _target_and_session(connection, request)
    session.close()
    connection.remove_session(session)
    return RtspAnswer()


async def _handle_parameters(connection: RtspConnection, request: RtspRequest) -> RtspAnswer:
    """Answer a request without parameters, by which a client keeps its session alive."""
    if request.url != "*":
        target_of(request.url)
    headers: tuple[tuple[str, str], ...] = ()
    if "session" in request.headers:
        headers = (_session_header(_session_of(connection, request)),)
    if request.body.strip():
        raise RtspError(451, f"no parameter is known, got {request.body[:60]!r}", headers)
    return RtspAnswer(headers)


def _session_of(connection: RtspConnection, request: RtspRequest) -> RtspSession:
    session_id = request.headers.get("session", "").partition(";")[0].strip()
    if session_id not in connection.sessions:
        raise RtspError(454, f"Session: expected one of this connection's, got {session_id[:40]!r}")
    return connection.sessions[session_id]


def _target_and_session(
    connection: RtspConnection, request: RtspRequest
) -> tuple[RtspTarget, RtspSession]:
    """Return a request's target and session."""
    target = target_of(request.url)
    stream = connection.owner.stream(target.name)
    if "session" not in request.headers and not connection.sessions:
        raise RtspError(455, f"{request.method}: expected SETUP before it")
    session = _session_of(connection, request)
    if session.stream is not stream:
        raise RtspError(454, f"Session: it is of {session.stream.name}, not of {stream.name}")
    return target, session


def _session_header(session: RtspSession) -> tuple[str, str]:
    return "Session", f"{session.id};timeout={SESSION_TIMEOUT}"


METHODS: Final[dict[str, Callable[[RtspConnection, RtspRequest], Awaitable[RtspAnswer]]]] = {
    "OPTIONS": _options,
    "DESCRIBE": _describe,
    "SETUP": _setup,
    "PLAY": _play,
    "PAUSE": _pause,
    "GET_PARAMETER": _handle_parameters,
    "SET_PARAMETER": _handle_parameters,
    "TEARDOWN": _teardown,
}

PUBLIC: Final = ", ".join(METHODS)
