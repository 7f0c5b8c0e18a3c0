"""A question to the camera, and a whole session: ``query_application()``, ``connect()`` and close.

The yardstick's bare protocol sends the same Query and waits for its answer, and opens a link, sends
Connect and closes it. Both ends are on one core, so that waking the peer is no part of it.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import smartcam
from benchmarks.cores import placed
from benchmarks.instructions import count_sides
from benchmarks.measure import Comparison, instructions_of
from benchmarks.peers import peer, wire
from benchmarks.sides import Side, take_sides
from benchmarks.yardsticks import bare_client

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from benchmarks.measure import Plan
    from benchmarks.sides import Work

__all__ = ["SIDES", "run"]

QUESTIONS, SESSIONS = 400, 40
"""In a round of each side."""

COUNTED = 50
"""Where instructions are counted."""

SMARTCAM, BARE = "smartcam", "bare protocol"
SESSION, BARE_SESSION = "smartcam, session", "bare session"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure both."""
    cases = {
        "await query_application()": (SMARTCAM, BARE, QUESTIONS),
        "connect() and close, the dialect given": (SESSION, BARE_SESSION, SESSIONS),
    }
    for case, (ours, theirs, count) in cases.items():
        with placed(apart=False), peer("trigger", "together") as camera:
            ports = {ours: camera, theirs: camera}
            counts = count_sides(plan, "questions", ports, COUNTED)
            places = {name: (SIDES[name], port) for name, port in ports.items()}
            series = asyncio.run(take_sides(plan, places, plan.operations(count, least=5)))
        yield Comparison(
            "questions",
            f"{case}, one core",
            series[ours],
            series[theirs],
            instructions=instructions_of(counts, ours, theirs),
        )


@asynccontextmanager
async def _smartcam(port: int) -> AsyncIterator[Work]:
    async with smartcam.connect(_url(port)) as camera:

        async def work(count: int) -> None:
            for _ in range(count):
                await camera.query_application()

        yield work


@asynccontextmanager
async def _bare(port: int) -> AsyncIterator[Work]:
    bare = await bare_client(port)

    async def work(count: int) -> None:
        for _ in range(count):
            await bare.ask(QUERY, wire.QUERY)

    yield work
    bare.transport.close()


@asynccontextmanager
async def _session(port: int) -> AsyncIterator[Work]:
    async def work(count: int) -> None:
        for _ in range(count):
            async with smartcam.connect(_url(port)):
                pass

    yield work


@asynccontextmanager
async def _bare_session(port: int) -> AsyncIterator[Work]:
    async def work(count: int) -> None:
        for _ in range(count):
            bare = await bare_client(port)
            bare.transport.close()
            await asyncio.sleep(0)

    yield work


def _url(port: int) -> str:
    return f"bvs://127.0.0.1:{port}?dialect=handbook"


SIDES: dict[str, Side] = {
    SMARTCAM: _smartcam,
    BARE: _bare,
    SESSION: _session,
    BARE_SESSION: _bare_session,
}
"""By name; ``python -m benchmarks.sides questions NAME PORT OPERATIONS`` has one alone."""

QUERY = wire.frame(wire.QUERY)
