"""The cameras that the suite of ``smartcam.testing`` runs against here: one row of a table each."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, Literal

from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.testing import CameraKind, LiveCamera

FREE_RATE = 200.0
"""Runs per second of ``FREE``."""

# ---------------------------------------------------------------------- BVS

_RUN = {"layout": "n: uint32 @sequence", "generator": "sequence", "load_time": 0.0}
_APPLICATIONS: list[dict[str, Any]] = [
    {**_RUN, "id": LiveCamera.COUNTER, "processing_time": 0.0},
    {**_RUN, "id": LiveCamera.OTHER, "processing_time": 0.0},
    {**_RUN, "id": LiveCamera.SLOW, "processing_time": LiveCamera.SLOW_TIME},
    {
        "id": LiveCamera.ECHO,
        "layout": "n: uint32",
        "input": "n: uint32",
        "generator": "input",
        "load_time": 0.0,
        "processing_time": 0.0,
    },
    {**_RUN, "id": LiveCamera.FREE, "rate": FREE_RATE, "processing_time": 0.0},
]


@dataclass
class _BvsSite(LiveCamera):
    """An emulated BVS camera."""

    emulator: EmulatedCamera

    @property
    def url(self) -> str:
        return self.emulator.url

    @property
    def has_session(self) -> bool:
        return self.emulator.has_session

    @property
    def inspects(self) -> bool:
        return self.emulator.device.processing

    def trigger(self) -> None:
        self.emulator.device.trigger()

    def switch(self, application: int) -> None:
        self.emulator.device.switch_application(application, running=True)

    async def restart(self) -> None:
        self.emulator.device.reboot(0.0)
        self.emulator.device.start()

    async def kill(self) -> None:
        await self.emulator.stop()


def _bvs(
    name: str,
    transport: Literal["tcp", "udp"],
    dialect: str,
    quirks: dict[str, Any],
    *,
    alone: bool = False,
) -> CameraKind:
    """Return a kind of camera; ``alone``: it has ``COUNTER`` and nothing else."""
    applications = _APPLICATIONS[:1] if alone else _APPLICATIONS

    @contextlib.asynccontextmanager
    async def put_up() -> AsyncIterator[LiveCamera]:
        async with EmulatedCamera(
            applications,
            transport=transport,
            dialect=dialect,
            quirks=quirks,
            running=True,
            builtins=False,
        ) as emulator:
            yield _BvsSite(emulator)

    kind = CameraKind(name=f"{name} over {transport}", open=put_up, datagrams=transport == "udp")
    ids = frozenset(one["id"] for one in applications)
    return dataclasses.replace(kind, applications=ids)


# ---------------------------------------------------------------------- In-Sight

_JOB = {"load_time": 0.0, "acquisition_time": 0.0, "processing_time": 0.0}


def _runs_before(run: int) -> int:
    return run - 1  # the cells of a job that has not run yet are those of its run 0


_JOBS: list[dict[str, Any]] = [
    {**_JOB, "file": f"{LiveCamera.COUNTER}counter.job", "cells": {"A2": _runs_before}},
    {**_JOB, "file": f"{LiveCamera.OTHER}other.job", "cells": {"A2": _runs_before}},
    {
        **_JOB,
        "file": f"{LiveCamera.SLOW}slow.job",
        "cells": {"A2": _runs_before},
        "processing_time": LiveCamera.SLOW_TIME,
    },
    {
        **_JOB,
        "file": f"{LiveCamera.FREE}free.job",
        "cells": {"A2": _runs_before},
        "rate": FREE_RATE,
    },
]


@dataclass
class _InSightSite(LiveCamera):
    """An emulated In-Sight camera."""

    emulator: EmulatedInSight

    @property
    def url(self) -> str:
        return f"{self.emulator.url}?dialect=native&cells=A2"

    @property
    def url_without_dialect(self) -> str:
        return f"{self.emulator.url}?cells=A2"

    @property
    def has_session(self) -> bool:
        return bool(self.emulator.sessions)

    @property
    def inspects(self) -> bool:
        return self.emulator.device.busy

    def trigger(self) -> None:
        self.emulator.trigger()

    def switch(self, application: int) -> None:
        self.emulator.load(application)

    async def restart(self) -> None:
        await self.emulator.stop()
        await self.emulator.start()

    async def kill(self) -> None:
        await self.emulator.stop()


@contextlib.asynccontextmanager
async def _in_sight() -> AsyncIterator[LiveCamera]:
    async with EmulatedInSight(_JOBS, online=True) as emulator:
        yield _InSightSite(emulator)


# ---------------------------------------------------------------------- the table

_DIALECTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("handbook", "handbook", {}),
    ("thesis", "thesis", {}),
    ("b16", "b16", {}),
    ("b16 with code", "b16", {"code": True}),
    ("bid", "bid", {}),
    ("bid with push", "bid", {"push_status": True}),
)
_TRANSPORTS: tuple[Literal["tcp", "udp"], ...] = ("tcp", "udp")

BVS_WORLDS = tuple(
    _bvs(name, transport, dialect, quirks)
    for name, dialect, quirks in _DIALECTS
    for transport in _TRANSPORTS
)
LONELY_WORLDS = (_bvs("one application", "tcp", "handbook", {}, alone=True),)
INSIGHT_WORLDS = (
    CameraKind(
        name="In-Sight native mode",
        open=_in_sight,
        numbers_with_sequence="n: uint32",
        raw_request="GJ",
        foreign_request=0x30,
        silent_request=None,
        exclusive=False,
        has_zero=True,
    ),
)
