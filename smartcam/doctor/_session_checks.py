"""Checks of the connection from the name up to a session, and the reasons for a lost session."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import dialect_remarks, reason_for, reason_values
from smartcam.doctor._findings import Exit
from smartcam.doctor._probing import most_informative_first, try_ways
from smartcam.doctor._timing import time_statistics
from smartcam.exceptions import (
    ConnectFailedError,
    ProtocolError,
    ResponseTimeoutError,
)
from smartcam.protocols import Transport
from smartcam.protocols._inside import load_protocol

if TYPE_CHECKING:
    from smartcam._client._inside import Attempt, Reason
    from smartcam.camera import Camera
    from smartcam.doctor._context import Examination
    from smartcam.doctor._probing import CameraAnswer, TracedAttempt
    from smartcam.exceptions import SmartCamError

SESSION_COUNT = 5
"""Number of sessions made one after the other, to measure the connect time."""

MAX_CONNECTING_SECONDS = 3.0
"""Seconds after which no further session is made, so that a slow link does not delay the
examination."""

CONNECTION_TIMEOUT = 1.0
"""Seconds to open a bare TCP connection, which shows whether the camera is still there."""

CONNECTION_DELAY = 0.25
"""Seconds to wait before the bare connection: a camera that shuts down closes its port late."""

MAX_TAKEN_SESSION_AGE = 10.0
"""Largest age in seconds at which a lost session was probably taken by another client; the client
uses the same rule (see :mod:`smartcam._client.supervisor`)."""


# ---------------------------------------------------------------------- the name


async def resolve(exam: Examination) -> None:
    """Check ``name``: the addresses that the host resolves to."""
    host, port = exam.address.host, exam.address.port
    loop = asyncio.get_running_loop()
    limit = exam.options.step_timeout(10.0)
    try:
        async with asyncio.timeout(limit):
            resolved = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as exc:
        reason = exc.strerror if isinstance(exc, OSError) and exc.strerror else str(exc)
        reason = reason or f"no name server answers within {limit:g} s"
        exam.fail(
            f"the name {host!r} does not resolve: {reason}",
            "Look for a slip in the name, or give the camera's IP address instead of a name. "
            "Names need a DNS server, or an entry in this machine's hosts file.",
            host=host,
        )
        return
    addresses = sorted({str(entry[4][0]) for entry in resolved})
    if addresses != [host]:
        text = f"{host} is {', '.join(addresses)}"
        exam.report("ok", text, host=host, addresses=addresses)


# ---------------------------------------------------------------------- the session


async def connect(exam: Examination) -> None:
    """Check ``session``: make a session, then more to measure the connect time."""
    loop = asyncio.get_running_loop()
    names_dialect = exam.address.dialect is not None
    start = loop.time()
    try:
        camera = await exam.make_camera().open()
    except ConnectFailedError as exc:
        found_camera = await _diagnose_failure(exam, exc)
        if found_camera is None:
            return
        camera, times, start = found_camera, list[float](), loop.time()
    else:
        times = [loop.time() - start]
    exam.use_url(camera.url)
    first = times[0] if times and not names_dialect else None
    try:
        while len(times) < SESSION_COUNT and loop.time() - start < MAX_CONNECTING_SECONDS:
            await camera.close()
            connect_start = loop.time()
            camera = await exam.make_camera().open()
            times.append(loop.time() - connect_start)
    except ConnectFailedError as exc:
        exam.fail(
            f"a session was made, and another one right after it was not: {exc}",
            "A camera that is connected to again and again must answer each time. Look for "
            "another client, and at cable and power.",
            connected=len(times),
        )
        return
    exam.camera, exam.connected_at = camera, loop.time()
    if first is not None and len(times) > 1:
        del times[0]  # the first time includes the search for the dialect
    _report_session(exam, camera, first, times)


def _report_session(
    exam: Examination, camera: Camera, first: float | None, times: list[float]
) -> None:
    measured = time_statistics(times)
    link, dialect = exam.address.scheme, exam.address.dialect
    search = "" if first is None else f"; the first, which found the dialect, {1e3 * first:.1f} ms"
    exam.report(
        "ok",
        f"a camera answers by {link}://, dialect {dialect}, protocol version "
        f"{camera.protocol_version}; {measured.samples} connects: {measured}{search}",
        "" if first is None else f"Use {camera.url} from now on: it names the dialect.",
        url=camera.url,
        protocol_version=camera.protocol_version,
        connect_time=measured._asdict(),
    )
    for remark in dialect_remarks(exam.address):
        exam.report("warning", remark)


# ---------------------------------------------------------------------- no session


async def _diagnose_failure(exam: Examination, failure: ConnectFailedError) -> Camera | None:
    """Report why there is no session; return a camera if another way leads to one."""
    given, attempts = exam.address, await _try_all(exam)
    answer = attempts[-1].answer
    if answer is None:
        _report_no_session(exam, attempts, None)
        return None
    exam.use_url(answer.url)
    if exam.address.scheme == given.scheme and given.dialect in {None, exam.address.dialect}:
        exam.report(
            "warning",
            f"the first attempt failed, the second one had a session: {failure}",
            "Once is no harm: the client tries again. If it happens often, look for another "
            "client.",
            attempts=list(failure.attempts),
        )
    else:
        _report_no_session(exam, attempts, answer)
    try:
        return await exam.make_camera().open()
    except ConnectFailedError as exc:
        exam.fail(f"the camera that answered a moment ago is gone: {exc}")
        return None


async def _try_all(exam: Examination) -> list[TracedAttempt]:
    """Try every way up to the first one with an answer; return the attempts."""
    timeout = exam.options.step_timeout(10.0)
    attempts = try_ways(exam.address, timeout=timeout, trace=exam.trace, every_protocol=True)
    async with contextlib.aclosing(attempts):
        return [attempt async for attempt in attempts]


def _report_no_session(
    exam: Examination, attempts: list[TracedAttempt], answer: CameraAnswer | None
) -> None:
    address = attempts[0].address
    reason, attempt = _find_reason(attempts, same_dialect=address.dialect is not None)
    texts = reason_values(attempt, address, load_protocol(address.protocol))
    if answer is not None:
        cure = f"A camera answers at {answer.url}: use this URL. The next checks were made there."
    else:
        others = [other for other in most_informative_first(attempts) if other is not attempt]
        others_text = f" Also tried: {_attempts_text(others)}." if others else ""
        cure = reason.cure.format(**texts) + others_text
    exam.fail(
        reason.text.format(**texts),
        cure,
        attempts=[*map(str, attempts)],
        frames=[tuple(attempt.frames) for attempt in attempts],
        answers_at=answer.url if answer is not None else None,
    )


def _find_reason(attempts: list[TracedAttempt], *, same_dialect: bool) -> tuple[Reason, Attempt]:
    """Return the reason why the URL gives no session, and the attempt that shows it."""
    first = attempts[0]
    similar_attempts = [
        attempt
        for attempt in attempts
        if attempt.transport == first.transport
        and not attempt.is_other_protocol
        and (attempt.dialect == first.dialect or not same_dialect)
    ]
    return reason_for(similar_attempts)


def _attempts_text(attempts: list[TracedAttempt]) -> str:
    """Return attempts in one line; dialects of equal transport and outcome are listed together."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for attempt in attempts:
        port_text = f" at port {attempt.address.port}" if attempt.is_other_protocol else ""
        key = (f"{attempt.transport.upper()}{port_text}", attempt.step, attempt.outcome)
        groups.setdefault(key, []).append(attempt.dialect)
    return "; ".join(
        f"{', '.join(dialects)} over {transport}: {step}: {outcome}"
        for (transport, step, outcome), dialects in groups.items()
    )


