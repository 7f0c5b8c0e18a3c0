"""Ask a fleet's agents for the counts of their outlets, and for stored results, for its page."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, ClassVar, Final

from pydantic import BaseModel, ConfigDict, Field

from smartcam.exceptions import ConfigurationError, ConnectionClosedError
from smartcam.web._errors import RefusedError

if TYPE_CHECKING:
    from smartcam.fleet import Fleet
    from smartcam.fleet._inside import ReportedOutlet, ReportedStore

ANSWER_AGE: Final = 2.0
"""Seconds for which the agents' last answer is reused, for all viewers of the page."""

MAX_STORE_QUESTIONS: Final = 4
"""Largest number of questions to stores that may run at the same time."""


class StoredQuery(BaseModel):
    """The query of a page for stored results."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    hours: float = Field(default=8.0, gt=0, le=10 * 366 * 24)
    failed: bool = False
    camera: str = Field(default="**", max_length=200)
    limit: int = Field(default=200, ge=0, le=1000)


class OutletsView:
    """Asks a fleet's agents about their outlets.

    Args:
        fleet: an open fleet, which the caller closes.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._counts: list[ReportedOutlet] = []
        self._asked_at = -ANSWER_AGE
        self._lock = asyncio.Lock()
        self._store_questions = asyncio.Semaphore(MAX_STORE_QUESTIONS)

    async def counts(self) -> list[ReportedOutlet]:
        """Return the counts of all outlets, at most :data:`ANSWER_AGE` seconds old.

        Raises:
            RefusedError: 503, the fleet is closed.
        """
        loop = asyncio.get_running_loop()
        async with self._lock:
            if loop.time() - self._asked_at >= ANSWER_AGE:
                try:
                    self._counts = await self._fleet.outlets()
                except ConnectionClosedError as exc:
                    raise RefusedError(503, str(exc)[:300], expected="an open fleet") from exc
                self._asked_at = loop.time()
            return self._counts

    async def stored(self, query: StoredQuery) -> list[ReportedStore]:
        """Return the stored results that match a query, from all agents' stores.

        Raises:
            RefusedError: 422, the pattern is not valid; 503, the fleet is closed.
        """
        since = datetime.now(UTC) - timedelta(hours=query.hours)
        async with self._store_questions:
            try:
                return await self._fleet.stored_results(
                    query.camera, since=since, only_failed=query.failed, max_rows=query.limit
                )
            except ConfigurationError as exc:
                raise RefusedError(422, str(exc)[:300], expected="a pattern of cameras") from exc
            except ConnectionClosedError as exc:
                raise RefusedError(503, str(exc)[:300], expected="an open fleet") from exc
