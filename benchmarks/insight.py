"""A picture of an In-Sight camera: 1 MB as lines of hexadecimal digits, with a checksum.

The camera is an emulated one in a process of its own, which is not counted. The yardstick knows how
long the answer is: it reads all of it at once, takes the line ends out, makes bytes of the digits
and checks their sum, each in one call. CPU time for each picture.
"""

from __future__ import annotations

import asyncio
import binascii
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import smartcam
from benchmarks.measure import Comparison, Goal, Plan
from benchmarks.peers import peer
from benchmarks.sides import Side, take_sides

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable

    from benchmarks.measure import Series
    from benchmarks.sides import Work

__all__ = ["SIDES", "run"]

PICTURES = 10
"""In a round of each side."""

SMARTCAM, BARE = "smartcam", "fromhex, crc_hqx"

END = b"\r\n"


def run(plan: Plan) -> Iterable[Comparison]:
    """Measure pictures, one after the other."""
    with peer("insight") as port:
        series = asyncio.run(_measure(plan, port))
    goal = Goal("at most", 20, "ms")
    sides = series[SMARTCAM], series[BARE]
    yield Comparison("insight", "read_image(), 1 MB", *sides, "alone", goal)
    yield Comparison("insight", "read_image(), 1 MB", *sides)


async def _measure(plan: Plan, port: int) -> dict[str, Series]:
    sides = {name: (side, port) for name, side in SIDES.items()}
    return await take_sides(plan, sides, plan.operations(PICTURES), unit="ms")


@asynccontextmanager
async def _smartcam(port: int) -> AsyncIterator[Work]:
    async with smartcam.connect(f"insight://127.0.0.1:{port}") as camera:

        async def work(count: int) -> None:
            for _ in range(count):
                picture = await camera.read_image()
            assert picture[:2] == b"BM"
            assert len(picture) > 1_000_000

        yield work


@asynccontextmanager
async def _bare(port: int) -> AsyncIterator[Work]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 22)
    await reader.readuntil(b"User: ")
    writer.write(b"admin" + END)
    await reader.readuntil(b"Password: ")
    writer.write(END)
    await reader.readuntil(b"User Logged In" + END)
    length = await _length(reader, writer)

    async def work(count: int) -> None:
        for _ in range(count):
            writer.write(b"RI" + END)
            _, _, *lines, told, _ = (await reader.readexactly(length)).split(END)
            digits = b"".join(lines)
            picture = bytes.fromhex(digits.decode("ascii"))
            assert int(told, 16) == binascii.crc_hqx(digits, 0)
        assert len(picture) > 1_000_000

    yield work
    writer.close()


async def _length(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> int:
    """Return how long the answer is: code, number of digits, the digits, their sum."""
    writer.write(b"RI" + END)
    lines = [await reader.readline() for _ in range(2)]
    left = int(lines[1])
    while left:
        lines.append(await reader.readline())
        left -= len(lines[-1]) - len(END)
    lines.append(await reader.readline())
    return sum(map(len, lines))


SIDES: dict[str, Side] = {SMARTCAM: _smartcam, BARE: _bare}
"""By name; ``python -m benchmarks.sides insight NAME PORT OPERATIONS`` has one alone."""
