"""Answer programs' questions about an agent's outlets: counts of results, and stored results."""

from __future__ import annotations

import asyncio
import json
import logging
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from smartcam.exceptions import ConfigurationError, LocalProtocolError, SmartCamError
from smartcam.fleet._bus.address import check_pattern
from smartcam.fleet._bus.bus import always
from smartcam.fleet._json.json_services import request_fields
from smartcam.fleet._json.topics import as_json
from smartcam.fleet._program.reading import error_fields
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle
    from smartcam.fleet._bus.keys import Keys
    from smartcam.outlets._inside import OutletState

logger: logging.Logger = logging.getLogger("smartcam.fleet")

MAX_STORE_QUESTIONS = 4
"""Largest number of running questions to the stores of one agent; each question needs a thread."""

MAX_STORED_ROWS = 1000
"""Largest number of rows of a store in one answer."""

MAX_ROWS_BYTES = 1 << 23
"""Largest number of bytes of rows in one answer; the oldest rows beyond it are left out."""

ROW_BYTES = 300
"""Approximate number of bytes of a row without its value and its error."""


class ReportedOutlet(NamedTuple):
    """An outlet's counts from its agent: ``results == delivered + spooled + sum of dropped``.

    Attributes:
        agent: name of the agent.
        outlet: name of the outlet.
        results: number of results and errors that came.
        delivered: number of delivered results and errors.
        spooled: number of results and errors that wait for delivery.
        dropped: numbers of dropped results and errors, by reason.
        trouble: reason why nothing is delivered or spooled now; "" if there is no trouble.
    """

    agent: str
    outlet: str
    results: int
    delivered: int
    spooled: int
    dropped: dict[str, int]
    trouble: str


class ReportedStore(NamedTuple):
    """The answer of a store of results, from its agent.

    Attributes:
        agent: name of the agent.
        outlet: name of the outlet that writes the store; "" if the agent could not answer.
        rows: requested rows, the oldest first, with the columns of the store's table ``results`` by
            their names.
        total: number of results, errors and gaps that match the request, also those not in
            ``rows``.
        failed: number of errors, gaps, and results that did not pass.
        errors: number of errors.
        gaps: number of gaps.
        lost: number of lost results in the gaps.
        at_least: True if ``lost`` is a minimum: more results may be lost.
        error: reason why the store could not be read; "" if it was read.
    """

    agent: str
    outlet: str
    rows: list[dict[str, Any]]
    total: int = 0
    failed: int = 0
    errors: int = 0
    gaps: int = 0
    lost: int = 0
    at_least: bool = False
    error: str = ""


def _check_time_text(text: str) -> str:
    try:
        aware = datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        aware = False
    if not aware:
        raise ValueError("expected a time with its zone, such as 2030-01-31T06:00:00+00:00")
    return text


def _check_pattern_text(text: str) -> str:
    try:
        return check_pattern(text)
    except ConfigurationError as exc:
        raise ValueError(str(exc)) from exc


