"""Large containers: 1 kB to 1 MB, in segments of an Ethernet frame and of 64 kB.

The yardstick is ``loop.sock_recv_into`` on a buffer that was made before, which neither looks at
the bytes nor keeps them. smartcam's bytes are a ``Result`` with a copy of its own. They come one
every half millisecond, and the largest also flat out. CPU time for each container.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import (
    Comparison,
    Cost,
    Curve,
    Goal,
    Plan,
    Series,
    cpu_microseconds,
    take_turns_awaiting,
)
from benchmarks.peers import peer, wire

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["run"]

SEGMENTS = {1460: "1,460 bytes", 65536: "64 KiB"}
SIZES = (1_000, 4_000, 16_000, 1 << 16, 1 << 18, 1 << 20)
BYTES = 24_000_000
"""In a round of each side, at most 300 containers."""

FRONT = wire.HEADER.size + 4
SMARTCAM, RECV_INTO = "smartcam", "sock_recv_into"


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure each size in each kind of segment."""
    with peer("large") as port:
        for segment, words in SEGMENTS.items():
            found = {size: asyncio.run(_measure(plan, port, size, segment)) for size in SIZES}
            for size, series in found.items():
                goal = Goal("at least", 0.8) if size >= 1 << 16 else None
                yield Comparison(
                    "large",
                    f"{size:,} bytes in segments of {words}",
                    series[SMARTCAM],
                    series[RECV_INTO],
                    how="speed",
                    goal=goal,
                )
            yield _growth(found, words)
            yield Curve(
                "large",
                f"One container, in segments of {words}",
                "bytes",
                "us CPU",
                {
                    name: [(size, series[name].median) for size, series in found.items()]
                    for name in (SMARTCAM, RECV_INTO)
                },
            )
    yield _flat_out(plan)


def _flat_out(plan: Plan) -> Comparison:
    size, segment = SIZES[-1], max(SEGMENTS)
    with peer("large", "flat") as port:
        series = asyncio.run(_measure(plan, port, size, segment))
    return Comparison(
        "large",
        f"{size:,} bytes flat out",
        series[SMARTCAM],
        series[RECV_INTO],
        how="speed",
        goal=Goal("at least", 0.85),
    )


def _growth(found: dict[int, dict[str, Series]], words: str) -> Comparison:
    """Compare how many times more the largest costs than the smallest."""
    least, most = found[SIZES[0]], found[SIZES[-1]]

    def grown(name: str) -> Series:
        pairs = zip(most[name].values, least[name].values, strict=True)
        return Series(name, "x", [large / small for large, small in pairs])

    case = f"growth from {SIZES[0]:,} to {SIZES[-1]:,} bytes, segments of {words}"
    goal = Goal("at most", 1.5)
    return Comparison("large", case, grown(SMARTCAM), grown(RECV_INTO), goal=goal)


async def _measure(plan: Plan, port: int, size: int, segment: int) -> dict[str, Series]:
    count = plan.operations(min(300, BYTES // size), least=2)
    body = struct.pack("<III", size, segment, count)
    total = FRONT + size
    loop = asyncio.get_running_loop()
    bare = socket.socket()
    bare.setblocking(False)
    await loop.sock_connect(bare, ("127.0.0.1", port))
    buffer = memoryview(bytearray(total))
    url = f"bvs://127.0.0.1:{port}?dialect=handbook"

    async def smartcam_side() -> Cost:
        results = camera.results()
        begin = time.process_time()
        await camera.request(wire.TRIGGER, body, answered=False)
        for _ in range(count):
            result = await anext(results)
        cost = cpu_microseconds(begin, count)
        assert result.raw == bytes(range(256)) * (size // 256) + bytes(size % 256)
        assert results.statistics().taken == count
        return cost

    async def recv_into_side() -> Cost:
        request = wire.frame(wire.TRIGGER, body)
        begin = time.process_time()
        await loop.sock_sendall(bare, request)
        for _ in range(count):
            received = 0
            while received < total:
                received += await loop.sock_recv_into(bare, buffer[received:])
        return cpu_microseconds(begin, count)

    async with smartcam.connect(url, max_length=2 << 20) as camera:
        sides = {SMARTCAM: smartcam_side, RECV_INTO: recv_into_side}
        series = await take_turns_awaiting(plan, sides)
    bare.close()
    return series