# ---------------------------------------------------------------------- a session lost


async def explain_loss(exam: Examination, error: SmartCamError) -> None:
    """Report why a session is over, without taking the camera.

    A client would have to take the camera back once to know that its session was taken
    (ConnectionTakenError). This function only opens a bare TCP connection, to see whether the
    camera still listens. A connection alone takes no session, only Connect does (inferred).
    """
    age = asyncio.get_running_loop().time() - exam.connected_at
    cause = error.__cause__
    details: dict[str, Any] = {"after": age, "error": str(error)}
    exam.check = "lost"
    is_closed = isinstance(cause, OSError) and not isinstance(cause, TimeoutError)
    schemes = load_protocol(exam.address.protocol).schemes
    is_udp = schemes[exam.address.scheme] is Transport.UDP
    if isinstance(cause, ProtocolError):
        exam.fail(
            f"the camera sent something that is no message, and the session was given up: {cause}",
            "Another dialect? A device in between? smartcam probe and --trace show the bytes.",
            **details,
        )
    elif is_closed and not is_udp and await _accepts_connection(exam):
        soon_text = ", soon after its Connect" if age < MAX_TAKEN_SESSION_AGE else ""
        exam.fail(
            f"the camera ended the session after {age:.1f} s{soon_text}, and still takes "
            "connections: another client has most probably taken it",
            "Find the other one: a copy of your program, a PLC, the maker's software, a forgotten "
            "smartcam watch. A camera serves one client, and the newcomer wins.",
            check="taken",
            **details,
        )
    elif is_closed:
        exam.fail(
            f"the session broke after {age:.1f} s, and the camera takes no connection now: {error}",
            "It restarts, or lost its power or its network. Look at its lamps and its cable, and "
            "try again in half a minute.",
            **details,
        )
    else:
        udp_text = " Over UDP, a client is not told that another one has taken the camera."
        exam.fail(
            f"the camera fell silent after {age:.1f} s: {error}",
            "Look at cable, switch and power, and for another client."
            + (udp_text if is_udp else ""),
            exit_code=Exit.TIMED_OUT
            if isinstance(error, ResponseTimeoutError)
            else Exit.NO_SESSION,
            **details,
        )


async def _accepts_connection(exam: Examination) -> bool:
    """Return True if the camera's port accepts a TCP connection."""
    await asyncio.sleep(CONNECTION_DELAY)
    try:
        async with asyncio.timeout(CONNECTION_TIMEOUT):
            _, writer = await asyncio.open_connection(exam.address.host, exam.address.port)
    except (OSError, UnicodeError):
        return False
    writer.transport.abort()
    return True
