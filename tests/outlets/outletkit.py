"""Results for tests of outlets, and an outlet whose far end is a list."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

from smartcam.exceptions import OutletError
from smartcam.models import Result
from smartcam.outlets import Outlet, OutletEntry, OutletSettings


def result(
    number: int, camera: str = "line1/cam1", value: Any = None, application: int = 1
) -> Result[Any]:
    """Return a result."""
    return Result(
        camera,
        application,
        None,
        number,
        None,
        datetime.now(UTC),
        None,
        b"\1" * 20,
        {"n": number} if value is None else value,
    )


def numbers(entries: Sequence[OutletEntry]) -> list[int]:
    """Return the values of the results among entries."""
    return [json.loads(one.body)["value"]["n"] for one in entries if one.kind == "result"]


class ListSettings(OutletSettings):
    """No settings of its own."""


class FarEnd:
    """A far end in this process: it may be away, stalled, or refuse."""

    def __init__(self) -> None:
        self.there = True
        self.stalled = False
        self.refuses: Callable[[OutletEntry], bool] = lambda _: False
        self.taken: list[OutletEntry] = []
        self.come = asyncio.Event()


class ListOutlet(Outlet[ListSettings]):
    """Delivers to a list."""

    settings_class = ListSettings
    far: FarEnd

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Append the entries."""
        far = type(self).far
        if far.stalled:
            await asyncio.Event().wait()
        if not far.there:
            raise OutletError("it is away")
        far.taken.extend(entries)
        far.come.set()


async def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something holds."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.01)