class StoredRequest(BaseModel):
    """A question to stores of results."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True, strict=True)

    since: Annotated[str, Field(max_length=100), AfterValidator(_check_time_text)] | None = None
    only_failed: bool = False
    camera: Annotated[str, Field(max_length=200), AfterValidator(_check_pattern_text)] = "**"
    max_rows: Annotated[int, Field(ge=0, le=MAX_STORED_ROWS)] = 100


class OutletService:
    """Answers programs' questions about an agent's outlets.

    Args:
        agent: the agent, whose tasks do the work.
        bus: the agent's connection to the bus.
        keys: keys of the fleet.
        states: function that returns the states of the outlets, by name.
        read_stores: function that returns the answers of the stores, by the outlet's name.
    """

    def __init__(
        self,
        agent: Agent,
        bus: Bus,
        keys: Keys,
        states: Callable[[], Mapping[str, OutletState]],
        read_stores: Callable[[StoredRequest], Awaitable[dict[str, dict[str, Any]]]],
    ) -> None:
        self._agent, self._keys = agent, keys
        self._states, self._read_stored = states, read_stores
        self._running_count = 0
        pattern = keys.outlets(agent.name, "*")
        self._handle: Handle = bus.answer(pattern, self._on_question, low_priority=always)

    def close(self) -> None:
        """Stop answering."""
        self._handle.close()

    def _on_question(self, question: BusQuestion) -> None:
        name = question.key.rpartition("/")[2]
        if name == "counts":
            counts = {
                name: {**state.counts.fields(), "trouble": state.trouble}
                for name, state in self._states().items()
            }
            self._reply(question, name, {"error": "", "outlets": counts})
        elif name != "results":
            error = ConfigurationError(f"outlets: expected counts or results, got {name!r:.80}")
            self._reply(question, name, error_fields(error))
        elif self._running_count >= MAX_STORE_QUESTIONS:
            text = f"{self._running_count} questions to the stores are under way"
            self._reply(question, name, error_fields(LocalProtocolError(text)))
        else:
            self._running_count += 1
            self._agent.start_task(self._answer(question), "smartcam.fleet.outlets")

    async def _answer(self, question: BusQuestion) -> None:
        outcome = error_fields(SmartCamError("the agent ends"))
        try:
            fields, error = request_fields(question.payload)
            if error is not None:
                raise error
            request = validated(StoredRequest, fields or {}, "outlets: results")
            stored = await self._read_stored(request)
            outcome = {
                "error": "",
                "stores": {name: _newest_rows(value) for name, value in stored.items()},
            }
        except SmartCamError as exc:
            outcome = error_fields(exc)
        finally:
            self._running_count -= 1
            self._reply(question, "results", outcome)

    def _reply(self, question: BusQuestion, name: str, fields: dict[str, Any]) -> None:
        agent = self._agent.name
        key = question.key if "*" not in question.key else self._keys.outlets(agent, name)
        question.reply(key, as_json({"agent": agent, **fields}))
        question.close()


def _newest_rows(store: dict[str, Any]) -> dict[str, Any]:
    """Return a store's answer with its newest rows, up to MAX_ROWS_BYTES."""
    rows, size = list[dict[str, Any]](), 0
    for row in reversed(store["rows"]):
        size += ROW_BYTES + len(row["value"] or "") + len(row["error"] or "")
        if size > MAX_ROWS_BYTES:
            break
        rows.append(row)
    return {**store, "rows": rows[::-1]}


T = TypeVar("T", ReportedOutlet, ReportedStore)


async def ask_outlets(bus: Bus, keys: Keys, timeout: float) -> list[ReportedOutlet]:
    """Return the counts of all agents' outlets that came within ``timeout`` seconds."""
    return await _ask(bus, keys.outlets("*", "counts"), b"", timeout, _read_counts)


async def ask_stores(
    bus: Bus, keys: Keys, request: StoredRequest, timeout: float
) -> list[ReportedStore]:
    """Return the answers of all agents' stores that came within ``timeout`` seconds."""
    payload = request.model_dump_json().encode()
    return await _ask(bus, keys.outlets("*", "results"), payload, timeout, _read_stores)


async def _ask(
    bus: Bus, key: str, payload: bytes, timeout: float, read: Callable[[bytes], list[T]]
) -> list[T]:
    answers: list[T] = []
    for _, answer in await bus.ask(key, payload, timeout):
        try:
            answers += await asyncio.to_thread(read, answer)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as exc:
            logger.warning("%s ! an agent's answer cannot be read: %r", key, exc)
    return sorted(answers, key=lambda reported: reported[:2])


def _read_counts(answer: bytes) -> list[ReportedOutlet]:
    report: Any = json.loads(answer)
    return [
        ReportedOutlet(
            str(report["agent"]),
            str(name),
            int(counts["results"]),
            int(counts["delivered"]),
            int(counts["spooled"]),
            {str(reason): int(count) for reason, count in counts["dropped"].items()},
            str(counts["trouble"]),
        )
        for name, counts in report["outlets"].items()
    ]


def _read_stores(answer: bytes) -> list[ReportedStore]:
    report: Any = json.loads(answer)
    agent = str(report["agent"])
    if report["error"]:
        return [ReportedStore(agent, "", [], error=str(report["error"]))]
    return [
        ReportedStore(
            agent,
            str(name),
            [dict(row) for row in store["rows"]],
            total=int(store["total"]),
            failed=int(store["failed"]),
            errors=int(store["errors"]),
            gaps=int(store["gaps"]),
            lost=int(store["lost"]),
            at_least=bool(store["at_least"]),
        )
        for name, store in report["stores"].items()
    ]
