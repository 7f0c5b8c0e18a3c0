"""Putting a camera through the checks and questions, one after the other."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from smartcam.conformance.camera.items import ITEMS
from smartcam.conformance.camera.raw_client import EndedError
from smartcam.conformance.camera.report import Report
from smartcam.conformance.camera.results import (
    Differs,
    Finding,
    Item,
    NotObserved,
    Outcome,
    Question,
    Undescribed,
)
from smartcam.conformance.camera.session_under_test import Bench
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.conformance.camera.options import Plan

__all__ = ["judge", "judge_item"]

CONNECT_CHECK = "connect-is-answered"
"""The check that says so where there is no camera at all; the others are not observed then."""


def judge(plan: Plan, names: Iterable[str] | None = None) -> Report:
    """Put a camera through all checks and questions, or some, and return the report.

    It blocks, for a minute or two with the default times: do not call it in an event loop's thread.
    The camera is taken from whoever has it. Application and run state are put back, also where an
    exception, such as Ctrl-C, ends it.

    Args:
        plan: what is asked for.
        names: of the checks and questions; None for all.

    Raises:
        ConfigurationError: the address cannot work, or a name is unknown.
    """
    wanted = None if names is None else set(names)
    unknown = sorted((wanted or set()) - {item.name for item in ITEMS})
    if unknown:
        raise ConfigurationError(f"there is no check or question {unknown[0]!r}")
    bench = Bench(plan)
    report = Report(bench)
    try:
        for item in ITEMS:
            if wanted is None or item.name in wanted:
                report.add(judge_item(bench, item))
    finally:
        bench.restore(again=True)
    return report


def judge_item(bench: Bench, item: Item) -> Finding:
    """Do one check or ask one question; what it changed is put back afterwards.

    It takes as long as the plan's times allow, and ends by itself in any case.
    """
    bench.forget_trail()
    began = time.monotonic()
    was_gone = bool(bench.gone)
    try:
        result = _run(bench, item)
        wire = tuple(bench.trail)
    finally:
        bench.restore()
    if bench.gone and not was_gone and result["outcome"] is not Outcome.DIFFERS:
        result = {
            "outcome": Outcome.DIFFERS,
            "expected": "the camera is still there",
            "came": bench.gone,
        }
    failed = result["outcome"] in {Outcome.DIFFERS, Outcome.UNDESCRIBED}
    place, grade = item.source(bench.known_dialect)
    return Finding(
        item=item,
        source=place,
        grade=grade,
        wire=wire if failed else (),
        seconds=time.monotonic() - began,
        **result,
    )


def _run(bench: Bench, item: Item) -> dict[str, Any]:
    try:
        unfit = _unfit(bench, item)
        if unfit:
            return {"outcome": Outcome.NOT_APPLICABLE, "text": unfit}
        bench.require(item.needs)
        value = item.run(bench)
    except Undescribed as exc:
        return {"outcome": Outcome.UNDESCRIBED, "expected": exc.expected, "came": exc.came}
    except Differs as exc:
        return {"outcome": Outcome.DIFFERS, "expected": exc.expected, "came": exc.came}
    except EndedError as exc:
        return {"outcome": Outcome.DIFFERS, "expected": "the link stays up", "came": str(exc)}
    except NotObserved as exc:
        return {"outcome": Outcome.NOT_OBSERVED, "text": str(exc)}
    if isinstance(item, Question):
        return {"outcome": Outcome.OBSERVED, "value": value}
    return {"outcome": Outcome.AS_DOCUMENTED, "text": value or ""}


def _unfit(bench: Bench, item: Item) -> str:
    """Return why a check makes no sense here, "" where it does."""
    try:
        dialect = bench.dialect
    except Differs as exc:
        if item.name == CONNECT_CHECK:
            raise
        raise NotObserved(f"no dialect is answered: {exc.came}") from exc
    if bench.gone and item.name != CONNECT_CHECK and dialect in item.dialects:
        raise NotObserved(f"the camera is gone: {bench.gone}")
    if dialect not in item.dialects:
        return f"only in {' and '.join(item.dialects)}; this camera speaks {dialect}"
    if bench.transport not in item.transports:
        return f"only over {item.transports[0].upper()}"
    return ""
