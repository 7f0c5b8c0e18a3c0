"""The cameras that the conformance checks run against: one row of a table each.

A world says how to put a camera up and what stands on it; a site is the camera while it is up. Both
know nothing of the checks, so that a camera of another protocol is one more row. What the camera
can do in its dialect is asked of the client: ``camera.capabilities``.

On each camera stand the same applications, by their ids:

* ``COUNTER`` and ``OTHER`` wait for a trigger and send the number of the run at once;
* ``SLOW`` does so after ``SLOW_TIME``;
* ``ECHO`` sends the number that it was given as input data, where the camera takes any;
* ``FREE`` runs free and sends the number of the run, where the camera sends unasked.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from smartcam.emulator import EmulatedCamera
from smartcam.emulator.insight import EmulatedInSight

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from contextlib import AbstractAsyncContextManager

__all__ = [
    "COUNTER",
    "ECHO",
    "FREE",
    "NOBODYS",
    "OTHER",
    "SLOW",
    "SLOW_TIME",
    "WORLDS",
    "Site",
    "World",
]

COUNTER, OTHER, SLOW, ECHO, FREE = 7, 3, 4, 5, 9
NOBODYS = 99
"""No application has this id."""

SLOW_TIME = 0.15
"""Seconds that an inspection of ``SLOW`` takes."""

FREE_RATE = 200.0
"""Runs per second of ``FREE``."""


class Site(Protocol):
    """A camera that is up, with ``COUNTER`` active and ready to run."""

    @property
    def url(self) -> str:
        """Its URL, with everything pinned that can be."""
        ...

    @property
    def unpinned(self) -> str:
        """The same without what a client can find out."""
        ...

    @property
    def has_session(self) -> bool:
        """Whether a client has the camera."""
        ...

    @property
    def inspects(self) -> bool:
        """Whether an inspection is under way."""
        ...

    def trigger(self) -> None:
        """Trigger by the digital input."""
        ...

    def switch(self, application: int) -> None:
        """Load and run another application, as an operator does."""
        ...

    async def restart(self) -> None:
        """Lose every client and be there again at once, as it was at first."""
        ...

    async def kill(self) -> None:
        """Be gone, and stay so."""
        ...


@dataclass(frozen=True, kw_only=True)
class World:
    """One kind of camera.

    Attributes:
        name: for people.
        open: puts one up.
        numbers: how to interpret what the applications send: a record whose field ``n`` is the
            number.
        numbers_with_sequence: the same with the number marked, where it can be set.
        raw_request: id of a request that is answered by something.
        foreign_request: an id of another kind than the protocol's.
        datagrams: a message may be lost, and nobody is told that the camera is gone.
        exclusive: a second client takes the camera from the first.
        has_zero: an application may have the id 0.
    """

    name: str
    open: Callable[[], AbstractAsyncContextManager[Site]]
    numbers: str = "n: uint32"
    numbers_with_sequence: str = "n: uint32 @sequence"
    raw_request: int | str = 0x30
    foreign_request: int | str = "text"
    datagrams: bool = False
    exclusive: bool = True
    has_zero: bool = False

    def __str__(self) -> str:
        return self.name


# ---------------------------------------------------------------------- BVS

_RUN = {"layout": "n: uint32 @sequence", "generator": "sequence", "load_time": 0.0}
_APPLICATIONS: list[dict[str, Any]] = [
    {**_RUN, "id": COUNTER, "processing_time": 0.0},
    {**_RUN, "id": OTHER, "processing_time": 0.0},
    {**_RUN, "id": SLOW, "processing_time": SLOW_TIME},
    {
        "id": ECHO,
        "layout": "n: uint32",
        "input": "n: uint32",
        "generator": "input",
        "load_time": 0.0,
        "processing_time": 0.0,
    },
    {**_RUN, "id": FREE, "rate": FREE_RATE, "processing_time": 0.0},
]


@dataclass
class _BvsSite:
    """An emulated BVS camera."""

    emulator: EmulatedCamera

    @property
    def url(self) -> str:
        return self.emulator.url

    @property
    def unpinned(self) -> str:
        return self.url.partition("?")[0]

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
    name: str, transport: Literal["tcp", "udp"], dialect: str, quirks: dict[str, Any]
) -> World:
    @contextlib.asynccontextmanager
    async def put_up() -> AsyncIterator[Site]:
        async with EmulatedCamera(
            _APPLICATIONS,
            transport=transport,
            dialect=dialect,
            quirks=quirks,
            running=True,
            builtins=False,
        ) as emulator:
            yield _BvsSite(emulator)

    return World(name=f"{name} over {transport}", open=put_up, datagrams=transport == "udp")


# ---------------------------------------------------------------------- In-Sight

_JOB = {"load_time": 0.0, "acquisition_time": 0.0, "processing_time": 0.0}


def _runs_before(run: int) -> int:
    return run - 1  # the cells of a job that has not run yet are those of its run 0


_JOBS: list[dict[str, Any]] = [
    {**_JOB, "file": f"{COUNTER}counter.job", "cells": {"A2": _runs_before}},
    {**_JOB, "file": f"{OTHER}other.job", "cells": {"A2": _runs_before}},
    {
        **_JOB,
        "file": f"{SLOW}slow.job",
        "cells": {"A2": _runs_before},
        "processing_time": SLOW_TIME,
    },
    {**_JOB, "file": f"{FREE}free.job", "cells": {"A2": _runs_before}, "rate": FREE_RATE},
]


@dataclass
class _InSightSite:
    """An emulated In-Sight camera."""

    emulator: EmulatedInSight

    @property
    def url(self) -> str:
        return f"{self.emulator.url}?dialect=native&cells=A2"

    @property
    def unpinned(self) -> str:
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
async def _in_sight() -> AsyncIterator[Site]:
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

WORLDS: tuple[World, ...] = (
    *(
        _bvs(name, transport, dialect, quirks)
        for name, dialect, quirks in _DIALECTS
        for transport in _TRANSPORTS
    ),
    World(
        name="In-Sight native mode",
        open=_in_sight,
        numbers_with_sequence="n: uint32",
        raw_request="GJ",
        foreign_request=0x30,
        exclusive=False,
        has_zero=True,
    ),
)
"""The table; another protocol's cameras are further rows."""
