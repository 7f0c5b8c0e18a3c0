"""Run the checks and questions on a camera, one after the other."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_all, check_kind, check_text
from smartcam.conformance.camera._items import ITEMS
from smartcam.conformance.camera._options import ConformanceOptions
from smartcam.conformance.camera._raw_client import EndedError
from smartcam.conformance.camera._report import CameraReport
from smartcam.conformance.camera._results import CameraFinding, CheckOutcome, Item, Question
from smartcam.conformance.camera._session_under_test import CameraUnderTest
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable


CONNECT_CHECK = "connect-is-answered"
"""The check that fails if there is no camera at all; the others are not observed then."""


def judge(options: ConformanceOptions, names: Iterable[str] | None = None) -> CameraReport:
    """Run all checks and questions, or some, on a camera, and return the report.

    It blocks, for a minute or two with the default times: do not call it in an event loop's thread.
    The camera is taken from any other client. Application and run state are restored, also if an
    exception, such as Ctrl-C, ends the call.

    Args:
        options: options of the examination.
        names: names of the checks and questions; None for all.

    Raises:
        ConfigurationError: the address cannot work, or a name is unknown.
    """
    check_kind(options, ConformanceOptions, "options", "ConformanceOptions", "judge")
    wanted = None
    if names is not None:
        given = check_all(names, "names", "names of checks", "judge")
        wanted = {check_text(name, "names", "judge") for name in given}
    unknown = sorted((wanted or set()) - {item.name for item in ITEMS})
    if unknown:
        raise ConfigurationError(f"there is no check or question {unknown[0]!r}")
    camera = CameraUnderTest(options)
    report = CameraReport(camera)
    try:
        for item in ITEMS:
            if wanted is None or item.name in wanted:
                report.add(judge_item(camera, item))
    finally:
        camera.restore(again=True)
    return report


def judge_item(camera: CameraUnderTest, item: Item) -> CameraFinding:
    """Run one check or question; its changes are undone afterwards.

    It takes as long as the options' times allow, and ends by itself in any case.
    """
    camera.forget_trail()
    began = time.monotonic()
    was_gone = bool(camera.gone)
    try:
        result = _run(camera, item)
        wire = tuple(camera.trail)
    finally:
        camera.restore()
    if camera.gone and not was_gone and result["outcome"] is not CheckOutcome.DIFFERS:
        result = {
            "outcome": CheckOutcome.DIFFERS,
            "expected": "the camera is still there",
            "observed": camera.gone,
        }
    failed = result["outcome"] in {CheckOutcome.DIFFERS, CheckOutcome.UNDESCRIBED}
    place, grade = item.source(camera.known_dialect)
    return CameraFinding(
        item=item,
        source=place,
        grade=grade,
        wire=wire if failed else (),
        seconds=time.monotonic() - began,
        **result,
    )


def _run(camera: CameraUnderTest, item: Item) -> dict[str, Any]:
    try:
        unfit = _unfit(camera, item)
        if unfit:
            return {"outcome": CheckOutcome.NOT_APPLICABLE, "text": unfit}
        camera.require(item.needs)
        value = item.run(camera)
    except Undescribed as exc:
        return {"outcome": CheckOutcome.UNDESCRIBED, "expected": exc.expected, "observed": exc.came}
    except Differs as exc:
        return {"outcome": CheckOutcome.DIFFERS, "expected": exc.expected, "observed": exc.came}
    except EndedError as exc:
        return {
            "outcome": CheckOutcome.DIFFERS,
            "expected": "the link stays up",
            "observed": str(exc),
        }
    except NotObserved as exc:
        return {"outcome": CheckOutcome.NOT_OBSERVED, "text": str(exc)}
    if isinstance(item, Question):
        return {"outcome": CheckOutcome.OBSERVED, "value": value}
    return {"outcome": CheckOutcome.AS_DOCUMENTED, "text": value or ""}


def _unfit(camera: CameraUnderTest, item: Item) -> str:
    """Return the reason why a check does not apply here, "" if it applies."""
    try:
        dialect = camera.dialect
    except Differs as exc:
        if item.name == CONNECT_CHECK:
            raise
        raise NotObserved(f"the camera answers in no dialect: {exc.came}") from exc
    if camera.gone and item.name != CONNECT_CHECK and dialect in item.dialects:
        raise NotObserved(f"the camera is gone: {camera.gone}")
    if dialect not in item.dialects:
        return f"only in {' and '.join(item.dialects)}; this camera speaks {dialect}"
    if camera.transport not in item.transports:
        return f"only over {item.transports[0].upper()}"
    return ""
