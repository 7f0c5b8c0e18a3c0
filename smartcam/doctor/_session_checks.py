"""Checks of the connection from the name up to a session, and the reasons for a lost session."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import dialect_remarks, reason_for, reason_values
from smartcam.doctor._findings import Exit
from smartcam.doctor._probing import most_informative_first, trials
from smartcam.doctor._timing import figures
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
    from smartcam.doctor._probing import CameraAnswer, Trial
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
    is_pinned = exam.address.dialect is not None
    start = loop.time()
    try:
        camera = await exam.make_camera().open()
    except ConnectFailedError as exc:
        answered = await _diagnose_failure(exam, exc)
        if answered is None:
            return
        camera, times, start = answered, list[float](), loop.time()
    else:
        times = [loop.time() - start]
    exam.pin(camera.url)
    first = times[0] if times and not is_pinned else None
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
    measured = figures(times)
    link, dialect = exam.address.scheme, exam.address.dialect
    search = "" if first is None else f"; the first, which found the dialect, {1e3 * first:.1f} ms"
    exam.report(
        "ok",
        f"a camera answers by {link}://, dialect {dialect}, protocol version "
        f"{camera.protocol_version}; {measured.times} connects: {measured}{search}",
        "" if first is None else f"Use {camera.url} from now on: it says what was found out.",
        url=camera.url,
        protocol_version=camera.protocol_version,
        connect_time=measured._asdict(),
    )
    for remark in dialect_remarks(exam.address):
        exam.report("warning", remark)


# ---------------------------------------------------------------------- no session


async def _diagnose_failure(exam: Examination, failure: ConnectFailedError) -> Camera | None:
    """Report why there is no session; return a camera if another way leads to one."""
    given, tries = exam.address, await _try_all(exam)
    answer = tries[-1].answer
    if answer is None:
        _report_no_session(exam, tries, None)
        return None
    exam.pin(answer.url)
    if exam.address.scheme == given.scheme and given.dialect in {None, exam.address.dialect}:
        exam.report(
            "warning",
            f"no session at first ({failure}), and one a moment later",
            "Once is no harm: the client tries again. If it happens often, look for another "
            "client.",
            attempts=list(failure.attempts),
        )
    else:
        _report_no_session(exam, tries, answer)
    try:
        return await exam.make_camera().open()
    except ConnectFailedError as exc:
        exam.fail(f"and it is gone again: {exc}")
        return None


async def _try_all(exam: Examination) -> list[Trial]:
    """Try every way up to the first one with an answer; return the tries."""
    timeout = exam.options.step_timeout(10.0)
    tries = trials(exam.address, timeout=timeout, trace=exam.trace, every_protocol=True)
    async with contextlib.aclosing(tries):
        return [trial async for trial in tries]


def _report_no_session(exam: Examination, tries: list[Trial], answer: CameraAnswer | None) -> None:
    address = tries[0].address
    reason, trial = _find_reason(tries, pinned=address.dialect is not None)
    texts = reason_values(trial, address, load_protocol(address.protocol))
    if answer is not None:
        cure = f"A camera answers at {answer.url}: use this URL. What follows was seen there."
    else:
        others = [other for other in most_informative_first(tries) if other is not trial]
        others_text = f" Also tried: {_tries_text(others)}." if others else ""
        cure = reason.cure.format(**texts) + others_text
    exam.fail(
        reason.text.format(**texts),
        cure,
        tries=[*map(str, tries)],
        frames=[tuple(one_try.frames) for one_try in tries],
        answers_at=answer.url if answer is not None else None,
    )


def _find_reason(tries: list[Trial], *, pinned: bool) -> tuple[Reason, Attempt]:
    """Return the reason why the URL gives no session, and the try that shows it."""
    first = tries[0]
    similar_tries = [
        trial
        for trial in tries
        if trial.transport == first.transport
        and not trial.is_other_protocol
        and (trial.dialect == first.dialect or not pinned)
    ]
    return reason_for(similar_tries)


def _tries_text(tries: list[Trial]) -> str:
    """Return tries in one line; dialects with equal transport and outcome are listed together."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for trial in tries:
        port_text = f" at port {trial.address.port}" if trial.is_other_protocol else ""
        key = (f"{trial.transport.upper()}{port_text}", trial.step, trial.outcome)
        groups.setdefault(key, []).append(trial.dialect)
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
        udp_text = " Over UDP a client from which another took the camera is told nothing."
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
