"""Emulated cameras of each make for smartcam's suite of camera tests."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any

from smartcam.emulator import LineCamera
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from smartcam.testing import CameraKind, LiveCamera
from tests.makes.inside import read_chunks

IV3_NUMBERS = "count: uint32, passed: bool, tool: uint16, tool_passed: bool, n: uint32"
NUMBERS = [{"n": number} for number in range(10_000)]


def parse_pictures(data: bytes) -> int:
    """Return the number of pictures in an ifm sensor's answer."""
    return len(read_chunks(data))


@dataclass
class LiveMake(LiveCamera):
    """An emulated camera of a make."""

    emulator: Any
    query: str

    @property
    def url(self) -> str:
        return f"{self.emulator.url}?{self.query}"

    @property
    def url_without_dialect(self) -> str:
        query = "&".join(one for one in self.query.split("&") if "dialect" not in one)
        return f"{self.emulator.url}?{query}"

    @property
    def has_session(self) -> bool:
        return bool(self.emulator.has_session)

    def trigger(self) -> None:
        self.emulator.device.trigger()

    async def restart(self) -> None:
        await self.emulator.stop()
        await self.emulator.start()

    async def kill(self) -> None:
        await self.emulator.stop()


@dataclass
class LiveIfm(LiveMake):
    @property
    def inspects(self) -> bool:
        return bool(self.emulator.busy)

    def switch(self, application: int) -> None:
        self.emulator.device.switch_application(application)


def kind(name: str, make: Callable[[], LineCamera], query: str, **fields: Any) -> CameraKind:
    live_class = LiveIfm if "ifm" in name else LiveMake

    @contextlib.asynccontextmanager
    async def open_camera() -> AsyncIterator[LiveCamera]:
        async with make() as emulator:
            yield live_class(emulator, query)

    return CameraKind(name=name, open=open_camera, exclusive=False, silent_request=None, **fields)


def ifm(version: int) -> EmulatedIfm:
    return EmulatedIfm(
        applications=[
            {"id": LiveCamera.COUNTER, "processing_time": 0.0},
            {"id": LiveCamera.OTHER, "processing_time": 0.0},
            {"id": LiveCamera.SLOW, "processing_time": LiveCamera.SLOW_TIME},
            {"id": LiveCamera.FREE, "processing_time": 0.005, "trigger": "continuous"},
        ],
        defaults={"parts": NUMBERS},
        version=version,
    )


IFM_KINDS = (
    kind(
        "ifm v3",
        lambda: ifm(3),
        "dialect=v3",
        applications=frozenset(
            {LiveCamera.COUNTER, LiveCamera.OTHER, LiveCamera.SLOW, LiveCamera.FREE}
        ),
        numbers_with_sequence="n: uint32",
        raw_request="S?",
        foreign_request=0x30,
    ),
    kind(
        "ifm v3, asynchronous triggers",
        lambda: ifm(3),
        "dialect=v3&trigger=async",
        applications=frozenset(
            {LiveCamera.COUNTER, LiveCamera.OTHER, LiveCamera.SLOW, LiveCamera.FREE}
        ),
        numbers_with_sequence="n: uint32",
        raw_request="S?",
        foreign_request=0x30,
    ),
    kind(
        "ifm v4",
        lambda: ifm(4),
        "dialect=v4",
        applications=frozenset({LiveCamera.COUNTER, LiveCamera.OTHER, LiveCamera.SLOW}),
        numbers_with_sequence="n: uint32",
        raw_request="S?",
        foreign_request=0x30,
    ),
)
IV3_KINDS = (
    kind(
        "IV3",
        lambda: EmulatedIv3(
            programs=(LiveCamera.COUNTER, LiveCamera.OTHER),
            parts=[(n,) for n in range(10_000)],
            processing_time=0.0,
        ),
        "dialect=lines",
        applications=frozenset({LiveCamera.COUNTER, LiveCamera.OTHER}),
        numbers=IV3_NUMBERS,
        numbers_with_sequence=IV3_NUMBERS,
        raw_request="RT",
        foreign_request=0x30,
        has_zero=True,
    ),
)
SR_KINDS = (
    kind(
        "SR",
        lambda: EmulatedSr(codes=list(map(str, range(10_000))), reading_time=0.0),
        f"dialect=lines&bank={LiveCamera.COUNTER}",
        applications=frozenset({LiveCamera.COUNTER}),
        numbers="read: bool, n: uint32",
        numbers_with_sequence="read: bool, n: uint32",
        raw_request="NUM",
        foreign_request=0x30,
        has_zero=True,
    ),
)
