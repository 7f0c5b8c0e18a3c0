"""``smartcam probe``: which transport and dialect does a camera speak."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from smartcam.cli.options import camera_url
from smartcam.exceptions import ConnectFailedError, SmartCamError
from smartcam.handshake import Session, Try, attempt, load_protocol
from smartcam.models import Status
from smartcam.protocols.framing import DEFAULT_MAX_LENGTH
from smartcam.protocols.messages import StatusReport
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.cli.options import Options
    from smartcam.connection import TraceEntry
    from smartcam.settings import Address

__all__ = ["probe"]


async def probe(host_or_url: str, options: Options) -> None:
    """Try transports and dialects, one after the other on fresh links, until one answers."""
    address = parse_address(camera_url(host_or_url))
    candidates = _candidates(address)
    share = options.step(10.0) / len(candidates)
    failed: list[str] = []
    with options.tracing() as write:
        for candidate in candidates:
            progress = Try(candidate.dialect or "", "")
            frames: list[TraceEntry] = []

            def note(entry: TraceEntry, frames: list[TraceEntry] = frames) -> None:
                frames.append(entry)
                if write is not None:
                    write(entry)

            session = await _try(candidate, progress, share, note)
            try:
                _show_try(progress, frames, options)
                if session is not None:
                    _show_session(session, options)
                    return
            finally:
                if session is not None:
                    await session.link.close(1.0)
            failed.append(str(progress))
    raise ConnectFailedError(
        f"no session with {address.host}:{address.port}: " + "; ".join(failed),
        host=address.host,
        port=address.port,
        attempts=tuple(failed),
    )


def _candidates(address: Address) -> list[Address]:
    """Return every way to speak to it, what the URL says first."""
    protocol = load_protocol(address.protocol)
    ways = [
        address._replace(scheme=scheme, dialect=dialect)
        for scheme in protocol.schemes
        for dialect in protocol.dialects
    ]
    return sorted(
        ways,
        key=lambda way: (
            way.scheme != address.scheme,
            way.dialect != (address.dialect or way.dialect),
        ),
    )


async def _try(
    candidate: Address, progress: Try, share: float, note: Callable[[TraceEntry], None]
) -> Session | None:
    protocol = load_protocol(candidate.protocol)
    transport = protocol.schemes[candidate.scheme]
    progress.transport = transport.value
    try:
        async with asyncio.timeout(share):
            session = await attempt(
                candidate,
                protocol.dialects[progress.dialect],
                transport,
                progress=progress,
                name=f"{candidate.host}:{candidate.port}",
                max_length=DEFAULT_MAX_LENGTH,
                trace=note,
            )
    except (OSError, UnicodeError, SmartCamError) as exc:
        progress.end(exc, share)
    else:
        progress.outcome = "session"
        return session
    return None


def _show_try(progress: Try, frames: list[TraceEntry], options: Options) -> None:
    value = {
        "transport": progress.transport,
        "dialect": progress.dialect,
        "step": progress.step,
        "outcome": progress.outcome,
        "frames": frames,
    }
    lines = [f"{progress.transport} {progress.dialect}: {progress.step}: {progress.outcome}"]
    if progress.outcome == "session":
        lines = [f"{progress.transport} {progress.dialect}: a camera answers"]
    for entry in frames:
        fields = ", ".join(f"{name}={value}" for name, value in (entry.fields or {}).items())
        lines.append(f"  {entry.direction} {entry.message}({fields})  {entry.hex[:128]}")
    options.show(value, "\n".join(lines))


def _show_session(session: Session, options: Options) -> None:
    status = Status(0)
    for chunk in session.early:
        for event in chunk.events:
            if isinstance(event, StatusReport):
                status = event.status
    value = {
        "url": session.address.url,
        "status": status,
        "protocol_version": session.version,
    }
    options.show(
        value,
        f"status: {status}\nuse: {session.address.url}",
    )
